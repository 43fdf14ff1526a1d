"""Means over many paths, and the paths themselves.

In the order of a call of `expectation`:

- `expectation`, `ensemble`, `monte_carlo`: the functions; `call`: what they check alike.
- `problem`: the equation, the function to average and the step sizes, from `arguments`.
- `choose`: the sampling, if the user did not choose one; `kinks`: whether `phi` is smooth.
- `sampling`: what a sampling is. It makes a plan of how samples are taken.
- `independent`, `array_rqmc`, `value_functions`: the samplings. Each simulates its paths by
  the loop over steps in `simulation`.
- `points`, `hilbert`: what Array-RQMC needs, quasi-random points and the order of paths.
- `noise`, `fits`, `bases`, `grid`, `basis_choice`, `polynomials`, `controlled_paths`: what
  value functions need, from the random variables of a step to the control variate.
- `run`: the loop over batches; `batch`: the program of one; `moments`: what is kept.
- `estimate`: the result; `error_bars`: its errors; `cautions`: what users are warned of;
  `saved`: estimates in files.
- `engines`, `fused_paths`: paths from fused kernels.
"""

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
