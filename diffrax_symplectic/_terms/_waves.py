"""Complex amplitudes, as canonical pairs `(p, q)`."""

import math
from collections.abc import Callable

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, Complex, Float, PyTree

from .._arguments import check_pair
from .._custom_types import Args, RealScalarLike
from ._hamiltonian import lifted_terms


_Waves = PyTree[Complex[Array, "..."]]
_Pair = tuple[PyTree[Float[Array, "..."]], PyTree[Float[Array, "..."]]]
_WaveHamiltonian = Callable[[RealScalarLike, _Waves, Args], PyTree[ArrayLike]]


def wave_terms(
    H0: _WaveHamiltonian,
    noise: _WaveHamiltonian | None = None,
    path: diffrax.AbstractBrownianPath | PyTree | None = None,
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

    **Arguments:**

    - `H0`: `H0(t, psi, args)`, a real scalar, where `psi` is a PyTree of complex arrays. A
        function, or a Module with parameters; differentiable with respect to these and to
        `args`. Use `jnp.abs(psi) ** 2`, since `jnp.abs(psi)` has no derivative at zero.
    - `noise`: `noise(t, psi, args)`, the noise Hamiltonians $H_1, \ldots, H_m$, real, as an
        array of shape `(m,)`, or in the structure and shapes of `path`. Or an
        [`diffrax_symplectic.IndexedNoise`][] of `H(k, t, psi, args)`.
    - `path`: the Brownian path or its shape, as for
        [`diffrax_symplectic.hamiltonian_terms`][].

    Parameters may be complex. As always in JAX, the gradient of a real loss $L$ with
    respect to $z = x + \mathrm i y$ is $\partial L / \partial x - \mathrm i\, \partial L /
    \partial y$: for gradient descent, subtract its conjugate.

    **Returns:** `MultiTerm(drift, diffusion)`, for the state `to_pair(psi0)`.

    **Raises:** as [`diffrax_symplectic.hamiltonian_terms`][]; and a `ValueError`, while the
    solve is traced, if a Hamiltonian returns complex numbers, even with zero imaginary
    part.
    """
    return lifted_terms(H0, noise, path, from_pair, "psi")


def to_pair(psi: _Waves) -> _Pair:
    r"""The state $(p, q) = \sqrt 2\, (\operatorname{Im} \psi, \operatorname{Re} \psi)$ for
    amplitudes $\psi$: the initial state of a solve of [`diffrax_symplectic.wave_terms`][].

    **Arguments:**

    - `psi`: a PyTree of arrays, complex or real, of any shapes.

    **Returns:** the pair `(p, q)` of real arrays, in the precision of `psi`.
    """
    part = lambda of: jtu.tree_map(lambda x: math.sqrt(2) * of(jnp.asarray(x)), psi)
    return part(jnp.imag), part(jnp.real)


def from_pair(y: _Pair) -> _Waves:
    r"""The amplitudes $\psi = (q + \mathrm i p) / \sqrt 2$ of the state $(p, q)$ of
    [`diffrax_symplectic.wave_terms`][].

    **Arguments:**

    - `y`: the pair $(p, q)$, for example `sol.ys`.

    **Returns:** a PyTree of complex arrays.

    **Raises:** a `ValueError` if `y` is not a pair of real arrays.
    """
    check_pair(y)
    p, q = y
    return jtu.tree_map(lambda p, q: (q + 1j * p) / math.sqrt(2), p, q)
