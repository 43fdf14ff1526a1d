from ._derivative import differentiate as differentiate
from ._picard_newton import (
    AbstractBlocks as AbstractBlocks,
    PicardNewton as PicardNewton,
)
from ._sweeps import Doubled as Doubled, Halves as Halves, Partitioned as Partitioned
from ._tolerance import all_finite as all_finite
