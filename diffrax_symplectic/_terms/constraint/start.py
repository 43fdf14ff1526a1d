"""States that a constraint allows: `constrained_state` finds one near a given state, and
`check_start` checks the state at the start of a solve."""

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from ..._arguments import check_pair, check_state
from ..._batch import refused_where
from ..._compat import is_traced
from ..._custom_types import Args, RealScalarLike
from ..callers import with_programs
from ..constrained_drift import constraint_of, without_constraint
from ..dependence import Dependence
from ..drift_and_noise import split_friction
from ..structure import separable_fault
from ..vector_fields import check_terms_fit_state
from .multipliers import Vector
from .surface import Surface


_DEPENDENT = (
    "The gradients of the constraints at `y0` are linearly dependent, or zero. Leave out "
    "constraints that follow from the others, and write each so that its gradient does not "
    "vanish where it is zero, such as `jnp.sum(q**2) - 1`. For atoms on a line no distance "
    "follows from the others: fix one, and put each atom between its ends on the line, "
    "for a middle one by `q[1] - (q[0] + q[2]) / 2` in place of its distances."
)


_OFF = (
    "`y0` is off the constraint, or its momenta are not tangent to it. Pass "
    "`constrained_state(terms, y0, args)`. (Diffrax converts a float32 state to the dtype "
    "of the times. If they are float64, pass them as `jnp.float32(t)`, too, or `y0` in "
    "float64: a state on the constraint to single precision is off it in double.)"
)


