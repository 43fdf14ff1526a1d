"""The step of friction and noise at fixed positions, by the implicit midpoint rule."""

import functools as ft
from typing import Any

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


# For up to this many momenta, friction by a matrix is one linear solve in each step. (The
# fused engine takes matrices up to this size, too.) For more, a constant matrix is
# diagonalized once for all steps. With 64 momenta that takes 4 ms, and then a step of
# `BAOAB` 3.6 us in place of 22, or 1.5 us in place of 18 in a batch of 64 paths.
_MAX_SOLVED_IN_EACH_STEP = 16


def check_friction(
    drift: Terms,
    friction: Terms,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
    solver_name: str,
) -> None:
    """Raises a `ValueError`, with advice for users of the solver `solver_name`, unless

    - the momenta are canonical, as those of `spin_terms` and `wave_terms` are not;
    - there is friction, and a drift beside it;
    - the friction is linear in the momenta, and not constant in them.

    The check reads shapes, and what depends on what, but no values, so it works under
    `jit`.
    """
    if has_lifted(drift):
        raise ValueError(
            f"`{solver_name}` applies friction to a canonical momentum, which the state "
            "of `spin_terms` or `wave_terms` does not have: spins would get shorter. Pass "
            "`damping=` to `spin_terms` or `wave_terms`, and use `ImplicitMidpoint`."
        )
    if len(friction) == 0:
        raise ValueError(
            f"`{solver_name}` takes friction on the velocities dH0/dp from the terms, and "
            "these have none. Construct them with `langevin_terms(H0, friction, "
            "temperature, path)`. (Without such friction use `StormerVerlet` or "
            "`ImplicitMidpoint`. A decay of the momenta, -p / tau, is another equation "
            "unless H0 is quadratic in p.)"
        )
    if len(drift) == 0:
        raise ValueError(
            f"`{solver_name}` needs a drift besides friction, that of `H0`."
        )
    p, q = y0
    t0 = jnp.asarray(t0, jnp.result_type(t0, jnp.float32))

    def force(p: PyTree[Array]) -> PyTree[Array]:
        friction_force, _ = rate(friction, t0, (p, q), args)
        return friction_force

    def slope(p: PyTree[Array], change: PyTree[Array]) -> PyTree[Array]:
        """The derivative of the friction along a `change` of the momenta."""
        _, derivative = jax.jvp(force, (p,), (change,))
        return derivative

    # A function is linear, up to a constant, if its derivative is the same everywhere. The
    # friction is G(t, q) times the velocities dH0/dp, so only the velocities can be
    # nonlinear in p. The second `p` stands for the change: only its shapes are read.
    dependence = Dependence(slope, p, p)
    if not dependence.independent(lambda p, change: p):
        raise ValueError(
            f"`{solver_name}` needs friction that is linear in p, but dH0/dp is not: "
            "write the kinetic energy with `p**2` or products such as `p @ p`. For another "
            "kinetic energy use `ImplicitMidpoint` or `StrangGauss`, which take these "
            "terms."
        )
    # The derivative is linear in the change. So if it does not depend on the change, it is
    # zero, and the friction is constant in p.
    if dependence.independent(lambda p, change: change):
        raise ValueError(
            f"`{solver_name}` has no friction to apply: it acts on the velocities "
            "dH0/dp, which do not depend on p. Pass the whole Hamiltonian, with its "
            "kinetic energy, also if a flow solves a part of it: `langevin_terms(H0, "
            "friction, temperature, path, slow=rest)`."
        )


def after_friction(
    friction: Terms,
    t: RealScalarLike,
    h: RealScalarLike,
    y: tuple[PyTree[Array], PyTree[Array]],
    args: Args,
    impulse: PyTree[Array],
) -> PyTree[Array]:
    r"""The momenta $p + x$ after friction and noise over the time `h`, by the implicit
    midpoint rule $x = h F(p + x / 2) + B W$. The force $F(p) = -G v(p)$ of the friction is
    linear in $p$ up to a constant, and $B W$ is the `impulse` of the noise.

    This keeps the Maxwell distribution $\mathcal N(0, T M)$ for all $h$, $M$ and $G = B
    B^\top / (2 T)$. With the change $x$ as unknown, rounding errors are those of a small
    number, and a friction between particles conserves their total momentum.
    """
    p, q = y

    def force(p: PyTree[Array]) -> PyTree[Array]:
        friction_force, _ = rate(friction, t, (p, q), args)
        return friction_force

    # F(p + x / 2) = F(p) + S x / 2, where the matrix S is the derivative, or slope, of F.
    # So x solves the linear equation (1 - h S / 2) x = h F(p) + B W.
    if acts_elementwise(force, p):
        # Each force depends on its own momentum alone. So S is diagonal, the derivative
        # along ones is its diagonal, and x is a quotient.
        ones = jtu.tree_map(jnp.ones_like, p)
        forces, slopes = jax.jvp(force, (p,), (ones,))

        def after_step(p: Array, force: Array, slope: Array, impulse: Array) -> Array:
            step_size = jnp.asarray(h, jnp.result_type(p))
            return p + (step_size * force + impulse) / (1 - step_size / 2 * slope)

        return jtu.tree_map(after_step, p, forces, slopes, impulse)
    flat_p, unravel = jfu.ravel_pytree(p)
    flat_impulse, _ = jfu.ravel_pytree(impulse)

    def flat_force(flat_p: Array) -> Array:
        return jfu.ravel_pytree(force(unravel(flat_p)))[0]

    step_size = jnp.asarray(h, flat_p.dtype)
    slope = jax.jacfwd(flat_force)(flat_p)
    rhs = step_size * flat_force(flat_p) + flat_impulse
    matrix = jnp.eye(flat_p.size, dtype=flat_p.dtype) - step_size / 2 * slope
    # How to solve depends on the number of momenta:
    # - for very few by elimination in XLA operations, in a tenth of LAPACK's time;
    # - for many by modes, if the matrices of the friction are constant;
    # - otherwise by LAPACK.
    solve = eliminate if flat_p.size <= MAX_WRITTEN_OUT else jnp.linalg.solve
    if flat_p.size > _MAX_SOLVED_IN_EACH_STEP:
        matrices = _matrices_if_constant(friction, t, y, args)
        if matrices is not None:
            solve = ft.partial(_solve_by_modes, *matrices, step_size)
    return unravel(flat_p + solve(matrix, rhs))


