from ._batch import batched_together as batched_together
from ._derivative import differentiate as differentiate
from ._picard_newton import ITERATIONS, PicardNewton as PicardNewton
from ._tolerance import all_finite as all_finite
