"""Means over many paths.

In the order of a call of `expectation`:

- `expectation`, `monte_carlo`: the functions. `call`: the checks of arguments that both
  have. `progress`: what a call tells the user who waits.
- `choose`: the sampling, if the user did not choose one. `cost`: how many operations a step
  takes. `kinks`: whether `phi` is smooth.
- `sampling`: what a sampling is. It makes a plan of how samples are taken.
- `independent`, `sorted/`, `fitted/`: the samplings. Each simulates its paths by the loop
  over steps of `_simulation`. `fused_paths`: independent paths from a fused kernel.
- `run`: the loop over batches. `batch`: the program of one batch.
- `estimate/`: the result and its errors, from the sums of batches.

Checks after the last sample, for errors that two levels may not show:

- `out_of_range`: whether the precision cannot hold some number.
- `long_steps`: whether steps are too long at `y0`. `strong_friction`: for the friction.
- `jumps`: whether forces or noise jump in time. `fast_drive`: whether they change too fast.
- `finer_level`: whether a further level changes the mean.
- `fields_in_time`, `linear_maps`: the vector fields, and power iteration, for these checks.
"""

from .estimate import Expectation, ExpectationInterrupted
from .expectation import expectation
from .fitted import ValueFunctions
from .independent import IndependentPaths
from .monte_carlo import monte_carlo
from .sorted import ArrayRQMC
