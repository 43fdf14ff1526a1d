from .derivative import differentiate as differentiate
from .linear import correction as correction, eliminate as eliminate
from .linear import MAX_WRITTEN_OUT as MAX_WRITTEN_OUT, solve_matrix as solve_matrix
from .picard_newton import PicardNewton as PicardNewton
from .sweeps import Halves as Halves
from .tolerance import all_finite as all_finite, max_norm as max_norm
