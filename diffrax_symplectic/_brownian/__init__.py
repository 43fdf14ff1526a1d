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
