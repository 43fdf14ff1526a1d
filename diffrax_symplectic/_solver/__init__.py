from .base import AbstractImplicitStages, AbstractSymplecticRungeKutta
from .base import AbstractSymplecticSolver, Record, Want
from .general import ImplicitMidpoint, SRKs1, SRKw1, SRKw2
from .separable import PlateauVerlet, SRKs2, SRKs3, SRKw3, SRKw4, StormerVerlet
from .additive import AdditiveGauss, SRKs4, SRKw5
from .beyond import LevyAreaMidpoint, NinomiyaVictoir, PlateauGauss, StrangGauss
from .langevin import AbstractLangevinSplitting, BAOAB, LangevinMiddle
from .flow import is_solver
from .linear_flow import linear_flow
from .paths import common_path, own_path
from .root_finders import with_changed_stages, without_newton
from .times import check_resolution
from .splitting import LinearFlow


# Those that need friction, from `langevin_terms`.
LANGEVIN: tuple[type[BAOAB] | type[LangevinMiddle], ...] = (BAOAB, LangevinMiddle)
# All others, in the order of the documentation.
SOLVERS: tuple[type[AbstractSymplecticSolver], ...] = (
    *(ImplicitMidpoint, SRKs1, SRKw1, SRKw2),
    *(StrangGauss, NinomiyaVictoir, PlateauGauss, LevyAreaMidpoint),
    *(SRKs2, SRKs3, SRKw3, SRKw4, StormerVerlet, PlateauVerlet),
    *(SRKs4, SRKw5, AdditiveGauss),
)
