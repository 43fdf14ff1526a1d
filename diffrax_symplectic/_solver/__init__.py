from .base import (
    AbstractImplicitStages as AbstractImplicitStages,
    AbstractSymplecticRungeKutta as AbstractSymplecticRungeKutta,
    AbstractSymplecticSolver as AbstractSymplecticSolver,
    Noises as Noises,
    Record as Record,
    Want as Want,
)
from .general import (
    ImplicitMidpoint as ImplicitMidpoint,
    SRKs1 as SRKs1,
    SRKw1 as SRKw1,
    SRKw2 as SRKw2,
)
from .separable import (
    PlateauVerlet as PlateauVerlet,
    SRKs2 as SRKs2,
    SRKs3 as SRKs3,
    SRKw3 as SRKw3,
    SRKw4 as SRKw4,
    StormerVerlet as StormerVerlet,
)
from .additive import (
    AdditiveGauss as AdditiveGauss,
    SRKs4 as SRKs4,
    SRKw5 as SRKw5,
)
from .beyond import (
    LevyAreaMidpoint as LevyAreaMidpoint,
    NinomiyaVictoir as NinomiyaVictoir,
    PlateauGauss as PlateauGauss,
    StrangGauss as StrangGauss,
)
from .baoab import BAOAB as BAOAB
from .splitting import (
    AbstractSplitting as AbstractSplitting,
    Damped as Damped,
    LinearFlow as LinearFlow,
)


# All solvers without friction, in the order of the documentation.
SOLVERS: tuple[type[AbstractSymplecticSolver], ...] = (
    *(ImplicitMidpoint, SRKs1, SRKw1, SRKw2),
    *(StrangGauss, NinomiyaVictoir, PlateauGauss, LevyAreaMidpoint),
    *(SRKs2, SRKs3, SRKw3, SRKw4, StormerVerlet, PlateauVerlet),
    *(SRKs4, SRKw5, AdditiveGauss),
)
