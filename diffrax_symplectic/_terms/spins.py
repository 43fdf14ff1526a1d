"""Spins and rigid bodies: vectors `s` in R^3, as canonical pairs `(p, q)`."""

import functools as ft
from collections.abc import Callable, Sequence

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from .._arguments import check_pair
from .._custom_types import Args, RealScalarLike
from .callers import AbstractCaller
from .evaluation import checked_energy
from .lifted import checked_damping, damping_for, lifted_terms


_Spins = Float[Array, "*spins 3"]
_Spinors = tuple[Float[Array, "*spins 2"], Float[Array, "*spins 2"]]
_SpinHamiltonian = Callable[[RealScalarLike, _Spins, Args], PyTree[ArrayLike]]


def spin_terms(
    H0: _SpinHamiltonian,
    noise: _SpinHamiltonian | None = None,
    path: diffrax.AbstractBrownianPath | PyTree | None = None,
    damping: ArrayLike | None = None,
) -> diffrax.MultiTerm:
    r"""The terms of spins, or of a rigid body, from their Hamiltonians.

    For one or many vectors $s$ in $\mathbb R^3$, in the sense of Stratonovich,

    $$\mathrm{d}s = s \times \nabla H_0\,\mathrm{d}t
        + \sum_{k=1}^m s \times \nabla H_k \circ \mathrm{d}w_k.$$

    Examples are the angular momentum of a rigid body, the stochastic Landau--Lifshitz
    equation of magnetic moments, and the motion of point vortices on a sphere. The length
    of each $s$ is constant, and the flow is a Poisson map: $\{F \circ S, G \circ S\} =
    \{F, G\} \circ S$ for the bracket $\{F, G\} = s \cdot (\nabla G \times \nabla F)$.

    The state of these terms is a pair $(p, q)$ of arrays of shape `(..., 2)`, which
    [`diffrax_symplectic.from_spinors`][] maps to $s$. The terms are
    [`diffrax_symplectic.hamiltonian_terms`][] of the Hamiltonians $H_k(s(p, q))$. The
    length of a spin is a quadratic invariant of them, so every solver for general systems
    conserves it and is a Poisson map of $s$, with the same orders as for canonical systems.
    Other solvers reject these terms.

    **Damping.** `damping=alpha` adds $\alpha\, s \times (s \times \nabla H_0)\,
    \mathrm{d}t$, the damping of the Landau--Lifshitz equation. The same solvers conserve
    the lengths, with the same orders, but the flow is no longer a Poisson map. With the
    noise `lambda t, s, args: sigma * s` and $\sigma^2 = 2 \alpha T$, the density
    $e^{-H_0 / T}$ at temperature $T$ (in units of energy) is stationary, for spins of any
    length.

    **Arguments:**

    - `H0`: `H0(t, s, args)`, a scalar, for `s` of shape `(..., 3)`. A function, or a
        Module with parameters; differentiable with respect to these and to `args`.
    - `noise`: `noise(t, s, args)`, the noise Hamiltonians $H_1, \ldots, H_m$ as an array
        of shape `(m,)`, or in the structure and shapes of `path`. For a random field along
        each axis of each spin, use `lambda t, s, args: args * s` and a path with the shape
        of `s`. Or an [`diffrax_symplectic.IndexedNoise`][] of `H(k, t, s, args)`.
    - `path`: the Brownian path or its shape, as for
        [`diffrax_symplectic.hamiltonian_terms`][].
    - `damping`: the number $\alpha$, or one for each spin, not negative; in units of one
        over the length of a spin. If it is traced, a path fails where it is negative or not
        finite.

    **Returns:** `MultiTerm(drift, diffusion)`, for the state `to_spinors(s0)`.

    **Raises:** as [`diffrax_symplectic.hamiltonian_terms`][]; a `ValueError` if `damping`
    is known to be negative or not finite; and, while the solve is traced, if it does not
    fit the spins, or if the arrays of the state do not have the shape `(..., 2)`.

    **Source:** [McLachlan, Modin and Verdier
    (2014)](https://doi.org/10.1088/0951-7715/27/6/1525) for systems without noise and
    damping; [Brown (1963)](https://doi.org/10.1103/PhysRev.130.1677) for spins at finite
    temperature.
    """
    damped_drift = None if damping is None else _DampedPrecession(H0, damping)
    return lifted_terms(H0, noise, path, from_spinors, "s", damped_drift)


