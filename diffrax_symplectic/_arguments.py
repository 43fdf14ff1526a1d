"""Checks of what a user passes."""

import inspect
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree


def check_takes(name: str, fn: Any, *arguments: str) -> None:
    """Raises a `ValueError` unless `fn` can be called with these arguments."""
    call = f"`{name}({', '.join(arguments)})`"
    if not callable(fn):
        raise ValueError(f"`{name}` must be a function, called as {call}; got {fn!r}.")
    try:
        signature = inspect.signature(fn)
    except ValueError:
        return  # Some functions written in C have none.
    try:
        signature.bind(*arguments)
    except TypeError:
        raise ValueError(
            f"`{name}` is called as {call}; got a function of other arguments, "
            f"`{signature}`."
        ) from None


def check_solver(name: str, solver: Any) -> None:
    """Raises a `ValueError` unless this is a solver."""
    if isinstance(solver, diffrax.AbstractSolver):
        return
    example = "ImplicitMidpoint"
    if isinstance(solver, type) and issubclass(solver, diffrax.AbstractSolver):
        example = solver.__name__
    raise ValueError(f"`{name}` must be a solver, as `{example}()`; got {solver!r}.")


def whole_number(name: str, value: Any, least: int = 1) -> int:
    """Raises a `ValueError` unless this is an integer, `least` or larger."""
    integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not integer or value < least:
        kind = "a positive integer" if least == 1 else f"an integer, {least} or larger"
        raise ValueError(f"`{name}` must be {kind}; got {value!r}.")
    return int(value)


def shapes(tree: PyTree) -> str:
    """The shape of an array, or all shapes of a PyTree, for messages."""
    if jtu.all_leaves([tree]):
        return str(jnp.shape(tree))
    return eqx.tree_pformat(jax.eval_shape(lambda: tree), struct_as_array=True)
