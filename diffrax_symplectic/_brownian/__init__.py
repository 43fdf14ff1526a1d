"""Random words, the laws of random variables, and Brownian paths.

- `random`: random words for each step, and the laws of variables computed from them.
- `stepwise`: paths whose increment over a step is a function of random words.
- `cells`: steps composed of cells, so that different steps follow the same path.
- `paths`: paths of independent random variables, discrete or Gaussian.
- `wrappers`, `levy_area`: paths that change the increments of another path, or add
  variables to them.
- `variables`: facts about each random variable, and the path that has it.
"""

from .stepwise import AbstractStepwisePath, AbstractWrappedPath, GivenPath, Increment
from .stepwise import (
    checked_shape,
    checked_stepwise,
    increment_struct,
    is_random,
    laws_of,
    num_noises,
    ONLY_A_SHAPE,
    step_size,
    UnspecifiedPath,
    zeros_and_unravel,
)
from .paths import (
    CommonBrownianPath,
    FixedStepBrownianPath,
    WeakBrownianPath,
    WeakIncrement,
)
from .random import AbstractLaw, check_key, derived_key, Discrete, is_key
from .random import random_words, THREE_POINT, typed_key
from .levy_area import LevyAreaBrownianPath, LevyAreaIncrement
from .wrappers import (
    has_bounded_increments,
    lost_variance,
    STEP_BEYOND_UNIT,
    TRUNCATE_LESS,
    PlateauBrownianPath,
    PlateauIncrement,
    TruncatedBrownianPath,
)
from .variables import drives, most_demanding_variable, path_maker, VARIABLES
