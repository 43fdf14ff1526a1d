"""The solution of stage equations, and its derivatives.

- `picard_newton`: the root finder: sweeps first, Newton's method for what they leave.
- `sweeps`, `newton`: the two iterations.
- `tolerance`: when a correction is small enough.
- `linear`: the linear systems of Newton's method and of derivatives.
- `derivative`: derivatives of a solution, by implicit differentiation.
"""

from .derivative import differentiate as differentiate
from .linear import correction as correction, eliminate as eliminate
from .linear import MAX_WRITTEN_OUT as MAX_WRITTEN_OUT, solve_matrix as solve_matrix
from .picard_newton import PicardNewton as PicardNewton
from .sweeps import best_relaxation as best_relaxation, Halves as Halves
from .sweeps import SLOW as SLOW, LOG2_STALLED as LOG2_STALLED
from .tolerance import (
    all_finite as all_finite,
    LOG2_MARGIN as LOG2_MARGIN,
    max_norm as max_norm,
)
from .tolerance import ROUNDINGS as ROUNDINGS
