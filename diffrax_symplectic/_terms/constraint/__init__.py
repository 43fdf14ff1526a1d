"""Positions and momenta that satisfy a constraint. Terms hold their constraint in a
`ConstrainedDrift`, of the module `constrained_drift`.

- `surface`: the allowed positions and their tangent momenta: projections, free flight.
- `multipliers`: the multipliers of a free flight, by Newton's method.
- `start`: `constrained_state`, and the check of a state at the start of a solve.
"""

from .start import check_start, constrained_state
from .surface import NormalSpace, Surface
