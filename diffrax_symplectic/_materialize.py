from collections.abc import Callable
from typing import TypeVar

import jax
import jax.tree_util as jtu
from jax import lax


_T = TypeVar("_T")


def materialize(fn: Callable[[], _T]) -> _T:
    """`fn()`, computed once and kept in memory.

    On CPUs, XLA may fuse a computation into every kernel that reads its result, and so
    repeat it in each. For Gaussian numbers and transcendental functions this costs more
    than it saves. XLA fuses nothing across the border of a conditional. So `fn` is called
    in one branch of a conditional, and the barrier hides from XLA that the condition is
    always true.
    """

    def in_a_conditional() -> _T:
        shapes = jax.eval_shape(fn)
        zeros = lambda: jtu.tree_map(lambda s: lax.full_like(s, 0), shapes)
        return lax.cond(lax.optimization_barrier(True), fn, zeros)

    return lax.platform_dependent(cpu=in_a_conditional, default=fn)
