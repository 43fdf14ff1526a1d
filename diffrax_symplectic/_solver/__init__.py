"""One step of each method, and the Brownian path that it needs.

Solvers, each with its `record`:

- `general`, `separable`, `additive`: those by Wang, Hong and Xu and others, as tableaus.
- `beyond`: for noises that do not commute, or more accurate paths.
- `langevin`, `splitting`: for heat baths; `fast_flow`: `LinearFlow`, for others.

What they are made of:

- `base`: the base classes, and the step of a tableau; `record`: facts about a solver.
- `driven`, `brackets`: the changes of the state by drift and noise over a step.
- `step`: a step by the plan of a tableau, and its stage equations.
- `pieces`: the pieces of a splitting; `flow`, `linear_flow`: flows as pieces; `bath`:
  friction and noise as a piece.
- `constrained`: start and end of a step under a constraint.
- `paths`: the path that a solver needs; `times`: whether times resolve a step.
"""

from .base import AbstractImplicitStages, AbstractSymplecticRungeKutta
from .base import AbstractSymplecticSolver, has_newton, IMPLICIT_ARGUMENTS
from .base import with_changed_stages, without_newton
from .record import Record, Want
from .general import ImplicitMidpoint, SRKs1, SRKw1, SRKw2
from .bath import after_friction
from .beyond import StrangGauss, NinomiyaVictoir, PlateauGauss, LevyAreaMidpoint
from .separable import SRKs2, SRKs3, SRKw3, SRKw4, StormerVerlet, PlateauVerlet
from .additive import SRKs4, SRKw5, AdditiveGauss
from .langevin import BAOAB, LangevinMiddle
from .splitting import AbstractLangevinSplitting, Splitting
from .pieces import AbstractPiece, Bath, Flight, Flow, Kick, kicks_and_rest
from .fast_flow import LinearFlow
from .flow import is_solver
from .linear_flow import linear_flow
from .paths import common_path, own_path
from .times import check_resolution


# The solvers with default arguments, in the order of the documentation: those that need
# friction, from `langevin_terms`, and all others that do not wrap another solver.
LANGEVIN: tuple[type[AbstractLangevinSplitting], ...] = (BAOAB, LangevinMiddle)
SOLVERS: tuple[type[AbstractSymplecticSolver], ...] = (
    ImplicitMidpoint,
    SRKs1,
    SRKw1,
    SRKw2,
    StrangGauss,
    NinomiyaVictoir,
    PlateauGauss,
    LevyAreaMidpoint,
    SRKs2,
    SRKs3,
    SRKw3,
    SRKw4,
    StormerVerlet,
    PlateauVerlet,
    SRKs4,
    SRKw5,
    AdditiveGauss,
)
for _kind in SOLVERS:
    if issubclass(_kind, AbstractImplicitStages):
        _kind.__init__.__doc__ = IMPLICIT_ARGUMENTS
