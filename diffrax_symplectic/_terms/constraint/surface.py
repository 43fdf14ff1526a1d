"""The positions that a constraint allows and the momenta tangent to them: projections, and
free flight.

Notation: positions `q`, momenta `p`, velocities `v`; the constraints `g(q) = 0` and their
gradients, the rows of `J`; the inverse `M^-1` of the masses; the multipliers `lambda`. An
impulse is a change of the momentum. That of a constraint force is a sum of gradients,
`J^T x`.
"""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from ..._arguments import is_real_number
from ..._custom_types import Args, RealScalarLike
from ..._root_finder import max_norm, solve_matrix
from ..constrained_drift import Constraint, constraint_of, without_constraint
from ..drift_and_noise import split_friction
from ..evaluation import call_user_function
from ..vector_fields import rate
from .multipliers import (
    find_multipliers,
    Multipliers,
    products,
    solve_tangent,
    Vector,
    weighted_sum,
)


class NormalSpace(NamedTuple):
    """The directions normal to the surface at a position.

    A step uses the directions at one position several times, so they are kept.

    - `q`: the position.
    - `normals`: the gradients of the constraints, `J`.
    - `velocity_changes`: the change of the velocity by each gradient as an impulse,
        `J M^-1`.
    - `gram`: `J M^-1 J^T`.
    """

    q: Vector
    normals: Float[Array, "c n"]
    velocity_changes: Float[Array, "c n"]
    gram: Float[Array, "c c"]


