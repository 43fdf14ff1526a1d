from ._levy_area import (
    LevyAreaBrownianPath as LevyAreaBrownianPath,
    LevyAreaIncrement as LevyAreaIncrement,
)
from ._plateau import (
    PlateauBrownianPath as PlateauBrownianPath,
    PlateauIncrement as PlateauIncrement,
)
from ._random_words import check_key as check_key
from ._truncated import TruncatedBrownianPath as TruncatedBrownianPath
from ._weak import (
    WeakBrownianPath as WeakBrownianPath,
    WeakIncrement as WeakIncrement,
)
