from ._truncated import TruncatedBrownianPath as TruncatedBrownianPath
from ._weak import WeakBrownianPath as WeakBrownianPath, WeakIncrement as WeakIncrement
