"""Detects which inputs the results of a function depend on."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._compat import ClosedJaxpr, dce_jaxpr, Jaxpr, Literal, results_of_program


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


class _Source:
    """An input. Values that are no `_Source` depend on no input."""


class _MixesEntries(Exception):
    """Some operation mixes the entries of an input, or two inputs."""


def acts_elementwise(fn: Callable, x: PyTree[Array]) -> bool:
    """Whether each entry of `fn(x)`, in the structure of `x`, is known to depend on the
    same entry of `x` alone. Then its derivative is diagonal. The converse does not hold."""
    closed = jax.make_jaxpr(fn)(x)
    inputs = [_Source() for _ in closed.jaxpr.invars]
    try:
        results = _sources_of_results(closed, inputs)
    except _MixesEntries:
        return False
    pairs = zip(inputs, results)
    return all(result is x or not isinstance(result, _Source) for x, result in pairs)


def _sources_of_results(program: Any, sources: Sequence[Any]) -> list[Any]:
    """For each result of a program the input whose entries its own depend on, each on the
    same entry; no `_Source` if it depends on no input. Raises `_MixesEntries` if it depends
    on inputs in any other way. `sources` are those of the inputs of the program."""
    # Some operations hold the program with its constants, others without them.
    jaxpr = getattr(program, "jaxpr", program)
    # Operations that no result needs are left out, since they may mix entries: the
    # derivative of a product of all entries also computes the product.
    jaxpr, read_inputs = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    read_sources = [source for source, is_read in zip(sources, read_inputs) if is_read]
    closed = ClosedJaxpr(jaxpr, getattr(program, "consts", []))
    return results_of_program(closed, read_sources, _sources_of_operation)


def _sources_of_operation(eqn: Any, sources: list[Any]) -> list[Any]:
    """`_sources_of_results` for one operation."""
    distinct = {source for source in sources if isinstance(source, _Source)}
    if len(distinct) == 0:
        return [None for _ in eqn.outvars]
    if eqn.primitive.name in _CALLS:
        called = eqn.params.get("jaxpr", eqn.params.get("call_jaxpr"))
        if called is not None:
            return _sources_of_results(called, sources)
    if len(distinct) == 1 and _is_elementwise(eqn, sources):
        return [*distinct] * len(eqn.outvars)
    raise _MixesEntries


def _is_elementwise(eqn: Any, sources: list[Any]) -> bool:
    """Whether an operation keeps the entries of those arguments that have a source."""
    shape = eqn.outvars[0].aval.shape
    pairs = zip(eqn.invars, sources)
    tracked = [x for x, source in pairs if isinstance(source, _Source)]
    if any(x.aval.shape != shape for x in tracked):
        return False
    if eqn.primitive.name == "dot_general":
        # A product with a single number, as in the derivative of `p @ p`, sums no entries.
        return len(tracked) == 1 and any(x.aval.size == 1 for x in eqn.invars)
    # These two keep the entries if they keep the shape, as they do here.
    if eqn.primitive.name in ("reshape", "broadcast_in_dim"):
        return True
    return eqn.primitive.name in _ELEMENTWISE
