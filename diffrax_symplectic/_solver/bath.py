"""The step of friction and noise at fixed positions, by the implicit midpoint rule."""

import functools as ft
from typing import Any, NamedTuple

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Float, PyTree

from .._compat import direction
from .._custom_types import Args, RealScalarLike, Terms, Y
from .._root_finder import eliminate, MAX_WRITTEN_OUT
from .._terms import (
    AbstractFriction,
    acts_elementwise,
    Dependence,
    field_of,
    has_lifted,
    rate,
    semidefinite_root,
)


# Up to this many momenta, friction by a matrix is one linear solve in each step, which the
# fused engine replays, too. Above, where that engine takes no matrices, constant matrices
# are diagonalized once. With 64 momenta that takes 4 ms, and a step of `BAOAB` 3.6 us in
# place of 22, or 1.5 us in place of 18 in a batch of 64 paths.
_MAX_SOLVED = 16


def check_friction(
    drift: Terms, friction: Terms, t0: RealScalarLike, y0: Y, args: Args, solver: str
) -> None:
    """Raises a `ValueError` unless there is friction that is linear in the momenta, and a
    drift beside it. `drift` and `friction` are the terms of each, and `solver` is the name
    for messages. Shapes and dependence decide it, not values, so it works under `jit`."""
    if has_lifted(drift):
        raise ValueError(
            f"`{solver}` applies friction to a canonical momentum, which the state of "
            "`spin_terms` or `wave_terms` does not have: spins would get shorter. Pass "
            "`damping=` to `spin_terms` or `wave_terms`, and use `ImplicitMidpoint`."
        )
    if len(friction) == 0:
        raise ValueError(
            f"`{solver}` takes friction from the terms, and these have none. Construct "
            "them with `langevin_terms(H0, friction, temperature, path)`. (Without "
            "friction use `StormerVerlet` or `ImplicitMidpoint`.)"
        )
    if len(drift) == 0:
        raise ValueError(f"`{solver}` needs a drift besides friction, that of `H0`.")
    p, q = y0
    t0 = jnp.asarray(t0, jnp.result_type(t0, jnp.float32))

    def slope(p: PyTree[Array], along: PyTree[Array]) -> PyTree[Array]:
        """The derivative of the force along a change of the momenta."""

        def force(p: PyTree[Array]) -> PyTree[Array]:
            return rate(friction, t0, (p, q), args)[0]

        return jax.jvp(force, (p,), (along,))[1]

    # A function is linear, up to a constant, if its derivative is the same everywhere. The
    # friction is G(t, q) times the velocities dH0/dp, so only these can be nonlinear in p.
    traced = Dependence(slope, p, p)
    if not traced.independent(lambda p, along: p):
        raise ValueError(
            f"`{solver}` needs friction that is linear in p, but dH0/dp is not: write the "
            "kinetic energy with `p**2` or products such as `p @ p`. For another kinetic "
            "energy use `ImplicitMidpoint` or `StrangGauss`, which take these terms."
        )
    # The derivative is zero along every change, so the force is constant in p.
    if traced.independent(lambda p, along: along):
        raise ValueError(
            f"`{solver}` has no friction to apply: it acts on the velocities dH0/dp, which "
            "do not depend on p. Pass the whole Hamiltonian, with its kinetic energy, also "
            "if a flow solves a part of it: `langevin_terms(H0, friction, temperature, "
            "path, slow=rest)`."
        )


def after_friction(
    friction: Terms,
    t: RealScalarLike,
    h: RealScalarLike,
    y: tuple[PyTree[Array], PyTree[Array]],
    args: Args,
    kick: PyTree[Array] | None = None,
) -> PyTree[Array]:
    r"""The momenta after friction and noise over `h`, with the `kick` $B W$ of the noise:
    $p + x$ with $x = h F(p + x / 2) + B W$, where $F(p) = -G v(p)$ is linear in $p$.

    This keeps the Maxwell distribution $\mathcal N(0, T M)$ for all $h$, $M$ and $G = B
    B^\top / (2 T)$. With the increment $x$ as unknown, rounding errors are those of a small
    number, and a friction between particles conserves their total momentum.
    """
    p, q = y

    def force(p: PyTree[Array]) -> PyTree[Array]:
        return rate(friction, t, (p, q), args)[0]

    if kick is None:
        kick = jtu.tree_map(jnp.zeros_like, p)
    if acts_elementwise(force, p):
        # One equation for each momentum, whose slope is the derivative along ones.
        ones = jtu.tree_map(jnp.ones_like, p)
        value, slope = jax.jvp(force, (p,), (ones,))

        def moved(p: Array, value: Array, slope: Array, kick: Array) -> Array:
            step = jnp.asarray(h, jnp.result_type(p))
            return p + (step * value + kick) / (1 - step / 2 * slope)

        return jtu.tree_map(moved, p, value, slope, kick)
    flat, unravel = jfu.ravel_pytree(p)

    def flat_force(flat: Array) -> Array:
        return jfu.ravel_pytree(force(unravel(flat)))[0]

    step = jnp.asarray(h, flat.dtype)
    slope = jax.jacfwd(flat_force)(flat)
    right = step * flat_force(flat) + jfu.ravel_pytree(kick)[0]
    matrix = jnp.eye(flat.size, dtype=flat.dtype) - step / 2 * slope
    constant = None
    if flat.size > _MAX_SOLVED:
        constant = _matrices_if_constant(friction, t, y, args)
    if constant is not None:
        return unravel(flat + _solve_by_modes(constant, step, matrix, right))
    # Elimination in XLA operations takes a tenth of LAPACK's time for matrices this small.
    solve = eliminate if flat.size <= MAX_WRITTEN_OUT else jnp.linalg.solve
    return unravel(flat + solve(matrix, right))


