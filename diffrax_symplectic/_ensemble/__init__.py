from ._call import Ensemble, ensemble
from ._means import fused_plan
