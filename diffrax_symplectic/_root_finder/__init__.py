from ._continuation import finish as finish
from ._implicit import differentiate as differentiate
from ._picard_newton import PicardNewton as PicardNewton
from ._small_lu import SmallLU as SmallLU
from ._start import (
    improve as improve,
    Measured as Measured,
    start as start,
    Sweep as Sweep,
)
from ._tolerance import all_finite as all_finite