def check_start(
    terms: PyTree[diffrax.AbstractTerm], t0: RealScalarLike, y0: PyTree, args: Args
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Checks that a solve with constraints can start at `y0`. Raises a `ValueError` for
    masses that are not constant.

    Returns two flags: whether the constraints are linearly dependent at `y0`, and whether
    `y0` is off the constraints. What a flag that is true does:

    - if it is known while tracing, it raises a `ValueError`;
    - under `vmap` it raises nothing, and the caller has to make the path fail;
    - otherwise it raises an error when run.
    """
    _check_constant_masses(terms, t0, y0, args)
    # Flags have no derivative. Without `stop_gradient`, `grad` would differentiate the
    # operations of the checks all the same.
    fixed_y0, fixed_args = jtu.tree_map(
        lambda x: lax.stop_gradient(x) if eqx.is_inexact_array(x) else x, (y0, args)
    )
    is_dependent, is_off = _start_faults(terms, t0, fixed_y0, fixed_args)
    return refused_where(is_dependent, _DEPENDENT), refused_where(is_off, _OFF)


# Without `jit` the operations of this function would be compiled one by one.
@eqx.filter_jit
def _start_faults(
    terms: PyTree[diffrax.AbstractTerm], t0: RealScalarLike, y0: PyTree, args: Args
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether the constraints are linearly dependent at `y0`; and whether they are not, but
    `y0` is off the constraints."""
    surface = Surface.of(terms, t0, y0, args)
    p0, q0 = y0
    p, _ = jfu.ravel_pytree(p0)
    q, _ = jfu.ravel_pytree(q0)
    normal_space = surface.normal_space(q)
    is_dependent = surface.is_dependent(normal_space)
    return is_dependent, ~is_dependent & surface.is_off(p, normal_space)


def _check_constant_masses(
    terms: PyTree[diffrax.AbstractTerm], t0: RealScalarLike, y0: PyTree, args: Args
) -> None:
    """Raises a `ValueError` unless the masses are constant, that is, unless the second
    derivative of H0 by the momenta, the inverse `M^-1` of the masses, does not depend on
    the momenta."""
    surface = Surface.of(terms, t0, y0, args)
    p0, _ = y0
    flat_p0, _ = jfu.ravel_pytree(p0)

    # `M^-1` times an impulse, which is a change of the momentum.
    def change_of_velocity(p: Vector, impulse: Vector) -> Vector:
        _, change = jax.jvp(surface.velocity, (p,), (impulse,))
        return change

    # Only shapes count here. The second `flat_p0` stands for an impulse.
    dependence = Dependence(change_of_velocity, flat_p0, flat_p0)
    if not dependence.independent(of=lambda p, impulse: p):
        raise ValueError(
            "Constrained terms need constant masses, H0 = p . M^-1 p / 2 + "
            "U(t, q), but the second derivative of H0 by p depends on p. Write squares of "
            "momenta, such as `jnp.sum(p**2 / mass) / 2`."
        )


def constrained_state(
    terms: PyTree[diffrax.AbstractTerm], y0: PyTree, args: Args = None
) -> PyTree:
    r"""A state that a constraint allows, near a given one.

    Positions are moved along $M^{-1} J^\top$, with the masses $M$ of $H_0$ and the
    gradients $J$ of the constraints at the given positions, until `constraint(q, args)` is
    zero. Momenta lose their part along $J^\top$ at the new positions, so that $J M^{-1} p =
    0$: of all allowed momenta these are the nearest in kinetic energy.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp

        H0 = lambda t, p, q, args: jnp.sum(p**2) / 2 + q[1]
        rod = lambda q, args: jnp.stack([jnp.sum(q**2) - 1])
        pendulum = ds.hamiltonian_terms(H0, constraint=rod)
        y0 = (jnp.array([0.3, 0.1]), jnp.array([2.0, 0.0]))
        p, q = ds.constrained_state(pendulum, y0)
        print(p, q)  # [0, 0.1] and [1, 0]
        ```

    **Arguments:**

    - `terms`: constrained terms, made with `constraint=`.
    - `y0`: the state `(p, q)`.
    - `args`: as for `diffrax.diffeqsolve`.

    **Returns:** the pair `(p, q)`. Differentiable.

    **Raises:** a `ValueError` if the terms have no constraint, if no solver takes them, if
    the constraints are dependent at `y0`, or if Newton's method finds no allowed positions.
    If this is not known while tracing, the state is NaN, and a solve from there fails.
    """
    if constraint_of(terms) is None:
        raise ValueError(
            "`constrained_state` needs constrained terms, such as "
            "`hamiltonian_terms(H0, constraint=constraint)`."
        )
    check_pair(y0)
    check_state("constrained_state", y0)
    t = jnp.zeros((), jnp.result_type(*jtu.tree_leaves(y0)))
    terms = with_programs(terms, t, y0, args)
    drift, _, _ = split_friction(without_constraint(terms))
    check_terms_fit_state(diffrax.MultiTerm(*drift), t, y0, args)
    if fault := separable_fault(drift, (), t, y0, args):
        raise ValueError(
            "Constrained terms need H0 = p . M^-1 p / 2 + U(t, q), but "
            f"{fault.reason}. {fault.advice}"
        )
    _check_constant_masses(terms, t, y0, args)
    y1, found, is_dependent = _projection(terms, t, y0, args)
    # Traced flags cannot raise an error.
    if not is_traced(found):
        if is_dependent:
            raise ValueError(_DEPENDENT)
        if not found:
            raise ValueError(
                "`constrained_state` found no positions with `constraint(q, args) = 0` "
                "from `y0`. Pass one that is closer to them."
            )
    is_valid = found & ~is_dependent
    return jtu.tree_map(lambda x: jnp.where(is_valid, x, jnp.nan), y1)


@eqx.filter_jit
def _projection(
    terms: PyTree[diffrax.AbstractTerm], t: RealScalarLike, y0: PyTree, args: Args
) -> tuple[PyTree, Bool[Array, ""], Bool[Array, ""]]:
    """An allowed state near `y0`, whether Newton's method found it, and whether the
    constraints are linearly dependent there."""
    surface = Surface.of(terms, t, y0, args)
    p0, q0 = y0
    p, unravel_p = jfu.ravel_pytree(p0)
    q, unravel_q = jfu.ravel_pytree(q0)
    # A free flight ends at positions that the constraint allows. Without momentum only the
    # multipliers move the positions, along `M^-1 J^T`.
    no_momentum = jnp.zeros_like(p)
    normal_space = surface.normal_space(q)
    _, q, found = surface.free_flight(no_momentum, normal_space, time=1.0)
    normal_space = surface.normal_space(q)
    # The second projection removes the rounding errors of the first one. They matter if the
    # momentum was nearly normal to the surface, so that little of it is left.
    p = surface.tangent(surface.tangent(p, normal_space), normal_space)
    y1 = (unravel_p(p), unravel_q(q))
    return y1, found, surface.is_dependent(normal_space)
