from ._call import Ensemble, ensemble
from ._engines import warn_of_stragglers
from ._means import fused_plan, FusedPaths
