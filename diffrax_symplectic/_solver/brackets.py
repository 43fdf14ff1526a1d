"""Vector fields times Lévy areas: the Lie brackets of noises, and of drift and noise."""

import functools as ft
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from .._brownian import zeros_and_unravel
from .._compat import ω
from .._custom_types import Args, RealScalarLike, Y
from .._terms import control_struct, tree_sum


@eqx.filter_jit
def apply_brackets(
    term: diffrax.AbstractTerm,
    A: Float[Array, "m m"],
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """`sum_{k<l} A_kl [b_k, b_l]`, with the Lie brackets `Db_l b_k - Db_k b_l` of the
    vector fields of one term.

    For antisymmetric `A` this is `sum_l Db_l (sum_k A_kl b_k)`, with `m` derivatives.
    """
    _, unravel = zeros_and_unravel(control_struct(term))

    def field(increments: Float[Array, " m"], y: Y) -> Y:
        return term.vf_prod(t, y, args, unravel(increments))

    def summand(column: Float[Array, " m"], unit: Float[Array, " m"]) -> Y:
        """That of one `l`, from the column `A_kl` and the unit vector of `l`."""
        b_l = ft.partial(field, unit)
        return jax.jvp(b_l, (y,), (field(column, y),))[1]

    # NumPy's, a constant that XLA folds, unlike `jnp.eye`.
    units: Any = np.eye(len(A), dtype=A.dtype)
    return _total(jax.vmap(summand)(A.T, units), len(A))


def bridge_coefficients(
    h: RealScalarLike, W: PyTree, H: PyTree, K: PyTree | None
) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
    r"""$H_k$ and $L_{kl} / h$ of [`diffrax_symplectic.PlateauGauss`][] for `m` noises,
    given the space-time areas, and space-time-time areas unless `K` is `None`.

    A Brownian bridge is $6 u (1 - u) H + 120 u (1 - u) (\frac12 - u) K$ with $u = s / h$
    plus an independent remainder. The time average of its mean square is $h / 15$ without
    the second summand, and $3 h / 70$ with it.
    """
    W_k, _ = jfu.ravel_pytree(W)
    H_k, _ = jfu.ravel_pytree(H)
    # In a solve backward in time steps are negative, and the mean square is not.
    size = jnp.abs(h).astype(H_k.dtype)
    of_remainder = jnp.eye(H_k.size, dtype=H_k.dtype) * size
    # Each summand is half of the time average of a square.
    L_kl = 3 / 5 * jnp.outer(H_k, H_k)
    if K is None:
        return H_k, L_kl + of_remainder / 30
    K_k, _ = jfu.ravel_pytree(K)
    mixed = jnp.outer(W_k, K_k)
    squares = 60 / 7 * jnp.outer(K_k, K_k)
    L_kl = L_kl + squares - (mixed + mixed.T) / 2
    return H_k, L_kl + 3 / 140 * of_remainder


@eqx.filter_jit
def apply_bridge(
    drift: jtu.Partial,
    noise: tuple[diffrax.AbstractTerm, ...],
    bridge_coefficients: tuple[Float[Array, " m"], Float[Array, "m m"]],
    h: RealScalarLike,
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """`sum_k H_k [b_k, A] + sum_{k, l} L_kl [b_k, [b_l, A]]`, where `A(t, y) = drift(t, y)`
    is the drift times `h`, and `[b, A] = A' b - b' A`. Time is treated as a component of
    the state that the drift advances by `h`. Computes `m` double brackets for `m` noises.
    """
    _, unravel = zeros_and_unravel([control_struct(term) for term in noise])
    t = jnp.asarray(t, jnp.result_type(h))
    areas, _ = bridge_coefficients

    def b(increments: Float[Array, " m"], t: Array, y: Y) -> Y:
        """The noise with these increments."""
        pairs = zip(noise, unravel(increments))
        return tree_sum([term.vf_prod(t, y, args, control) for term, control in pairs])

    def bracket(
        increments: Float[Array, " m"], field: Callable, t: Array, y: Y, speed: Array
    ) -> tuple[Y, Y]:
        """`[b, field]`, where `field` advances time by `speed`; and `field` itself."""
        along = b(increments, t, y)
        value, change = jax.jvp(lambda y: field(t, y), (y,), (along,))
        noise_of = ft.partial(b, increments)
        _, carried = jax.jvp(noise_of, (t, y), (speed, value))
        return (change**ω - carried**ω).ω, value

    def with_drift(unit: Float[Array, " m"], t: Array, y: Y) -> Y:
        """`[b_k, A]` for the noise `k` of this unit vector."""
        return bracket(unit, drift, t, y, jnp.asarray(h, t.dtype))[0]

    def summand(unit: Float[Array, " m"], area: Array, column: Float[Array, " m"]) -> Y:
        """`[L_k . b, [b_k, A]] + H_k [b_k, A]`: the outer brackets of all noises with the
        inner one of `k` are one bracket, with their sum."""
        inner = ft.partial(with_drift, unit)
        # This bracket has no drift, so that it leaves the time.
        double, single = bracket(column, inner, t, y, jnp.zeros_like(t))
        return (double**ω + area * single**ω).ω

    units: Any = np.eye(areas.size, dtype=areas.dtype)
    return _total(jax.vmap(summand)(units, *bridge_coefficients), len(units))


def _total(summands: Y, m: int) -> Y:
    """The sum of `m` summands, unrolled, so that XLA fuses it with its uses: a reduction
    over the axis made a step of 8,000 paths three times slower."""
    return tree_sum([jtu.tree_map(lambda x: x[k], summands) for k in range(m)])