class _Matrices(NamedTuple):
    """What the step of friction is made of, for momenta as a vector.

    - `friction`: the friction on velocities, G.
    - `inverse_masses`: the derivative of the velocities by the momenta, M^-1. In a solve
        backward in time it has the other sign, as friction has.
    """

    friction: Float[Array, "n n"]
    inverse_masses: Float[Array, "n n"]


def _matrices_if_constant(
    friction: Terms, t: RealScalarLike, y: Y, args: Args
) -> _Matrices | None:
    """The matrices of friction that is known to be the same at all times and positions."""
    if len(friction) != 1:
        return None
    field = field_of(friction[0])
    if not isinstance(field, AbstractFriction):
        return None
    p, q = y
    flat, unravel = jfu.ravel_pytree(p)

    def matrices(t: Any, p: Array, q: PyTree[Array]) -> _Matrices:
        def force(velocity: Array) -> Array:
            return jfu.ravel_pytree(field.force(t, q, args, unravel(velocity)))[0]

        def velocity(p: Array) -> Array:
            return jfu.ravel_pytree(field.velocity(t, (unravel(p), q), args))[0]

        return _Matrices(-jax.jacfwd(force)(p), jax.jacfwd(velocity)(p))

    t = jnp.asarray(t, jnp.result_type(t, jnp.float32))
    if not Dependence(matrices, t, flat, q).independent(lambda t, p, q: (t, p, q)):
        return None
    G, inverse_masses = matrices(t, flat, q)
    return _Matrices(G, direction(friction) * inverse_masses)


def _solve_by_modes(
    constant: _Matrices,
    step: Float[Array, ""],
    matrix: Float[Array, "n n"],
    right: Float[Array, " n"],
) -> Float[Array, " n"]:
    """The solution of `matrix @ x = right` for `matrix = 1 + step / 2 * G M^-1`, by the
    modes of the `constant` matrices G and M^-1.

    The modes do not depend on the step. (Sizes of steps differ by rounding errors, so that
    `matrix` itself is not the same in all; it carries the derivatives.) They are computed
    here, in the step, since a batch would copy them into the state of each path. On CPUs
    XLA moves them out of the loop. Elsewhere it leaves them there, forty times as long as a
    solve.
    """

    def multiply(x: Array) -> Array:
        return matrix @ x

    def by_modes(rhs: Array) -> Array:
        return _Modes.of(constant).solve(step, rhs)

    def by_modes_transposed(rhs: Array) -> Array:
        return _Modes.of(constant).transposed().solve(step, rhs)

    def solve(_: Any, rhs: Array) -> Array:
        elsewhere = ft.partial(jnp.linalg.solve, matrix)
        return lax.platform_dependent(rhs, cpu=by_modes, default=elsewhere)

    def solve_transposed(_: Any, rhs: Array) -> Array:
        elsewhere = ft.partial(jnp.linalg.solve, matrix.T)
        return lax.platform_dependent(rhs, cpu=by_modes_transposed, default=elsewhere)

    # Its derivatives are those of the equation. Those of eigenvectors may be infinite.
    return lax.custom_linear_solve(multiply, right, solve, solve_transposed)


class _Modes(NamedTuple):
    r"""The modes of a friction matrix $G = B B^\top$ for momenta with the masses $M$: those
    of the symmetric matrix $B^\top M^{-1} B$.

    - `left`: $B U$, with the eigenvectors $U$ as columns.
    - `right`: $U^\top B^\top M^{-1}$, so that $G M^{-1}$ is `left @ right`.
    - `rates`: the eigenvalues, the rates at which the modes are damped.
    """

    left: Float[Array, "n n"]
    right: Float[Array, "n n"]
    rates: Float[Array, " n"]

    @staticmethod
    def of(matrices: _Matrices) -> "_Modes":
        root = semidefinite_root(matrices.friction)
        rates, vectors = jnp.linalg.eigh(root.T @ matrices.inverse_masses @ root)
        left = root @ vectors
        return _Modes(left, left.T @ matrices.inverse_masses, rates)

    def transposed(self) -> "_Modes":
        return _Modes(self.right.T, self.left.T, self.rates)

    def solve(self, step: Float[Array, ""], rhs: Float[Array, " n"]) -> Array:
        r"""$(1 + \frac h2 G M^{-1})^{-1}$ times a vector. It moves along the columns of
        `left` only, so what the friction conserves is conserved."""
        along = (self.right @ rhs) / (1 + step / 2 * self.rates)
        return rhs - step / 2 * (self.left @ along)
