from ._call import expectation as expectation, monte_carlo as monte_carlo
from ._result import (
    Expectation as Expectation,
    ExpectationInterrupted as ExpectationInterrupted,
)
from ._sampling import (
    ArrayRQMC as ArrayRQMC,
    IndependentPaths as IndependentPaths,
    ValueFunctions as ValueFunctions,
)
