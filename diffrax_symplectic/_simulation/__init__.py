"""Many paths of one equation: what `expectation` and `ensemble` have in common.

- `arguments`: checks of what users pass.
- `levels`: step sizes, each half the one before, and extrapolation from them.
- `problem`: the equation, the function to average and the levels, from the arguments; and
  single steps.
- `layout`: all numbers of a function's values as one vector, and back.
- `loop`: the loop over steps, for paths that move in any way, and for independent ones.
- `engines`: batches of independent paths, by JAX or by a fused kernel.
"""

from .arguments import (
    check_gaussian,
    checked_key,
    has_discrete_increments,
    is_multiple,
    state_itself,
    warn_of_truncation,
)
from .engines import (
    Batch,
    by_drjit,
    ENGINES,
    warn_of_stragglers,
)
from .layout import as_vectors, Layout
from .levels import (
    combinations,
    Combination,
    finer_change_weights,
    Level,
    level_weights,
    MOST_LEVELS,
    with_next_level,
)
from .loop import (
    mask_like,
    independent_motion,
    Motion,
    PathStates,
    simulate,
    Simulated,
    values_of_paths,
)
from .problem import advice_on_failures, Problem, ravel, real_vector
