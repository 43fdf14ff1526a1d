from ._stepwise import GivenPath as GivenPath
from ._paths import FixedStepBrownianPath as FixedStepBrownianPath
from ._laws import (
    AbstractLaw as AbstractLaw,
    Discrete as Discrete,
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
from ._random_words import check_key as check_key, random_words as random_words
from ._stepwise import (
    AbstractStepwisePath as AbstractStepwisePath,
    Increment as Increment,
    laws_of as laws_of,
    stepwise as stepwise,
)
from ._wrappers import TruncatedBrownianPath as TruncatedBrownianPath
from ._variables import path_of as path_of, VARIABLES as VARIABLES
from ._paths import WeakBrownianPath as WeakBrownianPath, WeakIncrement as WeakIncrement
from ._wrappers import (
    AbstractWrappedPath as AbstractWrappedPath,
    increment_struct as increment_struct,
)
