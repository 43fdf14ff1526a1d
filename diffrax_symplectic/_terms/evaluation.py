"""Calls of the user's functions, with advice on their errors."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._arguments import is_numeric, shapes
from .._custom_types import Args
from .._programs import note_call


# Errors of a function that needs the values of its arguments while JAX traces it.
NEED_VALUES = (
    jax.errors.ConcretizationTypeError,
    jax.errors.NonConcreteBooleanIndexError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)


def call_user_function(
    name: str, function: Callable, *inputs: PyTree, args: Args
) -> Any:
    """Returns `function(*inputs, args)`, where `function` is the user's argument `name`.
    Errors that it raises while JAX traces it are raised with advice."""
    # The function gets a copy of the containers in `args`. If it modifies them in place,
    # the next trace still gets the original `args`.
    copy = jtu.tree_map(lambda leaf: leaf, args)
    # Inside of `current_traces` this records that a trace depends on the function.
    note_call(function, *inputs, copy)
    try:
        return function(*inputs, copy)
    except NEED_VALUES as error:
        raise ValueError(
            f"`{name}` needs concrete values while JAX traces it, in an `if`, `while`, "
            "`float`, an index `x[x > 0]`, or a NumPy function. Write `jnp.where(a, b, c)` "
            "or `jax.lax.cond` instead of `if`, and `jnp` instead of `np`."
        ) from error
    except (TypeError, AttributeError) as error:
        # Notes say what in `args` may be the cause.
        # Errors of Python and JAX about `None` name its type.
        if args is None and "NoneType" in str(error):
            error.add_note(f"`{name}` was called with `args=None`. Was it left out?")
        # `args` may hold strings, with which a function can select, but not compute.
        kinds = {type(x).__name__ for x in jtu.tree_leaves(args) if not is_numeric(x)}
        if kinds:
            error.add_note(f"`args` hold no numbers, but {', '.join(sorted(kinds))}.")
        raise


def checked_energy(name: str, H: Callable, *inputs: PyTree, args: Args) -> Array:
    """The value of a Hamiltonian, `H(*inputs, args)`, as a float, where `H` is the user's
    argument `name`. Raises a `ValueError` if the value is not a real scalar."""
    energy = call_user_function(name, H, *inputs, args=args)
    if not jtu.all_leaves([energy]) or jnp.shape(energy) != ():
        raise ValueError(
            f"`{name}` must return a scalar; got shape {shapes(energy)}. Sum over the "
            "degrees of freedom. (For a batch of paths write it for one path, and "
            "`jax.vmap` the solve.)"
        )
    check_real_energies(name, energy)
    # `jax.grad` refuses integers, such as `0` for a system without energy.
    return jnp.asarray(energy, jnp.result_type(energy, float))


def check_real_energies(name: str, energies: PyTree[Array]) -> None:
    """Raises a `ValueError` unless `energies`, the values of the user's argument `name`,
    are real."""
    leaves = jtu.tree_leaves(energies)
    if not all(eqx.is_array_like(x) and not jnp.iscomplexobj(x) for x in leaves):
        raise ValueError(
            f"`{name}` must return real numbers; got {eqx.tree_pformat(energies)}. Take "
            "`jnp.real` of numbers that are mathematically real, such as <psi| A |psi>."
        )
