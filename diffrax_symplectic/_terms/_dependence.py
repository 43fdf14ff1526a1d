"""Detects which inputs the results of a function depend on."""

from collections.abc import Callable

import jax
import jax.tree_util as jtu
from jaxtyping import PyTree

from .._compat import dce_jaxpr


class Dependence:
    """The dependencies of `fn(*inputs)`, traced once: its results do not depend on inputs
    that JAX's dead-code elimination removes.

    This holds for all values of the inputs. The converse does not hold: variables that
    cancel, as in `x - x`, or are multiplied by zero count as read. Arrays are tracked as a
    whole, not entry by entry.
    """

    def __init__(self, fn: Callable, *inputs: PyTree):
        closed, self._out = jax.make_jaxpr(fn, return_shape=True)(*inputs)
        self._jaxpr, self._inputs = closed.jaxpr, inputs

    def independent(self, of: Callable, part: Callable = lambda out: out) -> bool:
        """Whether `part(result)` is independent of `of(*inputs)`, PyTrees of arrays."""
        _, read = dce_jaxpr(self._jaxpr, _marked(part, self._out))
        marked = _marked(lambda inputs: of(*inputs), self._inputs)
        return not any(a and b for a, b in zip(read, marked))


def _marked(select: Callable, tree: PyTree) -> list[bool]:
    """Which leaves of `tree` are leaves of `select(tree)`."""
    treedef = jtu.tree_structure(tree)
    numbers = treedef.unflatten(range(treedef.num_leaves))
    chosen = set(jtu.tree_leaves(select(numbers)))
    return [i in chosen for i in range(treedef.num_leaves)]
