"""Means over many paths.

In the order of a call of `expectation`:

- `expectation`, `monte_carlo`: the functions; `call`: what they check alike.
- `choose`: the sampling, if the user did not choose one, by `cost`, what a step costs, and
  `kinks`, whether `phi` is smooth; `long_steps`, whether steps are too long at `y0`;
  `strong_friction`, whether steps resolve the friction; `jumps`, whether forces jump at
  their ends; `fast_drive`, whether steps resolve a drive. `fields_in_time` and
  `linear_maps` are what these look at.
- `sampling`: what a sampling is. It makes a plan of how samples are taken.
- `independent`, `sorted/`, `fitted/`: the samplings. Each simulates its paths by the loop
  over steps of `_simulation`; `fused_paths`: independent ones from a fused kernel.
- `run`: the loop over batches; `batch`: the program of one.
- `estimate/`: the result and its errors, from the sums of batches.
"""

from .estimate import Expectation, ExpectationInterrupted
from .expectation import expectation
from .fitted import ValueFunctions
from .independent import IndependentPaths
from .monte_carlo import monte_carlo
from .sorted import ArrayRQMC
