from ._derivative import differentiate as differentiate
from ._linear import correction as correction, solve_matrix as solve_matrix
from ._picard_newton import PicardNewton as PicardNewton
from ._sweeps import Halves as Halves
from ._tolerance import all_finite as all_finite, max_norm as max_norm, ratio as ratio