def _matrices_if_constant(
    friction: Terms, t: RealScalarLike, y: Y, args: Args
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]] | None:
    """The matrices G and M^-1 of the friction force `-G v` with the velocities `v = M^-1
    p`, for momenta as a vector; or `None` unless both matrices are known to be constant:
    the same at all times, momenta and positions.

    In a solve backward in time M^-1 is negated, so that `-G M^-1` is the derivative of the
    negated friction force.
    """
    if len(friction) != 1:
        return None
    field = field_of(friction[0])
    if not isinstance(field, AbstractFriction):
        return None
    p, q = y
    flat_p, unravel = jfu.ravel_pytree(p)

    def matrices(t: Any, flat_p: Array, q: PyTree[Array]) -> tuple[Array, Array]:
        def force(flat_v: Array) -> Array:
            return jfu.ravel_pytree(field.force(t, q, args, unravel(flat_v)))[0]

        def velocity(flat_p: Array) -> Array:
            return jfu.ravel_pytree(field.velocity(t, (unravel(flat_p), q), args))[0]

        # The force is linear in v, so its derivative is the same at every vector of the
        # right shape, such as `flat_p`.
        minus_G = jax.jacfwd(force)(flat_p)
        return -minus_G, jax.jacfwd(velocity)(flat_p)

    t = jnp.asarray(t, jnp.result_type(t, jnp.float32))
    dependence = Dependence(matrices, t, flat_p, q)
    if not dependence.independent(lambda t, flat_p, q: (t, flat_p, q)):
        return None
    G, inverse_masses = matrices(t, flat_p, q)
    return G, direction(friction) * inverse_masses


def _solve_by_modes(
    G: Float[Array, "n n"],
    inverse_masses: Float[Array, "n n"],
    step_size: Float[Array, ""],
    matrix: Float[Array, "n n"],
    rhs: Float[Array, " n"],
) -> Float[Array, " n"]:
    r"""The solution of `matrix @ x = rhs` for `matrix = 1 + step_size / 2 * G M^-1`, by the
    modes of the constant matrices G and M^-1.

    With $G = B B^\top$ these are the modes of the symmetric matrix $B^\top M^{-1} B$, with
    the eigenvectors $U$ and the eigenvalues $D$, the rates at which they are damped. For $L
    = B U$ and $R = L^\top M^{-1}$, $G M^{-1} = L R$ and $R L = D$. So by Woodbury's formula
    the inverse of the matrix is $1 - \frac h2 L (1 + \frac h2 D)^{-1} R$: `R` maps to modes
    and `L` back. Only the columns of `L` are added to `rhs`, so what the friction conserves
    is conserved. The transposed inverse has `L^T` and `R^T` in place of `R` and `L`.

    The modes are the same in all steps, while `matrix` changes with the rounding errors of
    `step_size`. The modes are computed here, in the step: in the state of the solver a
    batch would copy them for each path. On CPUs XLA moves their computation out of the loop
    over steps. On other devices it would stay in the loop and take forty times as long as a
    solve, so these solve with `matrix`.
    """

    def solve(_: Any, b: Array, transposed: bool = False) -> Array:
        def by_modes(rhs: Array) -> Array:
            root = semidefinite_root(G)
            rates, vectors = jnp.linalg.eigh(root.T @ inverse_masses @ root)
            L = root @ vectors
            R = L.T @ inverse_masses
            to_modes = L.T if transposed else R
            from_modes = R.T if transposed else L
            in_modes = (to_modes @ rhs) / (1 + step_size / 2 * rates)
            return rhs - step_size / 2 * (from_modes @ in_modes)

        by_matrix = ft.partial(jnp.linalg.solve, matrix.T if transposed else matrix)
        return lax.platform_dependent(b, cpu=by_modes, default=by_matrix)

    # This takes derivatives of the equation `multiply(x) = rhs`. Those of eigenvectors may
    # be infinite.
    multiply = ft.partial(jnp.matmul, matrix)
    solve_transposed = ft.partial(solve, transposed=True)
    return lax.custom_linear_solve(multiply, rhs, solve, solve_transposed)
