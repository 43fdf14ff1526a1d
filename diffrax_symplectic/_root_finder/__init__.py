from ._derivative import differentiate as differentiate
from ._picard_newton import PicardNewton as PicardNewton
from ._sweeps import Halves as Halves
from ._tolerance import all_finite as all_finite
from ._linear import eliminate as eliminate, MAX_WRITTEN_OUT as MAX_WRITTEN_OUT
