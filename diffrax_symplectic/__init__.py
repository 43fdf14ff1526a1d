"""Stochastic symplectic Runge-Kutta methods for Diffrax.

The state is a pair `(p, q)`, momenta first.

- Terms: `hamiltonian_terms`, `langevin_terms`, `spin_terms`, `wave_terms`.
- Choosing a solver: `suggest_solver`, `compare_solvers`; try `ImplicitMidpoint` first.
- Its Brownian path: `solver.path(shape, key)`.
- Solving: `diffrax.diffeqsolve(terms, solver, t0, t1, dt0, y0)`.
- Means over many paths: `expectation`; the states of many paths: `ensemble`.
- Friction: `langevin_terms`, for `BAOAB` and all other solvers.
- Rods and rigid molecules: `constraint=` of the terms, `constrained_state`.
- Stiff linear parts: `BAOAB(linear_flow(...))`, or without a bath `LinearFlow`.
- Gradients of long solves: `ReversingAdjoint`.
- Checks of one step: `symplecticity_defect`, `weak_order_defect`.
"""

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
from ._compare import compare_solvers as compare_solvers, Comparison as Comparison
from ._tableau import (
    strong_order_residuals as strong_order_residuals,
    symplectic_residuals as symplectic_residuals,
    weak_order_residuals as weak_order_residuals,
)
from ._ensemble import Ensemble as Ensemble, ensemble as ensemble
from ._expectation import (
    ArrayRQMC as ArrayRQMC,
    Expectation as Expectation,
    expectation as expectation,
    ExpectationInterrupted as ExpectationInterrupted,
    IndependentPaths as IndependentPaths,
    monte_carlo as monte_carlo,
    ValueFunctions as ValueFunctions,
)
from ._root_finder import PicardNewton as PicardNewton
from ._solver import (
    AbstractImplicitStages as AbstractImplicitStages,
    AbstractSymplecticRungeKutta as AbstractSymplecticRungeKutta,
    AbstractSymplecticSolver as AbstractSymplecticSolver,
    AdditiveGauss as AdditiveGauss,
    BAOAB as BAOAB,
    Bath as Bath,
    Flight as Flight,
    Flow as Flow,
    Kick as Kick,
    LangevinMiddle as LangevinMiddle,
    LevyAreaMidpoint as LevyAreaMidpoint,
    LinearFlow as LinearFlow,
    linear_flow as linear_flow,
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
    Splitting as Splitting,
    SRKw5 as SRKw5,
    StormerVerlet as StormerVerlet,
    StrangGauss as StrangGauss,
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
from ._terms import (
    bath_terms as bath_terms,
    constrained_state as constrained_state,
    FrictionAlong as FrictionAlong,
    from_pair as from_pair,
    from_spinors as from_spinors,
    hamiltonian_terms as hamiltonian_terms,
    IndexedNoise as IndexedNoise,
    ito_drift as ito_drift,
    langevin_terms as langevin_terms,
    noise_terms as noise_terms,
    spin_terms as spin_terms,
    to_pair as to_pair,
    to_spinors as to_spinors,
    wave_terms as wave_terms,
)
from ._verify import (
    equipartition as equipartition,
    poisson_defect as poisson_defect,
    second_moment_map as second_moment_map,
    step_expectation as step_expectation,
    symplecticity_defect as symplecticity_defect,
    weak_order_defect as weak_order_defect,
)


__version__ = "0.1.0"
