from .derivative import differentiate as differentiate
from .linear import eliminate as eliminate, MAX_WRITTEN_OUT as MAX_WRITTEN_OUT
from .picard_newton import PicardNewton as PicardNewton
from .sweeps import Halves as Halves
from .tolerance import all_finite as all_finite