class Surface(NamedTuple):
    """The positions that a constraint allows, `g(q) = 0`, and the momenta tangent to them,
    `J v = 0`. Positions and momenta are flat vectors here.

    - `residual`: `g`, a function of the position.
    - `velocity`: `v = dH0/dp`, a function of the momentum. It is linear up to a constant:
        its derivative is the inverse of the masses, `M^-1`.
    """

    residual: Callable[[Vector], Multipliers]
    velocity: Callable[[Vector], Vector]

    @staticmethod
    def of(
        terms: PyTree[diffrax.AbstractTerm], t: RealScalarLike, y: PyTree, args: Args
    ) -> "Surface":
        """The surface of constrained terms. Its `residual` raises a `ValueError` if the
        constraint does not return an array of shape `(c,)`."""
        constraint = constraint_of(terms)
        assert constraint is not None
        drift, _, _ = split_friction(without_constraint(terms))
        _, q0 = y
        _, unravel = jfu.ravel_pytree(q0)

        def residual(q: Vector) -> Multipliers:
            return _checked_values(constraint, unravel(q), args)

        def velocity(p: Vector) -> Vector:
            # H0 is separable, so any position gives the same velocity. Momenta have the
            # structure of positions, so `unravel` serves for both.
            _, dq = rate(drift, t, (unravel(p), q0), args)
            flat, _ = jfu.ravel_pytree(dq)
            return flat

        return Surface(residual, velocity)

    def normal_space(self, q: Vector) -> NormalSpace:
        """The directions normal to the surface at this position."""
        normals = jax.jacrev(self.residual)(q)
        changes = self._velocity_changes(normals)
        return NormalSpace(q, normals, changes, products(normals, changes))

    def _velocity_changes(self, impulses: Float[Array, "c n"]) -> Float[Array, "c n"]:
        """The change of the velocity by each impulse, a row of `impulses`."""
        # The velocity is linear, so its derivative is the same at every momentum.
        zero = jnp.zeros_like(impulses[0])

        def velocity_change(impulse: Vector) -> Vector:
            _, change = jax.jvp(self.velocity, (zero,), (impulse,))
            return change

        return jax.vmap(velocity_change)(impulses)

    def tangent(
        self,
        p: Vector,
        normal_space: NormalSpace,
        response: Callable[[Vector], Vector] | None = None,
    ) -> Vector:
        """The momentum `p` after the impulse of the constraint forces that makes it
        tangent: `p - J^T x` with `J v = 0`, so `(J M^-1 J^T) x = J v(p)`.

        By default an impulse changes the momentum by the impulse itself. With `response`
        it changes the momentum by `response(impulse)`, for example if friction acts on the
        impulse. Then `response(J^T)` takes the place of `J^T`."""
        # `changes`: the change of the momentum by each normal as an impulse, (c, n).
        # `gram`: the change of `J v` by each of `changes`, (c, c).
        if response is None:
            gram = normal_space.gram
            changes = normal_space.normals
        else:
            changes = jax.vmap(response)(normal_space.normals)
            gram = products(normal_space.normals, self._velocity_changes(changes))
        # `J v`, the speeds at which the momentum `p` would leave the surface.
        speeds = products(normal_space.normals, self.velocity(p)[None])[:, 0]
        return p - weighted_sum(solve_matrix(gram, speeds), changes)

    def free_flight(
        self,
        p: Vector,
        normal_space: NormalSpace,
        time: RealScalarLike,
        pending: Bool[Array, ""] | bool = True,
    ) -> tuple[Vector, Vector, Bool[Array, ""]]:
        r"""Free flight on the surface over the `time` $h$, by a step of RATTLE,

        $$q_1 = q + h\, v(p_1), \qquad p_1 = p - J(q)^\top \lambda, \qquad g(q_1) = 0,$$

        from the position $q$ of the `normal_space`. Returns $p_1$, $q_1$ and whether the
        multipliers $\lambda$ were found. If not `pending`, as for a path that failed
        before, nothing is solved, and they are not found.

        The momentum $p_1$ still has to be made tangent at $q_1$. The momentum $p$ need not
        be tangent: the multipliers make up for its normal part.
        """
        time = jnp.asarray(time, p.dtype)
        # The position without constraint forces.
        unconstrained_q = normal_space.q + time * self.velocity(p)
        rounding = _rounding(normal_space, unconstrained_q)

        # `q_1` for the unknowns `x = h lambda`. (The position hardly depends on `lambda` if
        # `h` is small.) The impulse `-J^T lambda` changes the velocity by
        # `-M^-1 J^T lambda`, and so the position after the time `h` by `-M^-1 J^T x`.
        def end_position(x: Multipliers) -> Vector:
            return unconstrained_q - weighted_sum(x, normal_space.velocity_changes)

        # The left-hand side of the equation to solve, `g(q_1) = 0`.
        def equation(x: Multipliers) -> Multipliers:
            return self.residual(end_position(x))

        def solve(fn: Callable, start: Multipliers) -> tuple[Multipliers, Array]:
            x, found = find_multipliers(
                fn, normal_space.gram, rounding, start, jnp.asarray(pending)
            )
            # The flag becomes a float: `custom_root` gives other types a tangent of a wrong
            # type.
            return x, found.astype(x.dtype)

        # Derivatives come from the equation, and not through the loop that solves it.
        zeros = jnp.zeros(len(normal_space.gram), p.dtype)
        x, found = lax.custom_root(equation, zeros, solve, solve_tangent, has_aux=True)
        p1 = p - weighted_sum(x / time, normal_space.normals)
        return p1, end_position(x), found > 0

    def is_dependent(self, normal_space: NormalSpace) -> Bool[Array, ""]:
        """Whether the normals are linearly dependent, up to rounding errors: whether the
        angle between one of them and the space of those before it is about zero."""
        # Backward in time, velocities change their sign, and with them the Gram matrix.
        gram = normal_space.gram * jnp.sign(jnp.trace(normal_space.gram))
        lengths = jnp.sqrt(jnp.diag(gram))
        # The cosines of the angles between normals. Each pivot of their Cholesky factor, a
        # squared diagonal entry, is the squared sine of an angle to the normals before.
        cosines = gram / lengths / lengths[:, None]
        pivots = jnp.diag(jnp.linalg.cholesky(cosines)) ** 2
        rounding = 1000 * jnp.finfo(gram.dtype).eps
        # Not `any(pivots <= rounding)`, which would be false for NaN. NaN comes from a
        # normal that is zero, or where there is no Cholesky factor.
        return ~jnp.all(pivots > rounding)

    def is_off(self, p: Vector, normal_space: NormalSpace) -> Bool[Array, ""]:
        """Whether a state is farther from the surface than rounding errors explain: whether
        its position, that of the `normal_space`, is not on the surface, or its momentum `p`
        is not tangent."""
        # Two thirds of the digits have to agree. This bound lies above the rounding errors
        # of long sums, and below what a mistake of the user's gives.
        eps = float(jnp.finfo(p.dtype).eps)
        bound = eps ** (2 / 3)
        q = normal_space.q
        # The size of the terms that cancel in each constraint, such as one for `q^2 - 1`.
        # It follows from the size of the positions or, near the origin, from the curvature
        # of the surface.
        size = jnp.maximum(
            _rounding(normal_space, q) / eps, self._size_by_curvature(normal_space)
        )
        # Both comparisons are false for NaN, so a state with NaN is off.
        position_is_on = jnp.all(jnp.abs(self.residual(q)) <= bound * size)
        normal_part = p - self.tangent(p, normal_space)
        momentum_is_tangent = max_norm(normal_part) <= bound * max_norm(p)
        return ~(position_is_on & momentum_is_tangent)

    def _size_by_curvature(self, normal_space: NormalSpace) -> Float[Array, " c"]:
        r"""An estimate of the size of the terms that cancel in each constraint $g$: the
        gradient times the radius of curvature, $|g'| \cdot |g'| / |g''|$, with $g''$ along
        an arbitrary direction. For $q^2 - 1 = 0$ it is $2 q^2 = 2$, for terms of size one.
        It is zero for a plane.

        It matters near the origin. There the positions are smaller than these terms, and
        the rounding errors of the positions are smaller than the terms' own.
        """
        q = normal_space.q
        # An arbitrary direction, which no symmetry of the constraint singles out.
        direction = jnp.cos(1.0 + jnp.arange(len(q), dtype=q.dtype))
        # How the gradient of each constraint changes along it.
        _, gradient_changes = jax.jvp(jax.jacrev(self.residual), (q,), (direction,))
        # Sums over the positions, the last axis.
        curvatures = jnp.sum(jnp.abs(gradient_changes), axis=1)
        squared_gradients = jnp.sum(normal_space.normals**2, axis=1)
        return squared_gradients / jnp.where(curvatures > 0, curvatures, jnp.inf)


def _rounding(normal_space: NormalSpace, q: Vector) -> Multipliers:
    """The rounding error of each constraint: its largest change if each entry of the
    position `q` changes by one unit in the last place."""
    info = jnp.finfo(q.dtype)
    last_places = float(info.eps) * jnp.abs(q)
    changes = products(jnp.abs(normal_space.normals), last_places[None])[:, 0]
    # The result is a divisor, so it must not be zero.
    return changes + float(info.tiny)


def _checked_values(
    constraint: Constraint, q: PyTree, args: Args
) -> Float[Array, " c"]:
    """The values of the constraints. Raises a `ValueError` unless they are a real array of
    shape `(c,)`."""
    value = call_user_function("constraint", constraint, q, args=args)
    if not is_real_number(value) or jnp.ndim(value) != 1 or jnp.size(value) == 0:
        # The dtype and the shape, as in `f32[2]`: either may be wrong.
        got = eqx.tree_pformat(value, struct_as_array=True)
        raise ValueError(
            "`constraint(q, args)` must return a real array of shape `(c,)`, one number "
            f"for each constraint; got {got}. For one constraint write "
            "`jnp.stack([...])`."
        )
    return jnp.asarray(value, jnp.result_type(*jtu.tree_leaves(q)))
