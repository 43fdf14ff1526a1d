from ._picard_newton import PicardNewton as PicardNewton
from ._small_lu import SmallLU as SmallLU
