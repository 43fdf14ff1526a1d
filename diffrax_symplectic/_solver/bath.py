"""The step of friction and noise at fixed positions, by the implicit midpoint rule."""

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from .._custom_types import Args, RealScalarLike, Y
from .._root_finder import eliminate, MAX_WRITTEN_OUT
from .._terms import acts_elementwise, Dependence, rate


def check_friction(
    drift: tuple, friction: tuple, t0: RealScalarLike, y0: Y, args: Args, solver: str
) -> None:
    """Raises a `ValueError` unless there is friction that is linear in the momenta, and a
    drift beside it."""
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
    force = lambda t, p, q: rate(friction, t, (p, q), args)[0]

    def slope(t, p, q, direction):
        return jax.jvp(lambda p: force(t, p, q), (p,), (direction,))[1]

    traced = Dependence(slope, t0, p, q, p)
    if not traced.independent(lambda t, p, q, direction: p):
        raise ValueError(
            f"`{solver}` needs friction that is linear in p, but dH0/dp is not: write the "
            "kinetic energy with `p**2` or products such as `p @ p`. For another kinetic "
            "energy use `ImplicitMidpoint` or `StrangGauss`, which take these terms."
        )
    if traced.independent(lambda t, p, q, direction: direction):
        raise ValueError(
            f"`{solver}` has no friction to apply: it acts on the velocities dH0/dp, which "
            "do not depend on p. If the kinetic energy is a part of the flow of a "
            "`LinearFlow`, take friction and noise from terms of the whole Hamiltonian: "
            "`MultiTerm(*hamiltonian_terms(rest).terms, *bath_terms(whole, friction, "
            "temperature, path).terms)`."
        )


def after_friction(
    friction: tuple,
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
    force = lambda p: rate(friction, t, (p, q), args)[0]
    if kick is None:
        kick = jtu.tree_map(jnp.zeros_like, p)
    if acts_elementwise(force, p):

        def moved(p, value, slope, kick):
            step = jnp.asarray(h, jnp.result_type(p))
            return p + (step * value + kick) / (1 - step / 2 * slope)

        value, slope = jax.jvp(force, (p,), (jtu.tree_map(jnp.ones_like, p),))
        return jtu.tree_map(moved, p, value, slope, kick)
    flat, unravel = jfu.ravel_pytree(p)
    flat_force = lambda x: jfu.ravel_pytree(force(unravel(x)))[0]
    step = jnp.asarray(h, flat.dtype)
    right = step * flat_force(flat) + jfu.ravel_pytree(kick)[0]
    one = jnp.eye(flat.size, dtype=flat.dtype)
    matrix = one - step / 2 * jax.jacfwd(flat_force)(flat)
    # Elimination in XLA operations takes a tenth of LAPACK's time for matrices this small.
    solve = eliminate if flat.size <= MAX_WRITTEN_OUT else jnp.linalg.solve
    return unravel(flat + solve(matrix, right))
