from .array_rqmc import ArrayRQMC as ArrayRQMC
from .ensemble import Ensemble as Ensemble, ensemble as ensemble
from .estimate import (
    Expectation as Expectation,
    ExpectationInterrupted as ExpectationInterrupted,
)
from .monte_carlo import (
    IndependentPaths as IndependentPaths,
    monte_carlo as monte_carlo,
)
from ._value_functions import ValueFunctions as ValueFunctions
