"""What the results of a program depend on, by the flow of data through it.

The answer holds for all values: a result that is said not to depend on an input does not.
The converse fails where variables cancel, as in `x - x`, which is said to depend on `x`.
"""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Bool, PyTree

from .._compat import ClosedJaxpr, inner_programs, Jaxpr, JaxprEqn, Literal


# What is known of a value, the larger the less. A product with zero is zero, since values
# are finite; but what was reached stays so, even times zero.
_ZERO, _FIXED, _DEPENDENT, _REACHED = range(4)
# Of a whole array, or where arrays were joined, of each of its entries.
_Known: TypeAlias = int | np.ndarray

# Zero times anything is zero.
_PRODUCTS = {"conv_general_dilated", "dot_general", "mul"}
# Zero if all operands are zero.
_KEEP_ZERO = {
    "add", "add_any", "broadcast_in_dim", "concatenate", "convert_element_type", "copy",
    "cumsum", "dynamic_slice", "expand_dims", "gather", "neg", "pad", "reduce_sum",
    "reshape", "rev", "scatter-add", "select_n", "slice", "split", "squeeze", "stack",
    "sub", "transpose",
}  # fmt: skip
_JOIN = {"concatenate", "stack"}


class DataFlow:
    """The program of `fn(*inputs)`, traced once, to be asked what depends on what."""

    def __init__(self, fn: Callable, *inputs: PyTree):
        closed, out = jax.make_jaxpr(fn, return_shape=True)(*inputs)
        self._closed, self._out, self._inputs = closed, out, inputs

    def independent(self, of: Callable, part: Callable = lambda out: out) -> bool:
        """Whether `part(result)` does not depend on `of(*inputs)`, two PyTrees of arrays:
        it is the same whatever values these arrays have."""
        found = self._follow(of, _DEPENDENT)
        asked = _marked(part, self._out)
        return all(_most([x]) < _DEPENDENT for x, mark in zip(found, asked) if mark)

    def reached(self, of: Callable) -> list[Bool[np.ndarray, "..."]]:
        """Which entries of each array of the result are computed from `of(*inputs)`, as
        products with zero are, too."""
        shapes = [jnp.shape(x) for x in jtu.tree_leaves(self._out)]
        found = self._follow(of, _REACHED)
        levels = [np.broadcast_to(x, s) for x, s in zip(found, shapes)]
        return [np.asarray(x >= _DEPENDENT) for x in levels]

    def _follow(self, of: Callable, level: int) -> Sequence[_Known]:
        marked = _marked(lambda inputs: of(*inputs), self._inputs)
        known: list[_Known] = [level if mark else _FIXED for mark in marked]
        return _flow(self._closed.jaxpr, _constants(self._closed.consts), known)


def _marked(select: Callable, tree: PyTree) -> list[bool]:
    """Which leaves of the tree are those of `select(tree)`."""
    treedef = jtu.tree_structure(tree)
    numbers = treedef.unflatten(range(treedef.num_leaves))
    chosen = set(jtu.tree_leaves(select(numbers)))
    return [i in chosen for i in range(treedef.num_leaves)]


def _constants(values) -> list[_Known]:
    return [_FIXED if isinstance(x, jax.core.Tracer) else _constant(x) for x in values]


def _constant(value: Any) -> int:
    number = jnp.issubdtype(jnp.result_type(value), np.number)
    here = getattr(value, "is_fully_addressable", True)
    return _ZERO if number and here and not np.any(np.asarray(value)) else _FIXED


def _flow(
    jaxpr: Jaxpr, constants: list[_Known], known: Sequence[_Known]
) -> Sequence[_Known]:
    """What is known of the results, from what is known of the inputs."""
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *known)))
    read = lambda x: _constant(x.val) if isinstance(x, Literal) else values[x]
    for eqn in jaxpr.eqns:
        if not all(isinstance(x.aval, jax.core.ShapedArray) for x in eqn.invars):
            # Through memory that is written to, data flow unseen.
            return [_REACHED] * len(jaxpr.outvars)
        values.update(zip(eqn.outvars, _through(eqn, [read(x) for x in eqn.invars])))
    return [read(x) for x in jaxpr.outvars]


