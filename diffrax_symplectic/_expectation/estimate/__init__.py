"""From sums over samples to the result that users see.

- `moments`: means and variances of batches, and how they are combined.
- `error_bars`: means and standard errors, from moments.
- `estimate`: the result, `Expectation`; `saved`: results in files.
- `tolerance`: whether a result is accurate enough; `cautions`: what users are warned of.
"""

from .cautions import cautions
from .error_bars import heaviness
from .estimate import (
    check_same,
    combined_results,
    Expectation,
    ExpectationInterrupted,
    label_of,
)
from .moments import combined_in_halves, Moments, total
from .tolerance import (
    is_bounded_by_steps,
    is_reached,
    is_stuck,
    largest_error,
    needs_level,
    share_of_needed,
)
