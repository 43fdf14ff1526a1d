"""The Lie brackets of noise and drift in the logarithm of the solution over one step. Their
coefficients depend on the Brownian path between the ends of the step."""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from ._compat import ω
from ._custom_types import Args, RealScalarLike, Y


class Bridge(NamedTuple):
    r"""Integrals over a step of size $h$ of the Brownian bridges of `m` noises: their paths
    less the straight lines between the ends.

    - `first`: the means of the bridges over the step, $H_k$.
    - `second`: $\frac{1}{2h} \int (\text{bridge}_k + W_k (\frac sh - \frac12))
        (\text{bridge}_l + W_l (\frac sh - \frac12))\,\mathrm{d}s - \frac{1}{24} W_k W_l$,
        in expectation.
    """

    first: Float[Array, " m"]
    second: Float[Array, "m m"]


def bridge(h: RealScalarLike, W: PyTree, H: PyTree, K: PyTree | None) -> Bridge:
    r"""The expectations of these integrals given the space-time areas, and given the
    space-time-time areas as well unless `K` is `None`.

    A bridge is $6 u (1 - u) H + 120 u (1 - u) (\frac12 - u) K$ with $u = s / h$, and an
    independent rest whose square has the mean $h / 15$ without the second summand, and
    $3 h / 70$ with it.
    """
    w, first = jfu.ravel_pytree(W)[0], jfu.ravel_pytree(H)[0]
    one = jnp.eye(first.size, dtype=first.dtype) * jnp.abs(h).astype(first.dtype)
    second = 3 / 5 * jnp.outer(first, first)
    if K is None:
        return Bridge(first, second + one / 30)
    k = jfu.ravel_pytree(K)[0]
    mixed = jnp.outer(w, k)
    second = second + 60 / 7 * jnp.outer(k, k) - (mixed + mixed.T) / 2
    return Bridge(first, second + 3 / 140 * one)


@eqx.filter_jit
def apply_bridge(
    drift: jtu.Partial,
    noise: tuple[diffrax.AbstractTerm, ...],
    bridge: Bridge,
    h: RealScalarLike,
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """`sum_k H_k [b_k, A] + sum_{k, l} L_kl [b_k, [b_l, A]]`, with `A(t, y) = drift(t, y)`
    the drift times `h`, and `[b, A] = A' b - b' A`. Time is a part of the state that the
    drift moves by `h`. For `m` noises that is `m` double brackets.
    """
    struct = eqx.filter_eval_shape(lambda: [term.contr(0.0, 1.0) for term in noise])
    _, unravel = jfu.ravel_pytree(jtu.tree_map(jnp.zeros_like, struct))
    t = jnp.asarray(t, jnp.result_type(h))

    def along_noise(t, y, x):
        values = [term.vf_prod(t, y, args, c) for term, c in zip(noise, unravel(x))]
        total = values[0]
        for value in values[1:]:
            total = (total**ω + value**ω).ω
        return total

    def bracket(x, field, t, y, speed):
        """The bracket of the noise along `x` with `field`, which moves time by `speed`; and
        the value of `field`."""
        b = along_noise(t, y, x)
        value, change = jax.jvp(lambda y: field(t, y), (y,), (b,))
        along = lambda t, y: along_noise(t, y, x)
        _, carried = jax.jvp(along, (t, y), (speed, value))
        return (change**ω - carried**ω).ω, value

    def summand(unit, column):
        single = lambda t, y: bracket(unit, drift, t, y, jnp.asarray(h, t.dtype))[0]
        return bracket(column, single, t, y, jnp.zeros_like(t))

    units = jnp.eye(bridge.first.size, dtype=bridge.first.dtype)
    doubles, singles = jax.vmap(summand)(units, bridge.second)
    combine = lambda double, single: (
        jnp.sum(double, axis=0) + jnp.tensordot(bridge.first, single, axes=1)
    )
    return jtu.tree_map(combine, doubles, singles)
