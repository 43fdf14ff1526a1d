"""Langevin dynamics: friction on velocities, and the noise of a temperature."""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from ..._arguments import check_pair, check_takes
from ..._brownian import increment_struct, TruncatedBrownianPath
from ..._compat import ω
from ..._custom_types import Args, BM, RealScalarLike
from ..constrained_drift import Constraint, with_constraint
from ..evaluation import checked_energy
from ..hamiltonian import hamiltonian_terms
from ..paths import as_path
from ..symplectic_gradients import (
    AbstractFriction,
    AbstractNoise,
    AssertedStructure,
)
from .friction import (
    checked_friction,
    checked_temperature,
    FrictionAlong,
    FrictionValue,
    product_with,
    root_product_with,
    Value,
    value_at,
)


# Momenta, velocities or positions: an array, or a PyTree of arrays.
_HalfState = PyTree[Array]
_Hamiltonian = Callable[[RealScalarLike, _HalfState, _HalfState, Args], PyTree[Array]]


def langevin_terms(
    H0: _Hamiltonian,
    friction: FrictionValue | FrictionAlong,
    temperature: Value | None = None,
    path: diffrax.AbstractBrownianPath | PyTree | None = None,
    *,
    structure: AssertedStructure | None = None,
    constraint: Constraint | None = None,
    slow: Callable[[RealScalarLike, _HalfState, Args], Array] | None = None,
) -> diffrax.MultiTerm:
    r"""The terms of Langevin dynamics: a Hamiltonian system in a heat bath. Solve with
    [`diffrax_symplectic.BAOAB`][] unless masses depend on positions, then with
    `BAOAB(ImplicitMidpoint())`.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H0 = lambda t, p, q, args: (p**2 + q**2) / 2
        terms = ds.langevin_terms(H0, 1.0, 0.5, ())  # friction, temperature, one noise
        y0 = (jnp.array(0.0), jnp.array(0.0))
        square = lambda t, y, args: y[1] ** 2
        call = square, terms, ds.BAOAB(), 0, 20, 0.2, y0
        print(ds.expectation(*call, key=jr.key(0)))  # exactly 0.5
        ```

    For the state $y = (p, q)$,

    $$\mathrm{d}p = -\frac{\partial H_0}{\partial q}\,\mathrm{d}t
        - G \frac{\partial H_0}{\partial p}\,\mathrm{d}t + B\,\mathrm{d}w, \qquad
      \mathrm{d}q = \frac{\partial H_0}{\partial p}\,\mathrm{d}t, \qquad
      B B^\top = 2 T G.$$

    The friction $G$ is a force over a velocity, symmetric positive semidefinite; for a rate
    $\gamma$, pass $G = \gamma m$. If $H_0$ and $T$ are constant, $e^{-H_0 / T}$ is
    stationary. Itô and Stratonovich agree.

    Solvers for heat baths, such as `BAOAB`, treat friction in a step of their own; other
    solvers put it in the drift, with positions wrong to first order if masses depend on
    them; [`diffrax_symplectic.LinearFlow`][] refuses it. Add noise by
    [`diffrax_symplectic.noise_terms`][], a second bath by
    [`diffrax_symplectic.bath_terms`][], each with its own key.

    $B$ holds the roots of $G$ and $T$. Where one of these is zero, the derivative of its
    root, which is infinite, counts as zero in gradients.

    **Arguments:**

    - `H0`: `H0(t, p, q, args)`, as for [`diffrax_symplectic.hamiltonian_terms`][].
    - `friction`: the friction $G$, in units of force over velocity: a number; an array with
        the shape of `p`, in which any axis may have length one, such as `rate * masses` for
        masses of shape `(n, 1)`; for momenta in a PyTree a PyTree of these; or a symmetric
        positive semidefinite matrix, as an operator of Lineax that is tagged as such. Or a
        function `(t, q, args)` that returns one of these. Or a
        [`diffrax_symplectic.FrictionAlong`][].
    - `temperature`: the temperature $T$, in units of energy: a number; for friction by
        numbers also an array or PyTree, as for `friction`; or a function `(t, q, args)` of
        these. `None` for friction without noise.
    - `path`: the Brownian path or its shape, as for
        [`diffrax_symplectic.hamiltonian_terms`][]: the shape of `q`, or `(m,)` for the `m`
        directions of a `FrictionAlong`. Of a
        [`diffrax_symplectic.TruncatedBrownianPath`][], which would cool the bath, the path
        within is taken.
    - `structure`: as for [`diffrax_symplectic.hamiltonian_terms`][].
    - `constraint`: as for [`diffrax_symplectic.hamiltonian_terms`][]. Then
        [`diffrax_symplectic.BAOAB`][] is the solver. Friction and noise act within the
        allowed momenta; the density is $e^{-H_0 / T}$ on the allowed states.
    - `slow`: as for [`diffrax_symplectic.hamiltonian_terms`][]: a potential that is a part
        of the energy, so that the density is $e^{-(H_0 + U) / T}$.

    **Returns:** `MultiTerm(drift, noise)`, or without `temperature` `MultiTerm(drift)`.

    **Raises:** as [`diffrax_symplectic.hamiltonian_terms`][]; a `ValueError` if numbers are
    known to be negative or not finite, or a matrix not to be symmetric positive
    semidefinite; and, while the solve is traced, if their shapes do not fit. Paths fail
    where this is not known before.
    """
    # Drift and friction become one term, whose vector field is a `Drift` with the friction
    # of the bath. The constraint comes around both.
    (frictionless,) = hamiltonian_terms(H0, structure=structure, slow=slow).terms
    friction_term, *noise = bath_terms(H0, friction, temperature, path).terms
    field = dataclasses.replace(
        frictionless.vector_field,
        made_by="langevin_terms",
        friction=friction_term.vector_field,
    )
    drift = with_constraint(diffrax.ODETerm(field), constraint)
    return diffrax.MultiTerm(drift, *noise)


