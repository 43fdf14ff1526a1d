from ._stepwise import AbstractStepwisePath, AbstractWrappedPath, GivenPath, Increment
from ._stepwise import (
    checked_shape,
    increment_struct,
    is_random,
    laws_of,
    num_noises,
    raveled,
    step_size,
    stepwise,
    UnspecifiedPath,
)
from ._paths import FixedStepBrownianPath, WeakBrownianPath, WeakIncrement
from ._random import AbstractLaw, check_key, Discrete, is_key, random_words
from ._random import THREE_POINT, typed_key
from ._levy_area import LevyAreaBrownianPath, LevyAreaIncrement
from ._wrappers import PlateauBrownianPath, PlateauIncrement, TruncatedBrownianPath
from ._variables import drives, path_of, VARIABLES