# What messages about the damping call one vector.
_EACH = "each spin"


class _DampedPrecession(AbstractCaller):
    """The velocity of the pair `(p, q)` for `ds/dt = s x omega` with `omega = grad H0 +
    alpha s x grad H0`."""

    H0: _SpinHamiltonian
    alpha: ArrayLike = eqx.field(converter=ft.partial(checked_damping, _EACH))

    def called_with(self, t, y, args):
        return {"H0": (t, jax.eval_shape(from_spinors, y), args)}

    def __call__(self, t: RealScalarLike, y: _Spinors, args: Args) -> _Spinors:
        s = from_spinors(y)

        def energy(s: _Spins) -> Array:
            return checked_energy("H0", self.H0, t, s, args=args)

        gradient = jax.grad(energy)(s)
        alpha = damping_for(_EACH, self.alpha, s.shape[:-1], s.dtype)
        # `w` is `omega = gradient + alpha s x gradient`. The cross product lets the spin
        # spiral to lower energy.
        s1, s2, s3 = _components(s)
        g1, g2, g3 = _components(gradient)
        w1 = g1 + alpha * (s2 * g3 - s3 * g2)
        w2 = g2 + alpha * (s3 * g1 - s1 * g3)
        w3 = g3 + alpha * (s1 * g2 - s2 * g1)
        # The symplectic gradient of `w . s(p, q)` with `w` fixed. By `from_spinors` this is
        # half of
        #     w1 (q1 q2 + p1 p2) + w2 (p1 q2 - q1 p2) + w3 (q1^2 + p1^2 - q2^2 - p2^2) / 2.
        # It is written out, since by `jax.grad` it takes 1.3 times as long.
        p, q = y
        p1, p2 = _components(p)
        q1, q2 = _components(q)
        dp1 = -(w1 * q2 - w2 * p2 + w3 * q1)
        dp2 = -(w1 * q1 + w2 * p1 - w3 * q2)
        dq1 = w1 * p2 + w2 * q2 + w3 * p1
        dq2 = w1 * p1 - w2 * q1 - w3 * p2
        return jnp.stack([dp1, dp2], axis=-1) / 2, jnp.stack([dq1, dq2], axis=-1) / 2


def _components(x: Float[Array, "*spins d"]) -> Sequence[Float[Array, " *spins"]]:
    """The components along the last axis, each as an array."""
    return jnp.moveaxis(jnp.asarray(x), -1, 0)  # pyright: ignore


def from_spinors(y: _Spinors) -> _Spins:
    r"""The vectors $s$ of the state $(p, q)$ of [`diffrax_symplectic.spin_terms`][],

    $$s = \tfrac14 \left(2 \operatorname{Re} a b^*,\; 2 \operatorname{Im} a b^*,\;
        |a|^2 - |b|^2\right), \qquad
        a = q_1 + \mathrm i p_1, \quad b = q_2 + \mathrm i p_2.$$

    This is the Hopf map, as in [McLachlan, Modin and Verdier
    (2014)](https://doi.org/10.1088/0951-7715/27/6/1525). With the factor $1/4$ its
    components have the canonical brackets of spins, $\{s_1, s_2\} = -s_3$ and cyclic. The
    length of $s$ is $(|p|^2 + |q|^2) / 4$.

    **Arguments:**

    - `y`: the pair $(p, q)$ of arrays of shape `(..., 2)`, for example `sol.ys`.

    **Returns:** an array of shape `(..., 3)`.

    **Raises:** a `ValueError` if `y` is anything else.
    """
    check_pair(y)
    p, q = y
    # The check of the pair ensures that `q` has the structure and the shape of `p`.
    if not eqx.is_array_like(p) or jnp.shape(p)[-1:] != (2,):
        raise ValueError(
            "The state of spins is a pair `(p, q)` of arrays of shape `(..., 2)`: pass "
            f"`y0=to_spinors(s0)`. Got {eqx.tree_pformat(y)}."
        )
    p1, p2 = _components(p)
    q1, q2 = _components(q)
    # The components are 2 / 4 = 1 / 2 of the real and imaginary part of
    # a b* = (q1 q2 + p1 p2) + i (p1 q2 - q1 p2), and (|a|^2 - |b|^2) / 4.
    s1 = (q1 * q2 + p1 * p2) / 2
    s2 = (p1 * q2 - q1 * p2) / 2
    s3 = (q1**2 + p1**2 - q2**2 - p2**2) / 4
    return jnp.stack([s1, s2, s3], axis=-1)


