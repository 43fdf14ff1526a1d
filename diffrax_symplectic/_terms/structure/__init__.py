"""What follows from the form of a system, and what is wrong with it.

- `checks`: whether a system has the structure that a solver needs, by tracing what its
  vector fields depend on.
- `assertion`: the structure that a user asserted, compared with derivatives at one state.
- `commuting`: whether noises commute, tested at random states.
- `said_twice`: one Hamiltonian in two drifts, one Brownian motion in two noises.
- `truncation`: which Gaussian increments an implicit step needs bounded.
"""

from .checks import (
    additive_fault,
    check_assertions,
    check_stratonovich,
    check_structure,
)
from .checks import constant_fault, Fault, FRICTION, separable_fault
from .commuting import noises_commute
from .said_twice import check_baths_have_own_noise, check_drifts_differ
from .truncation import which_need_truncation, with_truncation
