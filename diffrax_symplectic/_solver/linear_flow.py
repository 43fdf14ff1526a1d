"""The flow of a linear system by Cayley's angles: in the time t a mode of frequency omega
turns by the angle arctan(omega t), and not by omega t."""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._arguments import check_pair
from .._compat import is_traced
from .._custom_types import Args, RealScalarLike


# A stiffness is symmetric if it differs from its transpose by at most this fraction of its
# largest entry, and an eigenvalue is zero below this fraction of the largest. The roundings
# of both, about 1e-15 times the number of positions, are far below.
_TOLERANCE = 1e-8


def linear_flow(
    stiffness: ArrayLike | None = None,
    *,
    masses: ArrayLike = 1.0,
    rest: ArrayLike = 0.0,
    frequencies: ArrayLike | None = None,
    to_modes: Callable[[Array], Array] | None = None,
    from_modes: Callable[[Array], Array] | None = None,
) -> "CayleyFlow":
    r"""The flow of $H_0 = \frac12 p \cdot M^{-1} p + \frac12 (q - q_0) \cdot K (q - q_0)$
    over half a step, for [`diffrax_symplectic.BAOAB`][] and
    [`diffrax_symplectic.LinearFlow`][].

    A mode of frequency $\omega$ turns by the angle $\arctan(\omega h / 2)$ in half a step,
    and not by $\omega h / 2$. The rotation conserves the same energy, and a whole step
    never turns a mode by $\pi$, where the exact flow resonates with the kicks between. So
    the step is limited by the kicks alone. Modes of frequency zero drift.

    !!! example

        A ring of beads with springs, whose modes are Fourier's:

        ```python
        import jax.numpy as jnp
        import jax.random as jr
        import diffrax_symplectic as ds

        P, gamma, T = 16, 1.0, 1.0


        def springs(t, p, q, args):
            return jnp.sum(p**2 + P**2 * (q - jnp.roll(q, 1)) ** 2) / 2


        def potential(t, q, args):
            return jnp.sum(q**4) / 4


        ring = ds.linear_flow(
            frequencies=2 * P * jnp.sin(jnp.pi * jnp.arange(P // 2 + 1) / P),
            to_modes=jnp.fft.rfft,
            from_modes=lambda x: jnp.fft.irfft(x, P),
        )
        paths = ds.ensemble(
            ds.langevin_terms(springs, gamma, T, (P,), slow=potential),
            ds.BAOAB(ring),
            t0=0,
            t1=10,
            dt0=0.25,
            y0=(jnp.zeros(P), jnp.zeros(P)),
            key=jr.key(0),
            num_paths=100,
        )
        ```

    **Arguments:**

    - `stiffness`: the symmetric matrix $K$ without negative eigenvalues, with the shape of
        `q` twice.
    - `masses`: a number, or an array with one for each position, of the shape of `q`. With
        modes that are given, a number.
    - `rest`: the positions $q_0$ at rest, a number or an array of the shape of `q`.
    - `frequencies`, `to_modes`, `from_modes`: in place of `stiffness`, the frequencies
        $\omega$ and the linear maps between positions and modes, which are inverse to each
        other. `to_modes(q)` has the shape of `frequencies`.

    `q` is one array.

    **Returns:** a function `flow(time, y, args)` of half the step.

    **Raises:** a `ValueError` for a stiffness that is not symmetric or has negative
    eigenvalues (where traced, paths fail), masses that are not positive, and unless either
    the stiffness or the modes are given.

    **Source:** [Korol, Rosa-Raíces, Bou-Rabee and Miller
    (2020)](https://doi.org/10.1063/1.5134810), for ring polymers.
    """
    # The modes follow from a stiffness. Without one all three arguments are needed.
    num_given = sum(x is not None for x in (frequencies, to_modes, from_modes))
    num_needed = 3 if stiffness is None else 0
    if num_given != num_needed:
        raise ValueError(
            "Pass either `stiffness`, or `frequencies`, `to_modes` and `from_modes`."
        )
    if not is_traced(masses) and not np.all(np.asarray(masses) > 0):
        raise ValueError(f"`masses` must be positive; got {masses!r}.")
    mass_roots = jnp.sqrt(jnp.asarray(masses, float))
    if stiffness is not None:
        omega, vectors = _modes_of(stiffness, mass_roots)
        to_modes = jtu.Partial(_to_modes, vectors)
        from_modes = jtu.Partial(_from_modes, vectors)
    else:
        # The flow applies `to_modes` to scaled positions, `sqrt(masses) * q`. Their modes
        # are the given ones, those of `q`, only if all masses are equal.
        if jnp.ndim(mass_roots) > 0:
            raise ValueError("With modes that are given, `masses` must be one number.")
        omega = jnp.asarray(frequencies, float)
    assert to_modes is not None and from_modes is not None
    return CayleyFlow(omega, to_modes, from_modes, mass_roots, jnp.asarray(rest, float))


