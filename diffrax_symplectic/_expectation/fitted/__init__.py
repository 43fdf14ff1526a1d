"""Paths with control variates from fitted value functions.

- `value_functions`: the sampling. A trial decides for which means the fit is used.
- `noise`: the random variables of a step, and expectations over them.
- `bases`, `grid`: the functions that are fitted, both made of `polynomials`.
- `basis_choice`: which of these bases a problem gets.
- `fits`: value functions, from a pilot run and a loop backward in time.
- `controlled_paths`: paths, and their control variates.
- `mixture`: the laws by which paths draw their noise, so that rare paths are common.

Axes of arrays are named as in `_simulation/problem.py`. In addition there are `P`
polynomials and `K` outcomes of a step, and `n` stands for random variables as well.
"""

from .basis_choice import suits_grid
from .noise import count_outcomes
from .value_functions import ValueFunctions
