"""Numbers that the precision of the state cannot hold, as in SI units in float32."""

import functools as ft
import itertools
from collections.abc import Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from .._compat import CALLS, results_of_operation, results_of_program
from .._custom_types import Y
from .._simulation import Problem
from .._terms import BathNoise, control_struct, split_terms


# Operations whose results may be out of range where their arguments are not, and signs for
# them in messages.
_ARITHMETIC = {"mul": "*", "div": "/", "integer_pow": "to a power", "square": "squared"}


def out_of_range(problem: Problem, all_fail: bool) -> str | None:
    """A warning that names an argument that counts as zero or infinite in its precision. If
    there is no such argument, but all paths fail, it names an operation whose result is out
    of range where paths start. `None` if there is no such operation, either."""
    precision = jnp.finfo(problem.dtype)
    found = next(_lost_arguments(problem), None)
    if found is None and all_fail:
        found = _lost_on_the_way(problem)
    if found is None:
        return None
    more_digits = ""
    if jnp.result_type(float) == jnp.float32:
        more_digits = 'Call `jax.config.update("jax_enable_x64", True)` first, or '
    elif precision.bits < 64:
        more_digits = "Pass `y0` and what goes with it in float64, or "
    advice = f"{more_digits}choose units in which these numbers are near 1."
    return f"In {precision.dtype}, {found}. {advice[0].upper()}{advice[1:]}"


def _lost_arguments(problem: Problem) -> Iterator[str]:
    """Names each argument with an array whose largest number, in size, is not zero but
    counts as zero, or is finite but counts as infinite."""
    arguments = {"y0": problem.y0, "args": problem.args, "dt0": problem.levels.h[0]}
    _, noise = split_terms(problem.terms)
    for term in noise:
        if isinstance(term, BathNoise):
            arguments |= {"friction": term.friction, "temperature": term.temperature}
    for name, value in arguments.items():
        for leaf in filter(_is_float, jtu.tree_leaves(value)):
            # Numbers of Python have the precision of the state.
            precision = jnp.finfo(jnp.result_type(leaf, problem.dtype))
            size = float(np.max(np.abs(_in_float64(leaf)), initial=0))
            # Numbers below `tiny` have fewer digits, and most processors take them for
            # zero. (NumPy would convert `size` to single precision, with a warning.)
            if 0 < size < float(precision.tiny):
                yield f"`{name}` of {size:.2g} counts as zero"
            if float(precision.max) < size < np.inf:
                yield f"`{name}` of {size:.2g} counts as infinite"


def is_finite_at_start(problem: Problem) -> bool:
    """Whether the change of the state and `phi` are finite where paths start."""
    values = jtu.tree_leaves(_first_evaluation(problem, problem.y0))
    return all(np.all(np.isfinite(_in_float64(x))) for x in values)


def _first_evaluation(problem: Problem, y0: Y) -> tuple[list[PyTree], PyTree]:
    """The change of the state by each term, with increments of one, and `phi`, where paths
    start, from `y0`."""
    t0, args = problem.t0, problem.args
    changes = []
    for term in itertools.chain(*split_terms(problem.terms)):
        struct = control_struct(term, t0)
        control = jtu.tree_map(lambda x: jnp.ones(x.shape, x.dtype), struct)
        changes.append(term.vf_prod(t0, y0, args, control))
    return changes, problem.phi(t0, y0, args)


def _lost_on_the_way(problem: Problem) -> str | None:
    """Names the first operation whose result is out of range, if the change of the state or
    `phi` is not finite at the start; `None` otherwise. To look at the results in between,
    the change and `phi` are evaluated one operation after another."""
    if is_finite_at_start(problem):
        return None
    losses: list[str | None] = []

    def results_of(eqn: Any, values: list[Any]) -> Sequence[Any]:
        name = eqn.primitive.name
        # A call of another program, whose operations are evaluated one by one, too.
        if name in CALLS:
            return results_of_program(eqn.params[CALLS[name]], values, results_of)
        results = results_of_operation(eqn, values, eqn.params)
        if name in _ARITHMETIC and _is_float(results[0]):
            losses.append(_loss(name, values, results[0]))
        return results

    traced = jax.make_jaxpr(ft.partial(_first_evaluation, problem))(problem.y0)
    results_of_program(traced, jtu.tree_leaves(problem.y0), results_of)
    return next(filter(None, losses), None)


def _loss(name: str, values: list[Any], result: Any) -> str | None:
    """Says of an arithmetic operation which entry of its result overflowed or underflowed,
    such as `1e-30 * 1e-30 is 0`: the first; `None` if no entry did."""
    results = _in_float64(result)
    operands = [np.broadcast_to(_in_float64(x), results.shape) for x in values]
    # If an operand is already zero or infinite, the result may be so with nothing lost.
    is_in_range = np.all([np.isfinite(x) & (x != 0) for x in operands], axis=0)
    is_lost = is_in_range & ((results == 0) | ~np.isfinite(results))
    if not np.any(is_lost):
        return None
    texts = [f"{operand[is_lost][0]:.2g}" for operand in operands]
    sign = _ARITHMETIC[name]
    formula = f" {sign} ".join(texts) if len(texts) > 1 else f"{texts[0]} {sign}"
    return f"{formula} is {'0' if results[is_lost][0] == 0 else 'infinite'}"


def _is_float(x: Any) -> bool:
    """Whether this is an array or number of floating point. (Arguments may also hold
    integers and functions.)"""
    return eqx.is_array_like(x) and jnp.issubdtype(jnp.result_type(x), jnp.floating)


def _in_float64(x: Any) -> np.ndarray:
    return np.asarray(x).astype(float)
