from ._stepwise import GivenPath as GivenPath
from ._paths import FixedStepBrownianPath as FixedStepBrownianPath
from ._random import (
    AbstractLaw as AbstractLaw,
    check_key as check_key,
    Discrete as Discrete,
    random_words as random_words,
    THREE_POINT as THREE_POINT,
)
from ._levy_area import (
    LevyAreaBrownianPath as LevyAreaBrownianPath,
    LevyAreaIncrement as LevyAreaIncrement,
)
from ._wrappers import (
    PlateauBrownianPath as PlateauBrownianPath,
    PlateauIncrement as PlateauIncrement,
)
from ._stepwise import (
    AbstractStepwisePath as AbstractStepwisePath,
    AbstractWrappedPath as AbstractWrappedPath,
    Increment as Increment,
    increment_struct as increment_struct,
    laws_of as laws_of,
    stepwise as stepwise,
)
from ._wrappers import TruncatedBrownianPath as TruncatedBrownianPath
from ._variables import path_of as path_of, VARIABLES as VARIABLES
from ._paths import WeakBrownianPath as WeakBrownianPath, WeakIncrement as WeakIncrement
