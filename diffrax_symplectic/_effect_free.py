"""Runs programs without their effects. In this way a user's function can be evaluated at
points that the user never chose: nothing is printed, no error is raised, and no function is
called back in Python."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from ._compat import ClosedJaxpr, Jaxpr, JaxprEqn, Literal


_CALLBACKS = ("pure_callback", "io_callback")
_BRANCHES_AND_LOOPS = ("cond", "scan", "while")


def evaluate_without_effects(jaxpr: Jaxpr, consts, args) -> list:
    """What `jaxpr` computes from `args`.

    Prints are left out. The results of callbacks are NaN. Since `equinox.error_if` raises
    by a callback, what goes through a check that fails is NaN as well.
    """
    values = dict(zip((*jaxpr.constvars, *jaxpr.invars), (*consts, *args)))
    read = lambda x: x.val if isinstance(x, Literal) else values[x]
    for eqn in jaxpr.eqns:
        results = _apply(eqn, [read(x) for x in eqn.invars])
        values.update(zip(eqn.outvars, results))
    return [read(x) for x in jaxpr.outvars]


def _apply(eqn: JaxprEqn, inputs: list) -> list:
    name, params = eqn.primitive.name, eqn.params
    if name in _CALLBACKS:
        return [_nan(x.aval) for x in eqn.outvars]
    if _is_call(eqn):
        (inner,) = _programs(params)
        return _run(inner, *inputs)
    if len(eqn.outvars) == 0:
        # It can only be there for its effects, such as printing.
        return []
    if name in _BRANCHES_AND_LOOPS and _has_effects(eqn):
        params = {key: _without_effects(value) for key, value in params.items()}
    out = eqn.primitive.bind(*inputs, **params)
    return out if eqn.primitive.multiple_results else [out]


def _without_effects(value: Any) -> Any:
    """A parameter of a primitive, with all programs in it replaced."""
    if isinstance(value, tuple):
        return tuple(map(_without_effects, value))
    if not isinstance(value, ClosedJaxpr):
        return value
    return jax.make_jaxpr(lambda *x: _run(value, *x))(*value.in_avals)


def _run(program, *args) -> list:
    if isinstance(program, ClosedJaxpr):
        return evaluate_without_effects(program.jaxpr, program.consts, args)
    return evaluate_without_effects(program, (), args)


def _nan(aval) -> Any:
    inexact = jnp.issubdtype(aval.dtype, jnp.inexact)
    return jnp.full(aval.shape, jnp.nan if inexact else 0, aval.dtype)


def _is_call(eqn: JaxprEqn) -> bool:
    """Whether a primitive stands for the one program that it holds, as those of `jax.jit`,
    `jax.checkpoint` and `jax.custom_jvp` do: inputs and outputs are then those of the
    program."""
    programs = list(_programs(eqn.params))
    if len(programs) != 1 or eqn.primitive.name in _BRANCHES_AND_LOOPS:
        return False
    program = getattr(programs[0], "jaxpr", programs[0])
    kinds = lambda variables: [(x.aval.shape, x.aval.dtype) for x in variables]
    same_inputs = kinds(program.invars) == kinds(eqn.invars)
    return same_inputs and kinds(program.outvars) == kinds(eqn.outvars)


def _has_effects(eqn: JaxprEqn) -> bool:
    return (
        eqn.primitive.name in _CALLBACKS
        or len(eqn.outvars) == 0
        or any(
            _has_effects(inner)
            for program in _programs(eqn.params)
            for inner in getattr(program, "jaxpr", program).eqns
        )
    )


def _programs(params: dict) -> Iterator[Any]:
    """The programs among the parameters of a primitive."""
    for value in params.values():
        for item in value if isinstance(value, tuple | list) else (value,):
            if isinstance(item, Jaxpr | ClosedJaxpr):
                yield item
