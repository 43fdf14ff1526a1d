from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import ArrayLike, PyTree

from .._arguments import check_state
from .._compat import direction, unwrapped
from .._custom_types import Args, RealScalarLike, Y
from .._tableau import Structure
from .._terms import apply, check_structure, controls, split_terms
from ._friction import (
    apply_friction,
    checked,
    decay,
    friction_modes,
    friction_result,
    GAMMA,
    matrix_faults,
    spread,
)
from ._step import result_of
from .base import AbstractSymplecticSolver, Record


class BAOAB(AbstractSymplecticSolver):
    r"""Langevin dynamics, $\mathrm{d}p = -\nabla U(q)\,\mathrm{d}t - \gamma p\,\mathrm{d}t
    + \sum_k \sigma_k\,\mathrm{d}w_k$, $\mathrm{d}q = \nabla V(p)\,\mathrm{d}t$, by a
    splitting whose stationary positions are very accurate. Explicit, with one evaluation
    of the forces in a step.

    $$\begin{aligned}
      \text{B:} &\quad p \gets p + \tfrac h2 f(t_n, q) \\
      \text{A:} &\quad q \gets q + \tfrac h2 g(p) \\
      \text{O:} &\quad p \gets e^{-\gamma h} p
        + \Bigl(\frac{1 - e^{-2 \gamma h}}{2 \gamma h}\Bigr)^{1/2} \sum_k \sigma_k I_k \\
      \text{A:} &\quad q \gets q + \tfrac h2 g(p) \\
      \text{B:} &\quad p \gets p + \tfrac h2 f(t_{n+1}, q)
    \end{aligned}$$

    The terms are those without friction, of $H_0 = V(p) + U(t, q)$ and $H_k = -\sigma_k
    \cdot q$ with constant $\sigma_k$; other ones are refused while tracing. Masses are
    part of $V$. With $\sum_k \sigma_k \sigma_k^\top = 2 \gamma M T$ and $V(p) = p \cdot
    M^{-1} p / 2$ the density $e^{-H_0 / T}$ is stationary. In a harmonic well the law of
    $q$ is then exact for every step with $\omega h < 2$.

    The friction acts on the canonical momentum $p$. In a magnetic field that is not the
    kinetic one (and $H_0$ is not separable there).

    O is the exact law of friction and noise together if the matrix $\gamma$ commutes with
    $\sum_k \sigma_k \sigma_k^\top$: for one number $\gamma$, for one number and one noise
    for each momentum, for thermal noise at equal masses. Else its covariance is right up
    to $\mathcal O(h^3)$.

    Weak order 2, strong order 1, order 2 without noise. For one number $\gamma$ a step is
    conformally symplectic: with its Jacobian $S'$, $S'^\top J S' = e^{-\gamma h} J$. As
    explicit methods are, it is limited to $\omega h < 2$.

    Any Brownian path will do: a [`diffrax_symplectic.WeakBrownianPath`][] for
    expectations, one of Diffrax's for paths.

    **Source:** [Leimkuhler and Matthews (2013)](https://doi.org/10.1093/amrx/abs010).
    """

    record: ClassVar[Record] = Record(
        weak=2,
        strong=1,
        choose="Langevin dynamics: explicit, and stationary positions are very accurate.",
        suggested=("weak", "strong"),
    )
    structure: ClassVar[Structure] = "separable and constant"
    variables: ClassVar[tuple[str, ...]] = ("W",)
    gamma: PyTree[ArrayLike] = eqx.field(converter=checked)
    _faults: tuple[str | None, ...] = eqx.field(static=True, init=False, repr=False)

    def __post_init__(self):
        self._faults = matrix_faults(self.gamma)

    def stage_vectors(self, num_noises):
        return ()

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args) -> Any:
        """The forces at the start, and the modes of the friction."""
        del t1
        check_state(y0, "BAOAB")
        drift, noise = split_terms(terms)
        check_structure(self.structure, drift, noise, t0, y0, args, "BAOAB")
        if not all(isinstance(unwrapped(x), diffrax.ODETerm) for x in drift):
            raise ValueError(
                "`BAOAB` needs a drift driven by time: pass `hamiltonian_terms(H0, noise, "
                "path)`."
            )
        modes = friction_modes(self.gamma, self._faults, y0[0])
        return _rate(drift, t0, y0, args)[0], modes

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        drift, noise = split_terms(terms)
        forces, modes = solver_state
        if made_jump is not False:
            anew = lambda: _rate(drift, t0, y0, args)[0]
            forces = lax.cond(made_jump, anew, lambda: forces)
        half = (t1 - t0) / 2
        move = lambda x, rate: jtu.tree_map(
            lambda x, v: x + jnp.asarray(half, jnp.result_type(x)) * v, x, rate
        )

        p = move(y0[0], forces)
        q = move(y0[1], _rate(drift, t0, (p, y0[1]), args)[1])
        # In a solve backward in time the momentum grows. Diffrax makes `t1 - t0` positive.
        time = 2 * direction(terms) * half
        parts = [(decay, p)]
        if len(noise) > 0:
            drawn = controls(noise, ["W"], t0, t1, "BAOAB")["W"]
            kick, _ = apply(noise, drawn, args, t0 + half, (p, q))
            parts.append((spread, kick))
        p = apply_friction(self.gamma, modes, time, *parts)
        q = move(q, _rate(drift, t1, (p, q), args)[1])
        forces, _ = _rate(drift, t1, (p, q), args)
        y1 = move(p, forces), q
        result = friction_result(self.gamma, modes, result_of(None, y1))
        return y1, None, dict(y0=y0, y1=y1), (forces, modes), result


def _rate(drift: tuple, t: RealScalarLike, y: Y, args: Args) -> Y:
    """The change of the state by the drift in a unit of time."""
    t = jnp.asarray(t, jnp.result_type(t, jnp.float32))
    zero = jnp.zeros_like(t)
    return apply(drift, [x.contr(zero, zero + 1) for x in drift], args, t, y)


BAOAB.__init__.__doc__ = f"""**Arguments:**

- `gamma`: {GAMMA}

**Raises:** a `ValueError` if `gamma` is known to be negative, not finite or no such matrix,
    if it does not fit `p` (in the solve), or for terms that are not separable with
    constant noise.
"""
