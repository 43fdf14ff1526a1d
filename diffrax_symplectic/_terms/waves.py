"""Complex amplitudes, as canonical pairs `(p, q)`."""

import functools as ft
import math
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Complex, Float, PyTree

from .._arguments import check_pair, shapes
from .._custom_types import Args, RealScalarLike
from .callers import AbstractCaller
from .evaluation import checked_energy
from .lifted import checked_damping, damping_for, lifted_terms


_Waves = PyTree[Complex[Array, "..."]]
_Pair = tuple[PyTree[Float[Array, "..."]], PyTree[Float[Array, "..."]]]
_WaveHamiltonian = Callable[[RealScalarLike, _Waves, Args], PyTree[ArrayLike]]


def wave_terms(
    H0: _WaveHamiltonian,
    noise: _WaveHamiltonian | None = None,
    path: diffrax.AbstractBrownianPath | PyTree | None = None,
    damping: ArrayLike | None = None,
) -> diffrax.MultiTerm:
    r"""The terms of complex amplitudes, from their real Hamiltonians.

    For one or many amplitudes $\psi$, in the sense of Stratonovich,

    $$\mathrm i\,\mathrm{d}\psi = \frac{\partial H_0}{\partial \psi^*}\,\mathrm{d}t
        + \sum_{k=1}^m \frac{\partial H_k}{\partial \psi^*} \circ \mathrm{d}w_k.$$

    Examples are the Schrödinger equation of a quantum system, with $H_k = \psi^\dagger A_k
    \psi$ and Hermitian matrices $A_k$, and nonlinear Schrödinger equations on a lattice.

    The state of these terms is the pair $(p, q)$ of real arrays with
    $\psi = (q + \mathrm i p) / \sqrt 2$. The terms are
    [`diffrax_symplectic.hamiltonian_terms`][] of the Hamiltonians $H_k(\psi(p, q))$. All
    solvers for general systems conserve, up to rounding, every quadratic function of $\psi$
    that $H_0$ and all $H_k$ conserve, such as the norm $|\psi|^2$.

    **Damping.** `damping=alpha` adds $\alpha\, (\psi\, g^\dagger \psi - g\,
    \psi^\dagger \psi)\, \mathrm{d}t$ with $g = \partial H_0 / \partial \psi^*$, for vectors
    $\psi \in \mathbb C^N$ along the last axis, such as the coherent states of SU($N$)
    spins. It lowers the energy and changes no length: the same solvers conserve the length
    of each vector, with the same orders, if $H_0$ does not depend on its phase. The flow is
    no longer symplectic. The noise that belongs to it has
    $N^2$ Hamiltonians for each vector: with `path` of shape `psi.shape + psi.shape[-1:]`,

        def noise(t, psi, args):
            M = jnp.conj(psi)[..., :, None] * psi[..., None, :]
            return sigma * (M.real + M.imag)

    and $\sigma^2 = 2 \alpha T$, the density $e^{-H_0 / T}$ at temperature $T$ (in units of
    energy) is stationary on the spheres of all lengths. For $N = 2$ and functions of
    `from_spinors(y)` this is [`diffrax_symplectic.spin_terms`][] with twice this damping.

    **Arguments:**

    - `H0`: `H0(t, psi, args)`, a real scalar, where `psi` is a PyTree of complex arrays. A
        function, or a Module with parameters; differentiable with respect to these and to
        `args`. Write $|\psi|^2$ as `jnp.real(psi * jnp.conj(psi))`: `jnp.abs(psi)` has no
        derivative at zero, and that of `jnp.abs(psi) ** 2` takes a root and a division,
        with which steps take two to three times as long.
    - `noise`: `noise(t, psi, args)`, the noise Hamiltonians $H_1, \ldots, H_m$, real, as an
        array of shape `(m,)`, or in the structure and shapes of `path`. Or an
        [`diffrax_symplectic.IndexedNoise`][] of `H(k, t, psi, args)`.
    - `path`: the Brownian path or its shape, as for
        [`diffrax_symplectic.hamiltonian_terms`][].
    - `damping`: the number $\alpha$, or one for each vector, not negative; in units of one
        over $|\psi|^2$ and $\hbar$. `psi` must then be one array. If it is traced, a path
        fails where it is negative or not finite.

    Parameters may be complex. As always in JAX, the gradient of a real loss $L$ with
    respect to $z = x + \mathrm i y$ is $\partial L / \partial x - \mathrm i\, \partial L /
    \partial y$: for gradient descent, subtract its conjugate.

    **Returns:** `MultiTerm(drift, diffusion)`, for the state `to_pair(psi0)`.

    **Raises:** as [`diffrax_symplectic.hamiltonian_terms`][]; a `ValueError` if `damping`
    is known to be negative or not finite; and, while the solve is traced, if it does not
    fit the amplitudes, or if a Hamiltonian returns complex numbers, even with zero
    imaginary part.

    **Source:** [Dahlbom, Miles, Zhang, Batista and Barros
    (2022)](https://doi.org/10.1103/PhysRevB.106.235154) for the damping. Their noise, of
    $2N$ numbers, has the same law if $H_0$ does not depend on the phase of $\psi$. The
    Hamiltonians above generate unitary maps, so that solvers which conserve quadratic
    invariants keep the law of infinite temperature exactly.
    """
    damped_drift = None if damping is None else _DampedWaves(H0, damping)
    return lifted_terms(H0, noise, path, from_pair, "psi", damped_drift)