def _through(eqn: JaxprEqn, known: Sequence[_Known]) -> Sequence[_Known]:
    name, params = eqn.primitive.name, eqn.params
    each = [_most([x]) for x in known]
    if name == "scan":
        first = params["num_consts"]
        return _loop(params["jaxpr"], each, first, first + params["num_carry"])
    if name == "while":
        return _while(params, each)
    if name == "cond":
        index, *operands = each
        branches = [_run(branch, operands) for branch in params["branches"]]
        return _decided(index, [_most(x) for x in zip(*branches)])
    programs = list(inner_programs(eqn))
    if len(programs) == 1 and _is_call(eqn, programs[0]):
        return _run(programs[0], known)
    most = _most(each)
    if name in _PRODUCTS and _ZERO in each and most < _REACHED:
        return [_ZERO]
    if any(map(np.ndim, known)) or name in _JOIN and len(set(each)) > 1:
        shape = lambda v: v.aval.shape
        arrays = [np.broadcast_to(x, shape(v)) for x, v in zip(known, eqn.invars)]
        if entries := _of_entries(eqn, arrays):
            return entries
    return [most if name in _KEEP_ZERO else max(most, _FIXED)] * len(eqn.outvars)


def _decided(by: int, known: Sequence[int]) -> list[_Known]:
    """What is known of results among which a value chooses."""
    return [by if by >= _DEPENDENT else x for x in known]


def _of_entries(eqn: JaxprEqn, known: list[np.ndarray]) -> list[_Known]:
    """What is known of each entry, or nothing if this primitive is not among those that
    move entries or combine them one by one."""
    params, first, shape = eqn.params, known[0], lambda v: v.aval.shape
    match eqn.primitive.name:
        case "concatenate":
            return [np.concatenate(known, params["dimension"])]
        case "stack":
            return [np.stack(known, params["axis"])]
        case "slice":
            ends = params["start_indices"], params["limit_indices"]
            strides = params["strides"] or [1] * first.ndim
            return [first[tuple(map(slice, *ends, strides))]]
        case "split":
            ends = np.cumsum(params["sizes"])[:-1]
            return [*np.split(first, ends, params["axis"])]
        case "reshape" | "squeeze" | "expand_dims":
            return [first.reshape(shape(eqn.outvars[0]))]
        case "add" | "add_any" | "sub" | "mul" | "neg" | "convert_element_type":
            return [np.max(np.broadcast_arrays(*known), 0)]
    return []


def _most(known: Iterable[_Known]) -> int:
    return max((int(np.max(x, initial=_ZERO)) for x in known), default=_FIXED)


def _loop(
    body: ClosedJaxpr, known: Sequence[int], first: int, last: int
) -> Sequence[int]:
    """What is known once the carried values, inputs `first` to `last` of the body and its
    first outputs, have gone round as often as it takes."""
    while True:
        out = [_most([x]) for x in _run(body, known)]
        carried = [max(x) for x in zip(known[first:last], out)]
        if carried == list(known[first:last]):
            return [*carried, *out[last - first :]]
        known = [*known[:first], *carried, *known[last:]]


def _while(params: dict, known: Sequence[int]) -> Sequence[_Known]:
    n = params["cond_nconsts"]
    m = params["body_nconsts"]
    carried = _loop(params["body_jaxpr"], known[n:], m, len(known) - n)
    # How often the loop runs decides on all that it carries.
    (again,) = _run(params["cond_jaxpr"], [*known[:n], *carried])
    return _decided(_most([again]), carried)


def _run(program: Jaxpr | ClosedJaxpr, known: Sequence[_Known]) -> Sequence[_Known]:
    if isinstance(program, ClosedJaxpr):
        return _flow(program.jaxpr, _constants(program.consts), known)
    return _flow(program, [], known)


def _is_call(eqn: JaxprEqn, program: Jaxpr | ClosedJaxpr) -> bool:
    """Whether a primitive stands for the one program that it holds, as those of `jax.jit`,
    `jax.checkpoint` and `jax.custom_jvp` do: inputs and outputs are then those of the
    program."""
    inner = program.jaxpr if isinstance(program, ClosedJaxpr) else program
    kinds = lambda variables: [(x.aval.shape, x.aval.dtype) for x in variables]
    same = lambda a, b: len(a) == len(b) and kinds(a) == kinds(b)
    return same(inner.invars, eqn.invars) and same(inner.outvars, eqn.outvars)
