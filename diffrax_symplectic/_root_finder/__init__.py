from ._derivative import differentiate as differentiate
from ._picard_newton import ITERATIONS, PicardNewton as PicardNewton
from ._sweeps import Found as Found, sweep as sweep
from ._tolerance import all_finite as all_finite, Limits as Limits
