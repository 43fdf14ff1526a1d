"""The states that a constraint allows: projections onto them, and free flight on them."""

import functools as ft
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, Float, PyTree

from .._arguments import check_pair, check_state, is_real_number
from .._batch import batched_like, refused_where
from .._compat import is_traced
from .._custom_types import Args, RealScalarLike
from .._root_finder import correction, max_norm, solve_matrix
from .constraint import Constraint, constraint_of, without_constraint
from .dependence import Dependence
from .hamiltonian import evaluated
from .langevin import split_friction
from .structure import separable_fault
from .vector_fields import check_fit, rate


_Vector: TypeAlias = Float[Array, " n"]
_Multipliers: TypeAlias = Float[Array, " c"]

# Newton's method takes three or four steps, and up to twice as many from far away.
_MOST_STEPS = 30
# A fraction of so many units in the last place is a rounding error.
_ROUNDING = 10.0


class Frame(NamedTuple):
    """The directions normal to the surface at a position.

    A step uses those at its ends and at its middle several times, so they are kept.

    - `q`: the position.
    - `normals`: the gradients of the constraints, `J`.
    - `along`: the changes of the velocity by impulses along them, `J M^-1`.
    - `gram`: `J M^-1 J^T`.
    """

    q: _Vector
    normals: Float[Array, "c n"]
    along: Float[Array, "c n"]
    gram: Float[Array, "c c"]


class Surface(NamedTuple):
    """The positions that a constraint allows and the momenta tangent to them, `J v = 0`.
    Both are vectors.

    - `residual`: the constraint, as a function of the position.
    - `velocity`: `v = dH0/dp` as a function of the momentum, which is linear up to a
        constant: its derivative is the inverse of the masses, `M^-1`.
    """

    residual: Callable[[_Vector], _Multipliers]
    velocity: Callable[[_Vector], _Vector]

    @staticmethod
    def of(
        terms: PyTree[diffrax.AbstractTerm], t: RealScalarLike, y: PyTree, args: Args
    ) -> "Surface":
        """That of constrained terms. Raises a `ValueError` if the constraint does not
        return an array of shape `(c,)`."""
        constraint = constraint_of(terms)
        assert constraint is not None
        drift, _, _ = split_friction(without_constraint(terms))
        _, q0 = y
        _, unravel = jfu.ravel_pytree(q0)

        def residual(q: _Vector) -> _Multipliers:
            return _values(constraint, unravel(q), args)

        def velocity(p: _Vector) -> _Vector:
            # For separable H0, at any position.
            _, dq = rate(drift, t, (unravel(p), q0), args)
            return jfu.ravel_pytree(dq)[0]

        return Surface(residual, velocity)

    def frame(self, q: _Vector) -> Frame:
        """The directions normal to the surface at this position."""
        normals = jax.jacrev(self.residual)(q)
        along = self._pushed(normals)
        return Frame(q, normals, along, _products(normals, along))

    def _pushed(self, impulses: Float[Array, "c n"]) -> Float[Array, "c n"]:
        """The change of the velocity by each of these changes of the momentum."""
        # The velocity is linear, so its derivative is the same at every momentum.
        still = jnp.zeros_like(impulses[0])

        def change(impulse: _Vector) -> _Vector:
            return jax.jvp(self.velocity, (still,), (impulse,))[1]

        return jax.vmap(change)(impulses)

    def tangent(
        self,
        p: _Vector,
        at: Frame,
        response: Callable[[_Vector], _Vector] | None = None,
    ) -> _Vector:
        """The momentum after the impulses of the constraint forces that make it tangent.
        An impulse changes the momentum by itself, or by its `response`."""
        if response is None:
            gram = at.gram
            changes = at.normals
        else:
            changes = jax.vmap(response)(at.normals)
            gram = _products(at.normals, self._pushed(changes))
        # How fast the momentum would leave the surface.
        speeds = _products(at.normals, self.velocity(p)[None])[:, 0]
        return p - _combined(solve_matrix(gram, speeds), changes)

    def fly(
        self,
        p: _Vector,
        at: Frame,
        time: RealScalarLike,
        pending: Bool[Array, ""] | bool = True,
    ) -> tuple[_Vector, _Vector, Bool[Array, ""]]:
        r"""Free flight on the surface over `time`, by a step of RATTLE,

        $$q_1 = q + h\, v(p_1), \qquad p_1 = p - J(q)^\top \lambda, \qquad g(q_1) = 0,$$

        and whether the multipliers were found. The momentum $p_1$ still has to be made
        tangent at $q_1$. The momentum $p$ need not be tangent: the multipliers make up for
        the difference. Nothing is solved for, nor found, if not `pending`.
        """
        time = jnp.asarray(time, p.dtype)
        free = at.q + time * self.velocity(p)
        rounding = _rounding(at, free)

        # The unknowns are `time * lambda`, so that `time` may be small.
        def moved(multipliers: _Multipliers) -> _Vector:
            return free - _combined(multipliers, at.along)

        def off(multipliers: _Multipliers) -> _Multipliers:
            return self.residual(moved(multipliers))

        def solve(off: Callable, start: _Multipliers) -> tuple[_Multipliers, Array]:
            x, found = _newton(off, at.gram, rounding, start, jnp.asarray(pending))
            # As a float: `custom_root` gives other types a tangent of a wrong type.
            return x, found.astype(x.dtype)

        # Derivatives come from the equations, and not through the loop that solves them.
        start = jnp.zeros(len(at.gram), p.dtype)
        x, found = lax.custom_root(off, start, solve, _tangent_solve, has_aux=True)
        return p - _combined(x / time, at.normals), moved(x), found > 0

    def dependent(self, at: Frame) -> Bool[Array, ""]:
        """Whether the normals are linearly dependent, up to rounding errors."""
        # In a solve backward in time velocities change their sign.
        gram = at.gram * jnp.sign(jnp.trace(at.gram))
        size = jnp.sqrt(jnp.diag(gram))
        # A pivot is the squared sine of the angle between a normal and the ones before it.
        pivots = jnp.diag(jnp.linalg.cholesky(gram / size / size[:, None])) ** 2
        rounding = 1000 * jnp.finfo(gram.dtype).eps
        return ~jnp.all(pivots > rounding)

    def off(self, p: _Vector, at: Frame) -> Bool[Array, ""]:
        """Whether a state is farther from the surface than rounding errors explain."""
        # Between rounding errors, also of long sums, and any mistake of the user's.
        eps = float(jnp.finfo(p.dtype).eps)
        near = eps ** (2 / 3)
        # A constraint rounds as its positions do, or, where these are near the origin, as
        # numbers of the size of its radius of curvature do: to show that radius, gradients
        # are differentiated along a direction that no symmetry singles out.
        along = jnp.cos(1.0 + jnp.arange(len(at.q), dtype=p.dtype))
        _, turned = jax.jvp(jax.jacrev(self.residual), (at.q,), (along,))
        bend = jnp.sum(jnp.abs(turned), axis=1)
        curved = jnp.sum(at.normals**2, axis=1) / jnp.where(bend > 0, bend, jnp.inf)
        size = jnp.maximum(_rounding(at, at.q) / eps, curved)
        position_is_on = jnp.all(jnp.abs(self.residual(at.q)) <= near * size)
        normal_part = p - self.tangent(p, at)
        momentum_is_tangent = max_norm(normal_part) <= near * max_norm(p)
        return ~(position_is_on & momentum_is_tangent)


