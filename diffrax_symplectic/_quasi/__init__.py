from ._estimate import QuasiExpectation as QuasiExpectation
from ._quasi_expectation import quasi_expectation as quasi_expectation