# What messages about the damping call one vector.
_EACH = "each vector of amplitudes"


class _DampedWaves(AbstractCaller):
    """The velocity of the pair `(p, q)` for `dpsi/dt = -i g + alpha (psi g^+ psi - g psi^+
    psi)` with `g = dH0/dpsi^*`."""

    H0: _WaveHamiltonian
    alpha: ArrayLike = eqx.field(converter=ft.partial(checked_damping, _EACH))

    def called_with(self, t, y, args):
        return {"H0": (t, jax.eval_shape(from_pair, y), args)}

    def __call__(self, t: RealScalarLike, y: _Pair, args: Args) -> _Pair:
        check_pair(y)
        p, q = y
        if not eqx.is_array_like(q) or jnp.ndim(q) == 0:
            raise ValueError(
                "`damping` needs amplitudes `psi` in one array, of shape `(..., N)`, whose "
                "vectors along the last axis keep their lengths; got shape "
                f"{shapes(q)}. Join them, for example by `jnp.concatenate`."
            )

        def energy(p: Array, q: Array) -> Array:
            psi = from_pair((p, q))
            return checked_energy("H0", self.H0, t, psi, args=args)

        by_p, by_q = jax.grad(energy, argnums=(0, 1))(p, q)
        alpha = damping_for(_EACH, self.alpha, jnp.shape(q)[:-1], jnp.result_type(q))
        # In terms of the real state, psi = (q + i p) / sqrt(2) and
        # g = (by_q + i by_p) / sqrt(2). So 2 g^+ psi = real + i imaginary and
        # 2 psi^+ psi = squares, with the scalar products below, and sqrt(2) dpsi/dt is
        #     dq + i dp = -i (by_q + i by_p)
        #         + alpha/2 ((q + i p) (real + i imaginary) - (by_q + i by_p) squares).
        half_alpha = alpha[..., None] / 2
        real = _dot(by_q, q) + _dot(by_p, p)
        imaginary = _dot(by_q, p) - _dot(by_p, q)
        squares = _dot(p, p) + _dot(q, q)
        dp = -by_q + half_alpha * (real * p + imaginary * q - squares * by_p)
        dq = by_p + half_alpha * (real * q - imaginary * p - squares * by_q)
        return dp, dq


def _dot(a: Float[Array, "*vectors n"], b: Float[Array, "*vectors n"]) -> Array:
    """The scalar products of vectors along the last axis, which is kept with length one."""
    return jnp.sum(a * b, axis=-1, keepdims=True)


def to_pair(psi: _Waves) -> _Pair:
    r"""The state $(p, q) = \sqrt 2\, (\operatorname{Im} \psi, \operatorname{Re} \psi)$ for
    amplitudes $\psi$: the initial state of a solve of [`diffrax_symplectic.wave_terms`][].

    **Arguments:**

    - `psi`: a PyTree of arrays, complex or real, of any shapes.

    **Returns:** the pair `(p, q)` of real arrays, in the precision of `psi`.
    """
    arrays = jtu.tree_map(jnp.asarray, psi)
    p = jtu.tree_map(lambda x: math.sqrt(2) * jnp.imag(x), arrays)
    q = jtu.tree_map(lambda x: math.sqrt(2) * jnp.real(x), arrays)
    return p, q


def from_pair(y: _Pair) -> _Waves:
    r"""The amplitudes $\psi = (q + \mathrm i p) / \sqrt 2$ of the state $(p, q)$ of
    [`diffrax_symplectic.wave_terms`][].

    **Arguments:**

    - `y`: the pair $(p, q)$, for example `sol.ys`.

    **Returns:** a PyTree of complex arrays.

    **Raises:** a `ValueError` if `y` is not a pair of real arrays.
    """
    check_pair(y)
    return jtu.tree_map(lambda p, q: (q + 1j * p) / math.sqrt(2), *y)
