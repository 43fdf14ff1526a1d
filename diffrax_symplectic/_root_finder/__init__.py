from ._derivative import differentiate as differentiate
from ._picard_newton import PicardNewton as PicardNewton
from ._sweeps import Halves as Halves
from ._tolerance import all_finite as all_finite