def _rounding(at: Frame, q: _Vector) -> _Multipliers:
    """By how much one unit in the last place of each position changes the constraints."""
    info = jnp.finfo(q.dtype)
    ulps = float(info.eps) * jnp.abs(q)
    # Never zero, since it is a divisor.
    return _products(jnp.abs(at.normals), ulps[None])[:, 0] + float(info.tiny)


def _products(a: Float[Array, "c n"], b: Float[Array, "d n"]) -> Float[Array, "c d"]:
    """The scalar products of all pairs."""
    return _total(a.T[:, :, None] * b.T[:, None, :])


def _combined(x: _Multipliers, vectors: Float[Array, "c n"]) -> _Vector:
    """The sum of the vectors times these numbers."""
    return _total(x[:, None] * vectors)


# Sums over axes up to this length are unrolled, so that XLA fuses them. On CPUs it calls a
# library for each other sum or product of matrices: steps of rigid dimers took three times
# as long.
_SHORT = 32


def _total(x: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """The sum over the first axis."""
    return ft.reduce(operator.add, x) if len(x) <= _SHORT else jnp.sum(x, axis=0)


_DEPENDENT = (
    "The gradients of `constraint` at `y0` are linearly dependent, or zero. Leave out "
    "constraints that follow from the others, and write each so that its gradient does not "
    "vanish where it is zero, such as `jnp.sum(q**2) - 1`. For atoms on a line no distance "
    "follows from the others: fix one, and put each atom between its ends on the line, "
    "for a middle one by `q[1] - (q[0] + q[2]) / 2` in place of its distances."
)
_OFF = (
    "`y0` is off the `constraint`, or its momenta are not tangent to it. Pass "
    "`constrained_state(terms, y0, args)`. (Diffrax converts a float32 state to the dtype "
    "of the times. If they are float64, pass them as `jnp.float32(t)`, too, or `y0` in "
    "float64: a state on the constraint to single precision is off it in double.)"
)


def check_start(
    terms: PyTree[diffrax.AbstractTerm], t0: RealScalarLike, y0: PyTree, args: Args
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether the constraints are dependent at `y0`, and whether it is off them. Raises a
    `ValueError` if either is known while tracing, and for constraints that no solver takes.
    Otherwise it is an error when run, but not in a batch."""
    _check_masses(terms, t0, y0, args)
    # A check has no derivative. Taking one would trace it again.
    fixed = jtu.tree_map(_without_derivative, (y0, args))
    dependent, off = _faults(terms, t0, *fixed)
    return refused_where(dependent, _DEPENDENT), refused_where(off, _OFF)


def _without_derivative(x: Any) -> Any:
    return lax.stop_gradient(x) if eqx.is_inexact_array(x) else x


# Outside of a program its operations would be compiled one by one.
@eqx.filter_jit
def _faults(
    terms: PyTree[diffrax.AbstractTerm], t0: RealScalarLike, y0: PyTree, args: Args
) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Whether the constraints are dependent at `y0`, and, unless they are, whether it is
    off them."""
    surface = Surface.of(terms, t0, y0, args)
    (p, _), (q, _) = map(jfu.ravel_pytree, y0)
    at = surface.frame(q)
    dependent = surface.dependent(at)
    return dependent, ~dependent & surface.off(p, at)


def _check_masses(
    terms: PyTree[diffrax.AbstractTerm], t0: RealScalarLike, y0: PyTree, args: Args
) -> None:
    """Raises a `ValueError` unless velocities are linear in the momenta."""
    surface = Surface.of(terms, t0, y0, args)
    p0, _ = jfu.ravel_pytree(y0[0])

    # The change of the velocity by an impulse: the second derivative of H0 by p, times it.
    def pushed(p: _Vector, impulse: _Vector) -> _Vector:
        return jax.jvp(surface.velocity, (p,), (impulse,))[1]

    # It may depend on the impulse, but not on the momentum: then the masses are constant.
    # Only the shape of the second argument matters.
    if not Dependence(pushed, p0, p0).independent(lambda p, impulse: p):
        raise ValueError(
            "Terms with a `constraint` need constant masses, H0 = p . M^-1 p / 2 + "
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

    - `terms`: the terms, with a `constraint`.
    - `y0`: the state `(p, q)`.
    - `args`: as for `diffrax.diffeqsolve`.

    **Returns:** the pair `(p, q)`. Differentiable.

    **Raises:** a `ValueError` if the terms have no constraint, if no solver takes them, if
    the constraints are dependent at `y0`, or if Newton's method finds no allowed positions.
    If this is not known while tracing, the state is NaN, and a solve from there fails.
    """
    if constraint_of(terms) is None:
        raise ValueError(
            "`constrained_state` needs terms with a `constraint`, such as "
            "`hamiltonian_terms(H0, constraint=constraint)`."
        )
    check_pair(y0)
    check_state(y0, "constrained_state")
    t = jnp.zeros((), jnp.result_type(*jtu.tree_leaves(y0)))
    drift, _, _ = split_friction(without_constraint(terms))
    check_fit(diffrax.MultiTerm(*drift), t, y0, args)
    if fault := separable_fault(drift, (), t, y0, args):
        raise ValueError(
            "Terms with a `constraint` need H0 = p . M^-1 p / 2 + U(t, q), but "
            f"{fault.reason}. {fault.advice}"
        )
    _check_masses(terms, t, y0, args)
    y1, found, dependent = _projected(terms, t, y0, args)
    if not is_traced(found):
        if dependent:
            raise ValueError(_DEPENDENT)
        if not found:
            raise ValueError(
                "`constrained_state` found no positions with `constraint(q, args) = 0` "
                "from `y0`. Pass one that is closer to them."
            )
    okay = found & ~dependent
    return jtu.tree_map(lambda x: jnp.where(okay, x, jnp.nan), y1)


@eqx.filter_jit
def _projected(
    terms: PyTree[diffrax.AbstractTerm], t: RealScalarLike, y0: PyTree, args: Args
) -> tuple[PyTree, Bool[Array, ""], Bool[Array, ""]]:
    """The nearest allowed state, whether Newton's method found it, and whether the
    constraints are dependent there."""
    surface = Surface.of(terms, t, y0, args)
    (p, unravel_p), (q, unravel_q) = map(jfu.ravel_pytree, y0)
    # Without a momentum, all of the way is that of the multipliers.
    _, q, found = surface.fly(jnp.zeros_like(p), surface.frame(q), 1.0)
    at = surface.frame(q)
    # Twice, so that the rest of a momentum that was normal is tangent, too.
    p = surface.tangent(surface.tangent(p, at), at)
    y1 = (unravel_p(p), unravel_q(q))
    return y1, found, surface.dependent(at)


def _values(constraint: Constraint, q: PyTree, args: Args) -> Float[Array, " c"]:
    """The values of the constraints. Raises a `ValueError` unless they are a real array of
    shape `(c,)`."""
    value = evaluated("constraint", constraint, q, args=args)
    if not is_real_number(value) or jnp.ndim(value) != 1 or jnp.size(value) == 0:
        # With the dtype, such as `f32[2]`: that alone may be what is wrong.
        got = eqx.tree_pformat(value, struct_as_array=True)
        raise ValueError(
            "`constraint(q, args)` must return a real array of shape `(c,)`, one number "
            f"for each constraint; got {got}. For one constraint write "
            "`jnp.stack([...])`."
        )
    return jnp.asarray(value, jnp.result_type(*jtu.tree_leaves(q)))


class _Newton(NamedTuple):
    """The state of Newton's method.

    - `x`: the multipliers.
    - `residual`: the constraints before their last correction.
    - `correction`: the last correction.
    - `left`: how many corrections may follow; `_SOLVED` after the last one. (In place of a
        number and two flags: with an array for each, steps of 1,000 rigid dimers took 1.2
        times as long.)
    """

    x: _Multipliers
    residual: _Multipliers
    correction: _Multipliers
    left: Array


_SOLVED = -1


def _newton(
    off: Callable,
    gram: Float[Array, "c c"],
    rounding: _Multipliers,
    start: _Multipliers,
    pending: Bool[Array, ""],
) -> tuple[_Multipliers, Bool[Array, ""]]:
    """The root of `off`, from `start`, and whether it was found; otherwise zero.

    - `off`: the constraints as a function of the multipliers.
    - `gram`: about the size of its derivative.
    - `rounding`: the change of the constraints by rounding errors of the positions.
    - `pending`: if false, no step is taken and nothing is found, so that in a batch a path
        that failed before does not keep the others waiting.

    The method ends when the next correction would be below rounding errors, by the change
    of the derivative in the last one. Corrections themselves may never get as small as the
    rounding errors of the positions: near the origin `(q - 1)**2 - 1` is a difference of
    numbers larger than `q`. How large is not known, neither from the positions nor from the
    constraint, which is zero.
    """
    slopes = jnp.abs(gram)
    noise = _ROUNDING * float(jnp.finfo(start.dtype).eps)

    def going(state: _Newton) -> Bool[Array, ""]:
        return state.left > 0

    def step(state: _Newton) -> _Newton:
        newton = correction(off, state.x, None)
        # By how much this correction and the one before change each constraint, at most.
        change = _combined(jnp.abs(newton.change), slopes)
        before = _combined(jnp.abs(state.correction), slopes) + rounding
        # By how much the derivative along the one before has changed: the residual before
        # is the old derivative. In units of each constraint, so that none hides others.
        bend = jnp.abs(newton.derivative(state.correction) - state.residual)
        # The next correction is at most this fraction of this one. (Half of the bend is
        # what was left to this one, and the square of the ratio of both is left to the
        # next: Deuflhard, Newton Methods for Nonlinear Problems, 2004, section 2.1.)
        fraction = max_norm(change / before) * max_norm(bend / before)
        # The first correction has none before it.
        fraction = jnp.where(state.left < _MOST_STEPS, fraction, 1)
        # Strictly, since infinite corrections solve nothing.
        solved = jnp.all(change * fraction < rounding + noise * change)
        failed = jnp.any(jnp.isnan(change))
        left = jnp.where(failed, 0, state.left - 1)
        return _Newton(
            x=state.x - newton.change,
            residual=newton.residual,
            correction=newton.change,
            left=jnp.where(solved, _SOLVED, left),
        )

    first = _Newton(
        x=start,
        residual=jnp.zeros_like(start),
        correction=jnp.zeros_like(start),
        left=jnp.where(pending, _MOST_STEPS, 0),
    )
    first = batched_like(first, (off(start), gram, rounding, pending))
    last = lax.while_loop(going, step, first)
    found = last.left == _SOLVED
    return jnp.where(found, last.x, 0), found


def _tangent_solve(apply: Callable, rhs: _Multipliers) -> _Multipliers:
    """Solves the linear equations for the derivative of the multipliers."""
    matrix = jax.vmap(apply, out_axes=1)(jnp.eye(len(rhs), dtype=rhs.dtype))
    return solve_matrix(matrix, rhs)
