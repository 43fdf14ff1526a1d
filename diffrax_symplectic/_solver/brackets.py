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

    def summand(A_l: Float[Array, " m"], unit: Float[Array, " m"]) -> Y:
        """`Db_l (sum_k A_kl b_k)` for one `l`, where `A_l` is the column `l` of the matrix,
        and `unit` the unit vector that selects `b_l`."""
        b_l = ft.partial(field, unit)
        _, derivative = jax.jvp(b_l, (y,), (field(A_l, y),))
        return derivative

    # A constant of NumPy, which XLA folds, unlike `jnp.eye`.
    units: Any = np.eye(len(A), dtype=A.dtype)
    return _total(jax.vmap(summand)(A.T, units), len(A))


def bridge_coefficients(
    h: RealScalarLike, W: PyTree, H: PyTree, K: PyTree | None
) -> tuple[Float[Array, " m"], Float[Array, "m m"]]:
    r"""The coefficients $H_k$ and $L_{kl} / h$ of [`diffrax_symplectic.PlateauGauss`][] for
    `m` noises, given their increments `W`, their space-time areas `H` and, unless it is
    `None`, their space-time-time areas `K`.

    Within a step, at the fraction $u$ of it, a Brownian path is the line $u W$ plus a
    bridge, and the bridge is $6 u (1 - u) H + 120 u (1 - u) (\frac12 - u) K$ plus an
    independent remainder. $L_{kl} / h$ is half of the average over $u$ of products of the
    parts of the paths $k$ and $l$: bridge times bridge, and line times summand of $K$. The
    mean square of the remainder, averaged over $u$, is $h / 15$ without the summand of $K$,
    and $3 h / 70$ with it.
    """
    W_k, _ = jfu.ravel_pytree(W)
    H_k, _ = jfu.ravel_pytree(H)
    # In a solve backward in time steps are negative, and the mean square is not.
    step_size = jnp.abs(h).astype(H_k.dtype)
    h_delta_kl = jnp.eye(H_k.size, dtype=H_k.dtype) * step_size
    # The averages over u, of which half enters:
    # - 6 / 5 for the square of the factor 6 u (1 - u) of H;
    # - 120 / 7 for the square of the factor of K;
    # - -1 for the product of u and the factor of K.
    L_over_h = 3 / 5 * jnp.outer(H_k, H_k)
    if K is None:
        return H_k, L_over_h + h_delta_kl / 30
    K_k, _ = jfu.ravel_pytree(K)
    W_K = jnp.outer(W_k, K_k)
    L_over_h = L_over_h + 60 / 7 * jnp.outer(K_k, K_k) - (W_K + W_K.T) / 2
    return H_k, L_over_h + 3 / 140 * h_delta_kl


@eqx.filter_jit
def apply_bridge(
    drift: jtu.Partial,
    noise: tuple[diffrax.AbstractTerm, ...],
    coefficients: tuple[Float[Array, " m"], Float[Array, "m m"]],
    h: RealScalarLike,
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """`sum_k H_k [b_k, A] + sum_{k, l} L_kl [b_k, [b_l, A]]`, with the Lie brackets `[b, A]
    = A' b - b' A` of the noises `b_k` and the drift times `h`, `A(t, y) = drift(t, y)`.
    Time is treated as a component of the state that the drift advances by `h`. The
    `coefficients` are `H_k` and the symmetric matrix `L_kl`, the second result of
    `bridge_coefficients`.

    Brackets are linear, so that for each `k` one outer bracket serves for all `l`. The
    summand of `k` is `[sum_l L_kl b_l, [b_k, A]] + H_k [b_k, A]`."""
    _, unravel = zeros_and_unravel([control_struct(term) for term in noise])
    t = jnp.asarray(t, jnp.result_type(h))
    H, _ = coefficients

    def b(increments: Float[Array, " m"], t: Array, y: Y) -> Y:
        """The noise `sum_k increments[k] b_k`."""
        pairs = zip(noise, unravel(increments))
        return tree_sum([term.vf_prod(t, y, args, control) for term, control in pairs])

    def bracket_and_field(
        increments: Float[Array, " m"], field: Callable, t: Array, y: Y, speed: Array
    ) -> tuple[Y, Y]:
        """The bracket `[b, field] = field' b - b' field` of the noise `b` with these
        increments and a vector field that advances time by `speed`; and `field(t, y)`."""
        noise_value = b(increments, t, y)
        value, change_of_field = jax.jvp(lambda y: field(t, y), (y,), (noise_value,))
        b_of_increments = ft.partial(b, increments)
        _, change_of_noise = jax.jvp(b_of_increments, (t, y), (speed, value))
        return (change_of_field**ω - change_of_noise**ω).ω, value

    def drift_bracket(unit: Float[Array, " m"], t: Array, y: Y) -> Y:
        """`[b_k, A]` for the noise `k` of this unit vector."""
        bracket, _ = bracket_and_field(unit, drift, t, y, jnp.asarray(h, t.dtype))
        return bracket

    def summand(unit: Float[Array, " m"], H_k: Array, L_k: Float[Array, " m"]) -> Y:
        """The summand of the noise `k` of this unit vector, with the row `L_k`."""
        inner = ft.partial(drift_bracket, unit)
        # The drift advances time at a constant speed, and the noise does not advance it. So
        # their bracket has no component along time.
        double, single = bracket_and_field(L_k, inner, t, y, jnp.zeros_like(t))
        return (double**ω + H_k * single**ω).ω

    units: Any = np.eye(H.size, dtype=H.dtype)
    return _total(jax.vmap(summand)(units, *coefficients), len(units))


def _total(summands: PyTree[Array], num_summands: int) -> PyTree[Array]:
    """The sum over the first axis of each leaf, unrolled, so that XLA fuses it with its
    uses: a reduction over the axis made a step of 8,000 paths three times slower."""
    return tree_sum(
        [jtu.tree_map(lambda x: x[k], summands) for k in range(num_summands)]
    )
