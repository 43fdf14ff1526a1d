"""What the results of a program depend on, by the flow of data through it.

The answer holds for all values: a result that is said not to depend on an input does not.
The converse fails where variables cancel, as in `x - x`, which is said to depend on `x`.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from .._compat import ClosedJaxpr, inner_programs, Jaxpr, JaxprEqn, Literal


# What is known of a value, the larger the less. A product with zero is zero, since values
# are finite.
_ZERO, _FIXED, _DEPENDENT = range(3)

# Zero times anything is zero.
_PRODUCTS = {"conv_general_dilated", "dot_general", "mul"}
# Zero if all operands are zero.
_KEEP_ZERO = {
    "add", "add_any", "broadcast_in_dim", "concatenate", "convert_element_type", "copy",
    "cumsum", "dynamic_slice", "expand_dims", "gather", "neg", "pad", "reduce_sum",
    "reshape", "rev", "scatter-add", "select_n", "slice", "split", "squeeze", "sub",
    "transpose",
}  # fmt: skip


class DataFlow:
    """The program of `fn(*inputs)`, traced once, to be asked what depends on what."""

    def __init__(self, fn: Callable, *inputs: PyTree):
        closed, out = jax.make_jaxpr(fn, return_shape=True)(*inputs)
        self._closed, self._out, self._inputs = closed, out, inputs

    def independent(self, of: Callable, part: Callable = lambda out: out) -> bool:
        """Whether `part(result)` does not depend on `of(*inputs)`, two PyTrees of arrays:
        it is the same whatever values these arrays have."""
        marked = _marked(lambda inputs: of(*inputs), self._inputs)
        known = [_DEPENDENT if mark else _FIXED for mark in marked]
        found = _flow(self._closed.jaxpr, _constants(self._closed.consts), known)
        asked = _marked(part, self._out)
        return all(x < _DEPENDENT for x, mark in zip(found, asked) if mark)


def _marked(select: Callable, tree: PyTree) -> list[bool]:
    """Which leaves of the tree are those of `select(tree)`."""
    treedef = jtu.tree_structure(tree)
    numbers = treedef.unflatten(range(treedef.num_leaves))
    chosen = set(jtu.tree_leaves(select(numbers)))
    return [i in chosen for i in range(treedef.num_leaves)]


def _constants(values) -> list[int]:
    return [_FIXED if isinstance(x, jax.core.Tracer) else _constant(x) for x in values]


def _constant(value: Any) -> int:
    number = jnp.issubdtype(jnp.result_type(value), np.number)
    here = getattr(value, "is_fully_addressable", True)
    return _ZERO if number and here and not np.any(np.asarray(value)) else _FIXED


def _flow(jaxpr: Jaxpr, constants: list[int], known: list[int]) -> list[int]:
    """What is known of the results, from what is known of the inputs."""
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*constants, *known)))
    read = lambda x: _constant(x.val) if isinstance(x, Literal) else values[x]
    for eqn in jaxpr.eqns:
        if not all(isinstance(x.aval, jax.core.ShapedArray) for x in eqn.invars):
            # Through memory that is written to, data flow unseen.
            return [_DEPENDENT] * len(jaxpr.outvars)
        values.update(zip(eqn.outvars, _through(eqn, [read(x) for x in eqn.invars])))
    return [read(x) for x in jaxpr.outvars]


def _through(eqn: JaxprEqn, known: list[int]) -> list[int]:
    name, params = eqn.primitive.name, eqn.params
    if name == "scan":
        first = params["num_consts"]
        return _loop(params["jaxpr"], known, first, first + params["num_carry"])
    if name == "while":
        return _while(params, known)
    if name == "cond":
        index, *operands = known
        branches = [_run(branch, operands) for branch in params["branches"]]
        return [_DEPENDENT if index == _DEPENDENT else max(x) for x in zip(*branches)]
    programs = list(inner_programs(eqn))
    if len(programs) == 1 and _is_call(eqn, programs[0]):
        return _run(programs[0], known)
    most = max(known, default=_FIXED)
    if name in _PRODUCTS and _ZERO in known:
        most = _ZERO
    elif name not in _KEEP_ZERO:
        most = max(most, _FIXED)
    return [most] * len(eqn.outvars)


def _loop(body: ClosedJaxpr, known: list[int], first: int, last: int) -> list[int]:
    """What is known once the carried values, inputs `first` to `last` of the body and its
    first outputs, have gone round as often as it takes."""
    while True:
        out = _run(body, known)
        carried = [max(x) for x in zip(known[first:last], out)]
        if carried == known[first:last]:
            return [*carried, *out[last - first :]]
        known = [*known[:first], *carried, *known[last:]]


def _while(params: dict, known: list[int]) -> list[int]:
    n = params["cond_nconsts"]
    m = params["body_nconsts"]
    carried = _loop(params["body_jaxpr"], known[n:], m, len(known) - n)
    # How often the loop runs decides on all that it carries.
    (again,) = _run(params["cond_jaxpr"], [*known[:n], *carried])
    return [_DEPENDENT] * len(carried) if again == _DEPENDENT else carried


def _run(program: Jaxpr | ClosedJaxpr, known: list[int]) -> list[int]:
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
