"""The terms of a Hamiltonian system, and those of its noise alone."""

from collections.abc import Callable
from typing import Any, cast, get_args

import diffrax
from jaxtyping import Array, PyTree

from .._arguments import check_takes
from .._custom_types import Args, RealScalarLike
from .constrained_drift import Constraint, with_constraint
from .paths import as_path
from .symplectic_gradients import (
    AssertedStructure,
    Drift,
    HalfState,
    Hamiltonian,
    HamiltonianNoise,
)


def hamiltonian_terms(
    H0: Hamiltonian,
    noise: Hamiltonian | None = None,
    path: diffrax.AbstractBrownianPath | PyTree | None = None,
    *,
    structure: AssertedStructure | None = None,
    constraint: Constraint | None = None,
    slow: Callable[[RealScalarLike, HalfState, Args], Array] | None = None,
) -> diffrax.MultiTerm:
    r"""The terms of a stochastic Hamiltonian system, from its Hamiltonians.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp

        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.2 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ())  # the shape of one noise
        ```

    For the state $y = (p, q)$, in the sense of Stratonovich,

    $$\mathrm{d}p = -\frac{\partial H_0}{\partial q}\,\mathrm{d}t
        - \sum_{k=1}^m \frac{\partial H_k}{\partial q} \circ \mathrm{d}w_k, \qquad
      \mathrm{d}q = \frac{\partial H_0}{\partial p}\,\mathrm{d}t
        + \sum_{k=1}^m \frac{\partial H_k}{\partial p} \circ \mathrm{d}w_k.$$

    Any Stratonovich solver accepts them, also Diffrax's. One reverse pass gives the noise
    of a step, for any number of noises.

    **Arguments:**

    - `H0`: `H0(t, p, q, args)`, a scalar. A function, or a Module with parameters;
        differentiable with respect to these and to `args`.
    - `noise`: `noise(t, p, q, args)`, the noise Hamiltonians $H_1, \ldots, H_m$ as an
        array of shape `(m,)`, or in the structure and shapes of `path`; a scalar if `m =
        1`. Or an [`diffrax_symplectic.IndexedNoise`][]. For a system without noise omit
        `noise` and `path`.
    - `path`: a Brownian path of shape `(m,)`. If the solver is not known yet, pass its
        shape, `(m,)` or a PyTree of `jax.ShapeDtypeStruct`s:
        [`diffrax_symplectic.suggest_solver`][], [`diffrax_symplectic.compare_solvers`][]
        and [`diffrax_symplectic.expectation`][] then make the path that the solver needs.
    - `structure`: `"separable"` ($H_0 = V(p) + U(t, q)$, $H_k = U_k(t, q)$) or `"additive"`
        (the gradients of the $H_k$ do not depend on the state), asserted instead of
        detected; see [FAQ](faq.md). It is relied on.
    - `constraint`: `constraint(q, args)`, an array of shape `(c,)` that is zero on the
        positions that the system can take, such as `jnp.stack([jnp.sum(q**2) - 1])` for a
        rod. Its gradients must be linearly independent there. For
        [`diffrax_symplectic.StormerVerlet`][] and [`diffrax_symplectic.BAOAB`][], with
        $H_0 = p \cdot M^{-1} p / 2 + U(t, q)$ and $H_k = U_k(t, q)$; all other solvers
        raise an error. Start from [`diffrax_symplectic.constrained_state`][].
    - `slow`: `slow(t, q, args)`, a potential that is added to `H0`, and whose force is soft
        or expensive. [`diffrax_symplectic.BAOAB`][] with a `flow` evaluates it once in a
        step, and leaves `H0` to the flow. For all other solvers it is a part of the drift.

    `p` and `q` are PyTrees of arrays of the same structure and shapes.

    **Returns:** `MultiTerm(drift, diffusion)`, or without noise `MultiTerm(drift)`.

    **Raises:** a `ValueError` if `path` is neither a Brownian path nor a shape, or if
    `structure` is unknown; and, while the solve is traced, if the state is not a pair
    `(p, q)` of the same structure and shapes, if `H0` does not return a scalar, if `noise`
    does not match the path or does not depend on the state, or if either needs concrete
    values or does not return real numbers.
    """
    check_takes("H0", H0, "t", "p", "q", "args")
    _check_structure_name(structure)
    if slow is not None:
        check_takes("slow", slow, "t", "q", "args")
    drift = diffrax.ODETerm(Drift(H0, structure, slow=slow))
    drift = with_constraint(drift, constraint)
    if noise is None and path is None:
        return diffrax.MultiTerm(drift)
    # If only one of `noise` and `path` was left out, `noise_terms` raises an error.
    diffusion = noise_terms(cast(Hamiltonian, noise), path, structure=structure)
    return diffrax.MultiTerm(drift, *diffusion.terms)


def noise_terms(
    noise: Hamiltonian,
    path: diffrax.AbstractBrownianPath | PyTree,
    *,
    structure: AssertedStructure | None = None,
) -> diffrax.MultiTerm:
    r"""The noise of [`diffrax_symplectic.hamiltonian_terms`][] alone, without a drift:

    $$\mathrm{d}p = -\sum_{k=1}^m \frac{\partial H_k}{\partial q} \circ \mathrm{d}w_k,
      \qquad
      \mathrm{d}q = \sum_{k=1}^m \frac{\partial H_k}{\partial p} \circ \mathrm{d}w_k.$$

    Add it to other terms, `diffrax.MultiTerm(*terms.terms, *noise_terms(noise,
    path).terms)`: noisy forces beside a bath of [`diffrax_symplectic.langevin_terms`][], or
    a second noise with a path of its own.

    **Arguments:** `noise`, `path` and `structure` are those of
    [`diffrax_symplectic.hamiltonian_terms`][].

    **Returns:** `MultiTerm(diffusion)`.

    **Raises:** what [`diffrax_symplectic.hamiltonian_terms`][] raises for these arguments.
    """
    check_takes("noise", noise, "t", "p", "q", "args")
    _check_structure_name(structure)
    return diffrax.MultiTerm(HamiltonianNoise(noise, as_path(path), structure))


def _check_structure_name(structure: Any) -> None:
    """Raises a `ValueError` if the user's argument `structure` is not a known one."""
    known = get_args(AssertedStructure)
    if structure not in (None, *known):
        raise ValueError(
            f"`structure` must be one of {known}, or `None` to detect it; got "
            f"{structure!r}."
        )