def to_spinors(s: _Spins) -> _Spinors:
    r"""A state $(p, q)$ for the vectors $s$: the initial state of a solve of
    [`diffrax_symplectic.spin_terms`][]. `from_spinors(to_spinors(s))` is $s$.

    Each spin becomes two complex numbers $a = q_1 + \mathrm i p_1$ and $b = q_2 + \mathrm i
    p_2$. The numbers $\mathrm e^{\mathrm i \phi} a$ and $\mathrm e^{\mathrm i \phi} b$ give
    the same $s$ for every phase $\phi$, at all times. No choice of the phase is continuous
    on the whole sphere. Here $a > 0$ if $s_3 \ge 0$ and $b > 0$ if $s_3 < 0$, so $(p, q)$
    jumps where $s$ crosses the equator. Derivatives of functions of $s$ are correct
    everywhere.

    **Arguments:**

    - `s`: an array of shape `(..., 3)`, with vectors of nonzero length.

    **Returns:** the pair `(p, q)` of arrays of shape `(..., 2)`.

    **Raises:** a `ValueError` if `s` has another shape; an error when run if a spin has
    length zero, where $(p, q)$, which grows like $|s|^{1/2}$, has no derivative.
    """
    s = as_spins(s)
    # Spins are scaled to a largest component of 1, against overflow and underflow of
    # squares. The result does not depend on the scale, which so needs no derivative.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(s), axis=-1, keepdims=True))
    scale = eqx.error_if(
        scale,
        scale == 0,
        "`to_spinors(s)` needs spins of nonzero length. A spin of length zero never moves: "
        "leave it out.",
    )
    s1, s2, s3 = _components(s / scale)
    is_north = s3 >= 0
    length = jnp.sqrt(s1**2 + s2**2 + s3**2)
    # The larger one of `a` and `b` is chosen real and positive. The equations
    #     |a|^2 + |b|^2 = 4 |s|,  |a|^2 - |b|^2 = 4 s3,  a b* = 2 (s1 + i s2)
    # give its square, 2 (|s| + |s3|). The other number follows from the last equation, by a
    # division by the larger one, which is accurate near both poles.
    larger = jnp.sqrt(2 * (length + jnp.where(is_north, s3, -s3)))
    other_q = 2 * s1 / larger
    other_p = 2 * s2 / larger
    # In the north `a` is real and b = other_q - i other_p. In the south `b` is real and
    # a = other_q + i other_p.
    p1 = jnp.where(is_north, 0, other_p)
    p2 = jnp.where(is_north, -other_p, 0)
    q1 = jnp.where(is_north, larger, other_q)
    q2 = jnp.where(is_north, other_q, larger)
    # (p, q) grows like the root of |s|.
    root = jnp.sqrt(scale)
    return root * jnp.stack([p1, p2], axis=-1), root * jnp.stack([q1, q2], axis=-1)


def as_spins(s: PyTree) -> _Spins:
    """`s` as an array of floating-point numbers. Raises a `ValueError` if it cannot hold
    spins."""
    if (
        not eqx.is_array_like(s)
        or jnp.shape(s)[-1:] != (3,)
        or jnp.issubdtype(jnp.result_type(s), jnp.complexfloating)
    ):
        raise ValueError(
            "Spins are a real array `s` of shape `(..., 3)`, the three components last; "
            f"got {eqx.tree_pformat(s)}."
        )
    return jnp.asarray(s, jnp.result_type(s, float))
