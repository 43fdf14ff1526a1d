from .array_rqmc import ArrayRQMC as ArrayRQMC
from .ensemble import Ensemble as Ensemble, ensemble as ensemble
from .estimate import (
    Expectation as Expectation,
    ExpectationInterrupted as ExpectationInterrupted,
)
from .expectation import expectation as expectation
from .independent import IndependentPaths as IndependentPaths
from .monte_carlo import monte_carlo as monte_carlo
from .value_functions import ValueFunctions as ValueFunctions
