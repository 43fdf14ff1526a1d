"""Paths with control variates from fitted value functions.

- `value_functions`: the sampling. A trial decides where the fit is used.
- `noise`: the random variables of a step, and expectations over them.
- `bases`, `grid`: the functions that are fitted; `polynomials`: what both are made of;
  `basis_choice`: which of them.
- `fits`: value functions, from a pilot run and a loop backward in time.
- `controlled_paths`: paths, and their control variates.
- `mixture`: the laws of the noise of paths, by which rare ones are common.

Axes of arrays, beside those of `_simulation/problem.py`: `P` polynomials, `K` outcomes of a
step. Of random variables there are `n` as well.
"""

from .basis_choice import suits_grid
from .noise import count_outcomes
from .value_functions import ValueFunctions
