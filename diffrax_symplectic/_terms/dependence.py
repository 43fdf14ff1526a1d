"""Detects which inputs the results of a function depend on."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._compat import dce_jaxpr, Jaxpr, Literal


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


# Operations that may act on what is linear in an input, entry by entry. All others count
# as mixing entries.
_ELEMENTWISE = frozenset(
    "add add_any convert_element_type copy div integer_pow mul neg select_n sub".split()
)
# Those whose parameters hold what they call.
_CALLS = frozenset({"jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"})


def acts_elementwise(fn: Callable, x: PyTree[Array]) -> bool:
    """Whether each entry of `fn(x)`, in the structure of `x`, is known to depend on the
    same entry of `x` alone. Then its derivative is diagonal. The converse does not hold."""
    closed = jax.make_jaxpr(fn)(x)
    numbers = list(range(len(closed.jaxpr.invars)))
    sources = _sources(closed.jaxpr, numbers)
    fits = lambda number, source: source is None or source == number
    return sources is not None and all(map(fits, numbers, sources))


def _sources(jaxpr: Jaxpr, numbers: Sequence[int | None]) -> list[int | None] | None:
    """For each result, the number of the input whose entries its entries depend on, or
    `None` if it depends on none; given the number of each input. `None` if some operation
    mixes the entries of an input, or two inputs."""
    jaxpr, read = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    read_numbers = [number for number, is_read in zip(numbers, read) if is_read]
    source = dict(zip(jaxpr.invars, read_numbers))
    of = lambda x: None if isinstance(x, Literal) else source.get(x)
    for eqn in jaxpr.eqns:
        found = {number for x in eqn.invars if (number := of(x)) is not None}
        if len(found) == 0:
            continue
        inner = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
        if inner is not None and eqn.primitive.name in _CALLS:
            inner = getattr(inner, "jaxpr", inner)
            outs = _sources(inner, [of(x) for x in eqn.invars])
            if outs is None:
                return None
            source.update(zip(eqn.outvars, outs))
        elif len(found) == 1 and _is_elementwise(eqn, of):
            source.update(dict.fromkeys(eqn.outvars, found.pop()))
        else:
            return None
    return [of(x) for x in jaxpr.outvars]


def _is_elementwise(eqn: Any, source: Callable) -> bool:
    """Whether an operation keeps the entries of the arguments that `source` tracks."""
    shape = eqn.outvars[0].aval.shape
    tracked = [x for x in eqn.invars if source(x) is not None]
    if any(x.aval.shape != shape for x in tracked):
        return False
    if eqn.primitive.name == "dot_general":
        # The derivative of `p @ p` multiplies by a scalar in this way.
        return len(tracked) == 1 and any(x.aval.size == 1 for x in eqn.invars)
    if eqn.primitive.name in ("reshape", "broadcast_in_dim"):
        return True
    return eqn.primitive.name in _ELEMENTWISE