def bath_terms(
    H0: _Hamiltonian,
    friction: FrictionValue | FrictionAlong,
    temperature: Value | None = None,
    path: diffrax.AbstractBrownianPath | PyTree | None = None,
) -> diffrax.MultiTerm:
    r"""The friction and the noise of [`diffrax_symplectic.langevin_terms`][] alone:
    $\mathrm{d}p = -G\, \partial H_0 / \partial p\,\mathrm{d}t + B\,\mathrm{d}w$.

    Add them to other terms, `diffrax.MultiTerm(*terms.terms, *bath.terms)`: a second bath,
    or friction beside noise of another kind.

    **Arguments** and errors are those of [`diffrax_symplectic.langevin_terms`][].

    **Returns:** `MultiTerm(friction, noise)`, or without `temperature`
    `MultiTerm(friction)`.
    """
    check_takes("H0", H0, "t", "p", "q", "args")
    if (temperature is None) != (path is None):
        raise ValueError(
            "Pass both a `temperature` and a `path` with the shape of `q`, or for friction "
            "without noise neither of them."
        )
    if path is None:
        field = Friction(H0, checked_friction(friction, path_struct=None))
        return diffrax.MultiTerm(diffrax.ODETerm(field))
    path = as_path(path)
    if isinstance(path, TruncatedBrownianPath):
        # `solver.path` may truncate increments, without knowing the terms. Truncated
        # increments would cool the bath.
        path = path.path
    field = Friction(H0, checked_friction(friction, increment_struct(path)))
    # Both terms hold the same friction, so that they cannot get out of balance.
    noise = BathNoise(field.friction, checked_temperature(temperature), path)
    return diffrax.MultiTerm(diffrax.ODETerm(field), noise)


class Friction(AbstractFriction):
    """The vector field `(-G dH0/dp, 0)` of a friction `G`, in one of the forms that
    `checked_friction` returns."""

    H0: _Hamiltonian
    friction: Any

    def called_with(self, t, y, args):
        p, q = y
        return {"H0": (t, p, q, args), "friction": (t, q, args)}

    def velocity(self, t, y, args):
        p, q = y

        def energy(p: _HalfState) -> Array:
            return checked_energy("H0", self.H0, t, p, q, args=args)

        return jax.grad(energy)(p)

    def force(self, t, q, args, velocity):
        return (-(product_with(self.friction, t, q, args, velocity) ** ω)).ω


class BathNoise(AbstractNoise):
    """The noise `(B dw, 0)` with `B B^T = 2 T G`, for the friction `G` and the temperature
    `T`."""

    friction: Any
    temperature: Value
    path: diffrax.AbstractBrownianPath

    def called_with(self, t, y, args):
        _, q = y
        return {"friction": (t, q, args), "temperature": (t, q, args)}

    def vf_prod(
        self,
        t: RealScalarLike,
        y: tuple[_HalfState, _HalfState],
        args: Args,
        control: BM,
    ) -> tuple[_HalfState, _HalfState]:
        check_pair(y)
        _, q = y
        T = value_at("temperature", self.temperature, t, q, args)
        kick = root_product_with(self.friction, T, t, q, args, control)
        return kick, jtu.tree_map(jnp.zeros_like, q)
