"""Whether `phi` may have kinks or jumps, by the operations that it is made of."""

from collections.abc import Callable

import jax
import jax.tree_util as jtu
from jaxtyping import PyTree

from .._compat import dce_jaxpr, Jaxpr, Literal, programs_in
from .._programs import once_for_each_signature
from .._simulation import Problem


# The operations of JAX with kinks or jumps. The others are smooth, except perhaps at single
# points, such as a square root at zero.
_NOT_SMOOTH = frozenset(
    "abs argmax argmin ceil clamp eq floor ge gt le lt max min ne reduce_max reduce_min "
    "round sign sort top_k".split()
)


@once_for_each_signature
def has_kinks(problem: Problem) -> bool:
    """Whether the problem's `phi` may not be smooth."""
    return may_have_kinks(
        lambda y: problem.phi(problem.t0, y, problem.args), problem.y0
    )


def may_have_kinks(fn: Callable, y: PyTree) -> bool:
    """Whether `fn(y)` depends on an operation on `y` that is not smooth, such as `abs`, a
    maximum or a comparison. Some functions with such operations are smooth all the same."""
    leaves, treedef = jtu.tree_flatten(y)
    traced = jax.make_jaxpr(lambda *leaves: fn(treedef.unflatten(leaves)))(*leaves)
    return _may_be_rough(traced.jaxpr)


def _may_be_rough(jaxpr: Jaxpr) -> bool:
    """Whether the results of a program depend on an operation that is not smooth, applied
    to variables that depend on its inputs."""
    # Leave out operations that no result needs, such as a comparison for a message.
    jaxpr, _ = dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars))
    # The variables that depend on an input. (Arrays that the function captures do not.)
    dependent = set(jaxpr.invars)
    for eqn in jaxpr.eqns:
        operands = [x for x in eqn.invars if not isinstance(x, Literal)]
        if not any(x in dependent for x in operands):
            continue
        dependent.update(eqn.outvars)
        is_rough = eqn.primitive.name in _NOT_SMOOTH
        if is_rough or any(map(_may_be_rough, programs_in(eqn))):
            return True
    return False
