"""Detects which inputs the results of a function depend on."""

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

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
        self._jaxpr = closed.jaxpr
        self._inputs = inputs

    def independent(self, of: Callable, part: Callable = lambda out: out) -> bool:
        """Whether `part(result)` is independent of `of(*inputs)`, PyTrees of arrays."""
        used_results = _marks(part, self._out)
        # A program for these results alone reads fewer inputs.
        _, read_inputs = dce_jaxpr(self._jaxpr, used_results)
        asked_inputs = _marks(lambda inputs: of(*inputs), self._inputs)
        pairs = zip(read_inputs, asked_inputs)
        return not any(is_read and is_asked for is_read, is_asked in pairs)


def _marks(select: Callable, tree: PyTree) -> list[bool]:
    """For each leaf of `tree`, in order, whether it is a leaf of `select(tree)`."""
    # Leaves may be equal, or have no values, so they are told apart by their numbers.
    treedef = jtu.tree_structure(tree)
    numbers = treedef.unflatten(range(treedef.num_leaves))
    chosen = set(jtu.tree_leaves(select(numbers)))
    return [number in chosen for number in range(treedef.num_leaves)]


# Operations that may act on what is linear in an input, entry by entry. All others count
# as mixing entries: a list of those that mix would grow with each release of JAX.
_ELEMENTWISE = frozenset(
    "add add_any convert_element_type copy div integer_pow mul neg select_n sub".split()
)
# Operations whose parameters hold the program that they call.
_CALLS = frozenset({"jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"})

# The number of the input whose entries the entries of an array depend on, each on the same
# entry; `None` if it depends on no input.
_Source: TypeAlias = int | None


def acts_elementwise(fn: Callable, x: PyTree[Array]) -> bool:
    """Whether each entry of `fn(x)`, in the structure of `x`, is known to depend on the
    same entry of `x` alone. Then its derivative is diagonal. The converse does not hold."""
    closed = jax.make_jaxpr(fn)(x)
    numbers = list(range(len(closed.jaxpr.invars)))
    sources = _sources(closed.jaxpr, numbers)
    if sources is None:
        return False
    return all(
        source is None or source == number for number, source in zip(numbers, sources)
    )


def _sources(jaxpr: Jaxpr, numbers: Sequence[_Source]) -> list[_Source] | None:
    """The source of each result, given those of the inputs. `None` if some operation mixes
    the entries of an input, or two inputs."""
    # Operations that no result needs are left out, since they may mix entries: the
    # derivative of a product of all entries also computes the product.
    jaxpr, read_inputs = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    read_numbers = [number for number, is_read in zip(numbers, read_inputs) if is_read]
    known_sources = dict(zip(jaxpr.invars, read_numbers))

    def source_of(x: Any) -> _Source:
        return None if isinstance(x, Literal) else known_sources.get(x)

    for eqn in jaxpr.eqns:
        sources = [source_of(x) for x in eqn.invars]
        distinct = {number for number in sources if number is not None}
        if len(distinct) == 0:
            continue
        called = _called_by(eqn)
        if called is not None:
            results = _sources(called, sources)
            if results is None:
                return None
            known_sources.update(zip(eqn.outvars, results))
        elif len(distinct) == 1 and _is_elementwise(eqn, sources):
            known_sources.update(dict.fromkeys(eqn.outvars, distinct.pop()))
        else:
            return None
    return [source_of(x) for x in jaxpr.outvars]


def _called_by(eqn: Any) -> Jaxpr | None:
    """The program that an operation calls with its own arguments, if it is such a call."""
    if eqn.primitive.name not in _CALLS:
        return None
    called = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
    # Some operations hold the program with its constants, others without them.
    return getattr(called, "jaxpr", called)


def _is_elementwise(eqn: Any, sources: Sequence[_Source]) -> bool:
    """Whether an operation keeps the entries of those arguments that have a source."""
    shape = eqn.outvars[0].aval.shape
    tracked = [x for x, source in zip(eqn.invars, sources) if source is not None]
    if any(x.aval.shape != shape for x in tracked):
        return False
    if eqn.primitive.name == "dot_general":
        # The derivative of `p @ p` multiplies by a scalar in this way.
        return len(tracked) == 1 and any(x.aval.size == 1 for x in eqn.invars)
    # These two keep the entries if they keep the shape, as they do here.
    if eqn.primitive.name in ("reshape", "broadcast_in_dim"):
        return True
    return eqn.primitive.name in _ELEMENTWISE
