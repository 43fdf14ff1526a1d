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
        self._jaxpr = _without_powers_of_zero(closed.jaxpr)
        self._inputs = inputs

    def independent(self, of: Callable, part: Callable = lambda out: out) -> bool:
        """Whether `part(result)` is independent of `of(*inputs)`, PyTrees of arrays."""
        is_in_part = _which_are_selected(part, self._out)
        # A program for these results alone reads fewer inputs.
        _, is_read = dce_jaxpr(self._jaxpr, is_in_part)
        is_asked = _which_are_selected(lambda inputs: of(*inputs), self._inputs)
        return not any(read and asked for read, asked in zip(is_read, is_asked))


def _without_powers_of_zero(jaxpr: Jaxpr) -> Jaxpr:
    """The program, in which `x**0` does not read `x`, nor in the programs that it calls. In
    some versions of JAX the second derivative of `x**2` contains it."""

    def reads_less(eqn: Any) -> Any:
        if eqn.primitive.name == "integer_pow" and eqn.params["y"] == 0:
            (operand,) = eqn.invars
            return eqn.replace(invars=[Literal(1.0, operand.aval)])
        if eqn.primitive.name in _CALLS and "jaxpr" in eqn.params:
            closed = eqn.params["jaxpr"]
            called = closed.replace(jaxpr=_without_powers_of_zero(closed.jaxpr))
            return eqn.replace(params=eqn.params | {"jaxpr": called})
        return eqn

    return jaxpr.replace(eqns=[reads_less(eqn) for eqn in jaxpr.eqns])


def _which_are_selected(select: Callable, tree: PyTree) -> list[bool]:
    """For each leaf of `tree`, in order, whether it is a leaf of `select(tree)`."""
    # Leaves may be equal, or have no values, so they are told apart by their numbers.
    treedef = jtu.tree_structure(tree)
    tree_of_numbers = treedef.unflatten(range(treedef.num_leaves))
    selected_numbers = set(jtu.tree_leaves(select(tree_of_numbers)))
    return [number in selected_numbers for number in range(treedef.num_leaves)]


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


class _MixesEntries(Exception):
    """Some operation mixes the entries of an input, or two inputs."""


def acts_elementwise(fn: Callable, x: PyTree[Array]) -> bool:
    """Whether each entry of `fn(x)`, in the structure of `x`, is known to depend on the
    same entry of `x` alone. Then its derivative is diagonal. The converse does not hold."""
    closed = jax.make_jaxpr(fn)(x)
    # Each input is its own source.
    numbers = list(range(len(closed.jaxpr.invars)))
    try:
        sources = _sources_of_results(closed.jaxpr, numbers)
    except _MixesEntries:
        return False
    return all(
        source is None or source == number for number, source in zip(numbers, sources)
    )


def _sources_of_results(
    jaxpr: Jaxpr, sources_of_inputs: Sequence[_Source]
) -> list[_Source]:
    """The source of each result of a program. Raises `_MixesEntries` if a result has no
    single source, with each entry from the same entry."""
    # Operations that no result needs are left out, since they may mix entries: the
    # derivative of a product of all entries also computes the product.
    jaxpr, read_inputs = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    pairs = zip(sources_of_inputs, read_inputs)
    sources_of_read_inputs = [source for source, is_read in pairs if is_read]
    source_of_variable = dict(zip(jaxpr.invars, sources_of_read_inputs))

    def source_of(x: Any) -> _Source:
        # Constants of the program, and what follows from them alone, are not in the
        # dictionary, and have no source.
        return None if isinstance(x, Literal) else source_of_variable.get(x)

    for eqn in jaxpr.eqns:
        sources = [source_of(x) for x in eqn.invars]
        distinct = {source for source in sources if source is not None}
        if len(distinct) == 0:
            continue
        called = _called_by(eqn)
        if called is not None:
            results = _sources_of_results(called, sources)
            source_of_variable.update(zip(eqn.outvars, results))
        elif len(distinct) == 1 and _is_elementwise(eqn, sources):
            source_of_variable.update(dict.fromkeys(eqn.outvars, distinct.pop()))
        else:
            raise _MixesEntries
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
        # A product with a single number, as in the derivative of `p @ p`, sums no entries.
        return len(tracked) == 1 and any(x.aval.size == 1 for x in eqn.invars)
    # These two keep the entries if they keep the shape, as they do here.
    if eqn.primitive.name in ("reshape", "broadcast_in_dim"):
        return True
    return eqn.primitive.name in _ELEMENTWISE
