"""Runs programs without their effects. A user's function can so be evaluated at points that
the user never chose, without printing, raising errors, or calling back into Python."""

from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
from jax import lax

from ._compat import ClosedJaxpr, Jaxpr, JaxprEqn, Literal


_CALLBACKS = ("pure_callback", "io_callback")


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
    if _has_effects(eqn):
        if name == "cond":
            branches = [lambda *x, b=b: _run(b, *x) for b in params["branches"]]
            return lax.switch(inputs[0], branches, *inputs[1:])
        if name == "scan":
            return _scan(params, inputs)
        if name == "while":
            return _while(params, inputs)
    if len(eqn.outvars) == 0:
        # It can only be there for its effects, such as printing.
        return []
    out = eqn.primitive.bind(*inputs, **params)
    return out if eqn.primitive.multiple_results else [out]


def _scan(params: dict, inputs: list) -> list:
    consts, carry, xs = _split(inputs, params["num_consts"], params["num_carry"])

    def body(carry, x):
        out = _run(params["jaxpr"], *consts, *carry, *x)
        return out[: len(carry)], out[len(carry) :]

    carry, ys = lax.scan(body, carry, xs, params["length"], params["reverse"])
    return [*carry, *ys]


def _while(params: dict, inputs: list) -> list:
    of_cond, of_body, carry = _split(
        inputs, params["cond_nconsts"], params["body_nconsts"]
    )
    proceed = lambda carry: _run(params["cond_jaxpr"], *of_cond, *carry)[0]
    body = lambda carry: _run(params["body_jaxpr"], *of_body, *carry)
    return lax.while_loop(proceed, body, carry)


def _split(inputs: list, first: int, second: int) -> tuple[list, list, list]:
    return inputs[:first], inputs[first : first + second], inputs[first + second :]


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
    if len(programs) != 1 or eqn.primitive.name in ("cond", "scan", "while"):
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
