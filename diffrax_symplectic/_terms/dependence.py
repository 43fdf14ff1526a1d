"""Detects which inputs the results of a function depend on, from its program in JAX."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._compat import ClosedJaxpr, dce_jaxpr, Jaxpr, Literal, results_of_program


class Dependence:
    """Which inputs the results of `fn(*inputs)` depend on. `fn` is traced once.

    A result does not depend on an input that JAX's dead-code elimination removes from the
    program for this result. That holds for all values of the inputs. The converse does not
    hold: inputs that cancel, as in `x - x`, or that are multiplied by zero count as read.
    Arrays are tracked as a whole, not entry by entry.
    """

    def __init__(self, fn: Callable, *inputs: PyTree):
        closed, self._out = jax.make_jaxpr(fn, return_shape=True)(*inputs)
        self._jaxpr = _without_powers_of_zero(closed.jaxpr)
        self._inputs = inputs

    def independent(self, of: Callable, part: Callable = lambda out: out) -> bool:
        """Whether the arrays `part(result)` are independent of the arrays `of(*inputs)`,
        where `result` is `fn(*inputs)`."""
        is_in_part = _which_are_selected(part, self._out)
        # The program for these results alone may read fewer inputs than the whole one.
        _, is_read = dce_jaxpr(self._jaxpr, is_in_part)
        is_asked = _which_are_selected(lambda inputs: of(*inputs), self._inputs)
        return not any(read and asked for read, asked in zip(is_read, is_asked))


def _without_powers_of_zero(jaxpr: Jaxpr) -> Jaxpr:
    """The program with `1**0` in place of `x**0`, also within the programs that it calls.

    In some versions of JAX the second derivative of `x**2` contains `x**0`, by which it
    would seem to depend on `x`."""

    def without_power(eqn: Any) -> Any:
        if eqn.primitive.name == "integer_pow" and eqn.params["y"] == 0:
            (operand,) = eqn.invars
            return eqn.replace(invars=[Literal(1.0, operand.aval)])
        if eqn.primitive.name in _CALLS and "jaxpr" in eqn.params:
            closed = eqn.params["jaxpr"]
            called = closed.replace(jaxpr=_without_powers_of_zero(closed.jaxpr))
            return eqn.replace(params=eqn.params | {"jaxpr": called})
        return eqn

    return jaxpr.replace(eqns=[without_power(eqn) for eqn in jaxpr.eqns])


def _which_are_selected(select: Callable, tree: PyTree) -> list[bool]:
    """For each leaf of `tree`, in order, whether it is a leaf of `select(tree)`."""
    # Leaves may be equal, or have no values. So `select` gets a tree in which each leaf is
    # replaced by its number.
    treedef = jtu.tree_structure(tree)
    tree_of_numbers = treedef.unflatten(range(treedef.num_leaves))
    selected_numbers = set(jtu.tree_leaves(select(tree_of_numbers)))
    return [number in selected_numbers for number in range(treedef.num_leaves)]


# Operations that act entry by entry, as far as they occur in functions that are linear in
# an input. All others count as mixing entries, since a list of operations that mix entries
# would grow with each release of JAX.
_ELEMENTWISE = frozenset(
    "add add_any convert_element_type copy div integer_pow mul neg select_n sub".split()
)
# Operations that call another program, which is one of their parameters.
_CALLS = frozenset({"jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"})


class _Source:
    """Stands for an input, as the source of the values that depend on it entry by entry.
    Values that depend on no input have any other object in the place of a source: `None`,
    or the value itself if it is a constant of the program."""


class _MixesEntries(Exception):
    """Some operation mixes the entries of an input, or two inputs."""


def acts_elementwise(fn: Callable, x: PyTree[Array]) -> bool:
    """Whether each entry of `fn(x)`, in the structure of `x`, is known to depend only on
    the same entry of `x`, so that the derivative is diagonal. If false, it may be so all
    the same.

    Each array in `x` gets a token, a `_Source`. The tokens are followed through the program
    of `fn`, as long as operations act entry by entry. The result is true if each array in
    `fn(x)` ends up with the token of its own array in `x`, or with none."""
    closed = jax.make_jaxpr(fn)(x)
    inputs = [_Source() for _ in closed.jaxpr.invars]
    try:
        results = _sources_of_results(closed, inputs)
    except _MixesEntries:
        return False
    pairs = zip(inputs, results)
    # A derivative is also diagonal if it is zero, for a result without a source.
    return all(
        result is own or not isinstance(result, _Source) for own, result in pairs
    )


def _sources_of_results(program: Any, sources: Sequence[Any]) -> list[Any]:
    """The source of each result of a program, for the `sources` of its inputs.

    A source is the input on which a value depends, each entry of the value on the same
    entry of the input. Raises `_MixesEntries` if a result depends on inputs in any other
    way."""
    # Some operations hold the program with its constants, others without them.
    jaxpr = getattr(program, "jaxpr", program)
    # Operations that no result needs are left out, since they may mix entries. The gradient
    # of `sum(x**2)` also computes the sum, for example.
    jaxpr, read_inputs = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    read_sources = [source for source, is_read in zip(sources, read_inputs) if is_read]
    closed = ClosedJaxpr(jaxpr, getattr(program, "consts", []))
    return results_of_program(closed, read_sources, _sources_of_operation)


def _sources_of_operation(eqn: Any, sources: list[Any]) -> list[Any]:
    """The source of each result of one operation, for the `sources` of its arguments.
    Raises `_MixesEntries` if the operation may mix entries or inputs."""
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
    """Whether an operation is known to act entry by entry on those arguments that have a
    source. Each of them then has the shape of the result."""
    shape = eqn.outvars[0].aval.shape
    pairs = zip(eqn.invars, sources)
    tracked = [x for x, source in pairs if isinstance(source, _Source)]
    if any(x.aval.shape != shape for x in tracked):
        return False
    if eqn.primitive.name == "dot_general":
        # A product with an array of one number, as in the derivative of `p @ p`, sums no
        # entries.
        return len(tracked) == 1 and any(x.aval.size == 1 for x in eqn.invars)
    # These two act entry by entry if they keep the shape, as they do here.
    if eqn.primitive.name in ("reshape", "broadcast_in_dim"):
        return True
    return eqn.primitive.name in _ELEMENTWISE