def _modes_of(
    stiffness: ArrayLike, mass_roots: Float[Array, "..."]
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The frequencies and modes of a system with the stiffness `K` and the masses `M`, of
    which `mass_roots` is `M^1/2`, one number or in the shape of `q`.

    They follow from the matrix `A = M^-1/2 K M^-1/2`. The frequencies are the roots of its
    eigenvalues. The modes are its eigenvectors, returned as columns, for the scaled
    positions `M^1/2 q`. All is computed by NumPy if all values are known, so that wrong
    ones raise a `ValueError`.
    """
    K: Any = stiffness if is_traced(stiffness) else np.asarray(stiffness, float)
    shape = np.shape(K)
    shape_of_q = shape[: len(shape) // 2]
    if shape != (*shape_of_q, *shape_of_q):
        raise ValueError(
            f"`stiffness` must have the shape of `q` twice, `(n, n)`; got {shape}."
        )
    n = math.prod(shape_of_q)
    K = K.reshape(n, n)
    is_known = not is_traced(K) and not is_traced(mass_roots)
    # NumPy and `jax.numpy` have `eigh`, `where` and so on by the same names.
    xp: Any = np if is_known else jnp
    if is_known:
        largest_entry = np.max(abs(K), initial=0)
        if np.max(abs(K - K.T), initial=0) > _TOLERANCE * largest_entry:
            raise ValueError(
                "`stiffness` must be symmetric: it is a second derivative."
            )
    # One root of a mass for each component of `q`.
    mass_roots_of_q = xp.broadcast_to(xp.asarray(mass_roots), shape_of_q).reshape(-1)
    A = K / mass_roots_of_q[:, None] / mass_roots_of_q
    # The eigenvalues are the squares of the frequencies.
    eigenvalues, vectors = xp.linalg.eigh(A)
    # An eigenvalue below this is zero, up to rounding errors.
    rounding = _TOLERANCE * xp.max(abs(eigenvalues), initial=0)
    least = xp.min(eigenvalues, initial=0)
    if is_known and least < -rounding:
        raise ValueError(
            f"`stiffness` has the negative eigenvalue {least:.2g} (over masses): there is "
            "no minimum of the energy at rest. Leave this part to `slow=`."
        )
    eigenvalues = xp.where(abs(eigenvalues) < rounding, 0.0, eigenvalues)
    # The root of a negative eigenvalue that is traced is NaN, which makes paths fail.
    return jnp.asarray(xp.sqrt(eigenvalues)), jnp.asarray(vectors)


def _to_modes(
    vectors: Float[Array, "n n"], x: Float[Array, "..."]
) -> Float[Array, " n"]:
    """The modes of `x`, positions or momenta of any shape."""
    return vectors.T.astype(x.dtype) @ x.reshape(-1)


def _from_modes(vectors: Float[Array, "n n"], modes: Float[Array, " n"]) -> Array:
    """The positions or momenta of these modes, as a vector."""
    return vectors.astype(modes.dtype) @ modes


class CayleyFlow(eqx.Module):
    """The flow that `linear_flow` returns.

    - `frequencies`: the frequencies of the modes.
    - `to_modes`, `from_modes`: the maps between modes and scaled positions, which are
        positions times the roots of the masses.
    - `mass_roots`: the roots of the masses.
    - `rest`: the positions at rest.
    """

    frequencies: Float[Array, "..."]
    to_modes: Callable[[Array], Array]
    from_modes: Callable[[Array], Array]
    mass_roots: Float[Array, "..."]
    rest: Float[Array, "..."]

    def __call__(
        self, time: RealScalarLike, y: tuple[Array, Array], args: Args
    ) -> tuple[Array, Array]:
        """The state after `time`, half of a step.

        Modes have the scaled positions `Q = sqrt(m) q` and momenta `P = p / sqrt(m)`, with
        `dP/dt = -omega^2 Q` and `dQ/dt = P`. So `(P, omega Q)` turns by an angle, here
        `a = arctan(omega time)`:

            P1 = cos(a) P - omega sin(a) Q,    Q1 = cos(a) Q + sin(a) / omega P
        """
        del args
        check_pair(y)
        p, q = y
        dtype = jnp.result_type(q)
        mass_roots = self.mass_roots.astype(dtype)
        rest = self.rest.astype(dtype)
        omega = self.frequencies.astype(dtype)
        time = jnp.asarray(time, dtype)
        # With `tan(a) = omega time`, `cos(a)` is `1 / sqrt(1 + tan(a)^2)`, and `sin(a) /
        # omega` is `tan(a) cos(a) / omega = time cos(a)`, without a division by a frequency
        # of zero.
        cosine = 1 / jnp.sqrt(1 + (omega * time) ** 2)
        sine_over_omega = time * cosine
        P = self.to_modes(p / mass_roots)
        Q = self.to_modes((q - rest) * mass_roots)
        P1 = cosine * P - omega**2 * sine_over_omega * Q
        Q1 = cosine * Q + sine_over_omega * P
        p1 = self.from_modes(P1).reshape(jnp.shape(q)) * mass_roots
        q1 = rest + self.from_modes(Q1).reshape(jnp.shape(q)) / mass_roots
        return p1, q1
