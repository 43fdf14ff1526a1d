from ._adjoint import ReversingAdjoint as ReversingAdjoint
from ._brownian import (
    FixedStepBrownianPath as FixedStepBrownianPath,
    LevyAreaBrownianPath as LevyAreaBrownianPath,
    LevyAreaIncrement as LevyAreaIncrement,
    PlateauBrownianPath as PlateauBrownianPath,
    PlateauIncrement as PlateauIncrement,
    TruncatedBrownianPath as TruncatedBrownianPath,
    WeakBrownianPath as WeakBrownianPath,
    WeakIncrement as WeakIncrement,
)
from ._citation import citation as citation
from ._compare import (
    compare_solvers as compare_solvers,
    ComparedStep as ComparedStep,
    Comparison as Comparison,
)
from ._conditions import (
    strong_order_residuals as strong_order_residuals,
    symplectic_residuals as symplectic_residuals,
    weak_order_residuals as weak_order_residuals,
)
from ._expectation import (
    ArrayRQMC as ArrayRQMC,
    Expectation as Expectation,
    expectation as expectation,
    ExpectationInterrupted as ExpectationInterrupted,
    IndependentPaths as IndependentPaths,
    monte_carlo as monte_carlo,
    ValueFunctions as ValueFunctions,
)
from ._hamiltonian import hamiltonian_terms as hamiltonian_terms
from ._indexed_noise import IndexedNoise as IndexedNoise
from ._root_finder import PicardNewton as PicardNewton
from ._solver import (
    AbstractImplicitStages as AbstractImplicitStages,
    AbstractSymplecticRungeKutta as AbstractSymplecticRungeKutta,
    AdditiveGauss as AdditiveGauss,
    BAOAB as BAOAB,
    check_structure as check_structure,
    Damped as Damped,
    LevyAreaMidpoint as LevyAreaMidpoint,
    LinearFlow as LinearFlow,
    ImplicitMidpoint as ImplicitMidpoint,
    NinomiyaVictoir as NinomiyaVictoir,
    PlateauGauss as PlateauGauss,
    PlateauVerlet as PlateauVerlet,
    SRKs1 as SRKs1,
    SRKs2 as SRKs2,
    SRKs3 as SRKs3,
    SRKs4 as SRKs4,
    SRKw1 as SRKw1,
    SRKw2 as SRKw2,
    SRKw3 as SRKw3,
    SRKw4 as SRKw4,
    SRKw5 as SRKw5,
    StormerVerlet as StormerVerlet,
    StrangGauss as StrangGauss,
)
from ._spins import (
    from_spinors as from_spinors,
    spin_terms as spin_terms,
    to_spinors as to_spinors,
)
from ._suggest import (
    suggest_solver as suggest_solver,
    Suggestion as Suggestion,
    Suggestions as Suggestions,
)
from ._tableau import (
    AbstractTableau as AbstractTableau,
    AdditiveTableau as AdditiveTableau,
    GeneralTableau as GeneralTableau,
    PartitionedTableau as PartitionedTableau,
    SeparableTableau as SeparableTableau,
)
from ._verify import (
    poisson_defect as poisson_defect,
    second_moment_map as second_moment_map,
    step_expectation as step_expectation,
    symplecticity_defect as symplecticity_defect,
    weak_order_defect as weak_order_defect,
)
from ._waves import (
    from_pair as from_pair,
    to_pair as to_pair,
    wave_terms as wave_terms,
)


__version__ = "0.1.0"
