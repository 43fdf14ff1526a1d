"""The pieces of a splitting: each moves momenta or positions, for a share of the step.

A step passes a `Moving`, which holds the state, from piece to piece. What stays the same
for all pieces of the step is in a `Setting`. The `share` of a piece is the fraction of the
step over which it moves.
"""

import abc
import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from .._arguments import whole_number
from .._compat import direction, unwrapped, wrapped_like, ω
from .._custom_types import Args, RealScalarLike, Terms, Y
from .._terms import (
    apply,
    constraint_of,
    NormalSpace,
    rate,
    slow_apart,
    split_friction,
    Surface,
    with_constraint,
    without_constraint,
)
from .base import real_number
from .bath import after_friction
from .flow import (
    check_flow,
    check_returns_pair,
    Flow as AnyFlow,
    is_solver,
    returns_nan,
)
from .step import result_of


class Setting(NamedTuple):
    """What all pieces of a step have in common.

    - `kicks`: the terms whose forces move the momenta in kicks.
    - `rest`: the terms that free flight or flows follow.
    - `friction`, `noise`: the terms that act in baths. Without friction there is one kick
        and no bath, and the noise acts in the kick.
    - `args`: as for `diffrax.diffeqsolve`.
    - `length`, `time`: functions of a share `s` of the step, such as 0.5: the length `s h`
        of this share, and the time `t0 + s h` after it.
    - `surface`: the surface of the constraint, if there is one.
    - `increments`: for each bath in turn, or for the kick, a list of the increments of all
        noise terms.
    - `pending`: with a constraint, whether to find multipliers: not for a path that failed
        before.
    """

    kicks: Terms
    rest: Terms
    friction: Terms
    noise: Terms
    args: Args
    length: Callable[[float], RealScalarLike]
    time: Callable[[float], RealScalarLike]
    surface: Surface | None
    increments: list[list] = []
    pending: Bool[Array, ""] | bool = True


def kicks_and_rest(has_flow: bool, drift: Terms) -> tuple[Terms, Terms]:
    """The terms whose forces are the kicks of a splitting, and the terms that its flow, or
    its free flight, follows."""
    # Without a flow, kicks take the forces of the drift, and free flight its velocities.
    if not has_flow:
        return drift, drift
    rest, slow = slow_apart(drift)
    return slow, rest


def setting_of(
    terms: PyTree[diffrax.AbstractTerm],
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args,
    has_flow: bool,
) -> Setting:
    """The setting of the step from `t0` to `t1` and from `y0 = (p, q)`: the terms sorted by
    the pieces that follow them, the times, and the surface of the constraint. `increments`
    and `pending` keep their defaults."""
    drift, friction, noise = split_friction(without_constraint(terms))
    kicks, rest = kicks_and_rest(has_flow, drift)
    h = t1 - t0

    # `share` is a share of the step. Equal shares get the same array, computed once.
    @ft.cache
    def length(share: float) -> RealScalarLike:
        return h if share == 1 else share * h

    @ft.cache
    def time(share: float) -> RealScalarLike:
        if share == 0:
            return t0
        # With rounding errors `t0 + h` may differ from `t1`.
        return t1 if share == 1 else t0 + length(share)

    surface = None
    constraint = constraint_of(terms)
    if constraint is not None:
        surface = Surface.of(terms, t0, y0, args)
        # A flow that is a solver gets only the terms in `rest`, and finds the constraint if
        # any one of them carries it. There is always a first one.
        first, *others = rest
        first = wrapped_like(first, with_constraint(unwrapped(first), constraint))
        rest = (first, *others)
    return Setting(
        kicks=kicks,
        rest=rest,
        friction=friction,
        noise=noise,
        args=args,
        length=length,
        time=time,
        surface=surface,
    )


class Moving(NamedTuple):
    """The state in the course of a step.

    - `y`: the momenta and positions.
    - `forces`: the forces of the kicks at `y`, if they are known.
    - `flows`: the state of each flow. Flows that are alike share one state: its key is the
        number of the first piece with this flow. For a solver it is the solver state, for a
        function whether it returned NaN at the start of the solve.
    - `results`: the last result of each flow that has moved, by the same keys. Earlier
        results are not needed: after a failure all results of the flow are failures.
    - `elapsed`: the share of the step for which positions have moved.
    - `num_baths`: how many baths have acted.
    - `normal_space`: with a constraint, the directions normal to it at `y`, if known.
    - `is_tangent`: with a constraint, whether the momenta are tangent to it.
    - `found`: with a constraint, whether all multipliers were found.
    """

    y: Y
    forces: PyTree[Array] | None
    flows: dict[int, PyTree[Array]]
    results: dict[int, diffrax.RESULTS] = {}
    elapsed: float = 0.0
    num_baths: int = 0
    normal_space: Any = None
    is_tangent: bool = True
    found: Any = True

    def after_move(self, y: Y, share: float, **changes: Any) -> "Moving":
        """The state after positions have moved to those of `y`, for this share of the step.
        Forces and normals are dropped, since they belong to the old positions."""
        return self._replace(
            y=y,
            forces=None,
            elapsed=self.elapsed_after(share),
            normal_space=None,
            is_tangent=False,
            **changes,
        )

    def elapsed_after(self, share: float) -> float:
        """`elapsed` after a further share. Rounding errors of the sum are removed, so that
        0.1 + 0.2 and 0.3 of a step are the same time, which is computed only once."""
        return round(self.elapsed + share, 12)

    def with_normal_space(self, surface: Surface) -> "Moving":
        """The same state, with its normal space."""
        if self.normal_space is not None:
            return self
        q, _ = jfu.ravel_pytree(self.y[1])
        return self._replace(normal_space=surface.normal_space(q))

    def made_tangent(self, surface: Surface) -> "Moving":
        """The same state, with momenta tangent to the surface."""
        if self.is_tangent:
            return self
        moving = self.with_normal_space(surface)
        p, unravel_p = jfu.ravel_pytree(self.y[0])
        p = surface.tangent(p, moving.normal_space)
        return moving._replace(y=(unravel_p(p), self.y[1]), is_tangent=True)


class AbstractPiece(eqx.Module):
    """A piece of a [`diffrax_symplectic.Splitting`][]: for `share` of the step it moves
    momenta, positions, or both."""

    moves_positions: ClassVar[bool] = False
    share: float = eqx.field(static=True, converter=ft.partial(real_number, "share"))

    @abc.abstractmethod
    def move(self, setting: Setting, moving: Moving, number: int) -> Moving:
        """The state after this piece. `number` is the number of the first piece of the
        splitting that is like this one: the key of the state of a flow in `moving.flows`.

        Lengths in `setting` are positive in a solve backward in time, too. `rate` and
        `apply` take the direction of time from the terms; any other motion multiplies its
        length by `direction(setting.rest)`."""


class Kick(AbstractPiece):
    r"""Momenta move by the forces, $p \gets p + s h f(t, q)$, for the share $s$ of the
    step. Forces are those of the whole drift; in a splitting with a
    [`diffrax_symplectic.Flow`][] those of the `slow` potential alone.

    **Arguments:**

    - `share`: the share of the step, a number.
    """

    def move(self, setting, moving, number):
        if not setting.kicks:
            return moving
        p, q = moving.y
        time = setting.time(moving.elapsed)
        forces = moving.forces
        if forces is None:
            forces, _ = rate(setting.kicks, time, moving.y, setting.args)
        p = _moved(p, setting.length(self.share), forces)
        if setting.noise and not setting.friction:
            (increments,) = setting.increments
            impulse, _ = apply(setting.noise, increments, setting.args, time, moving.y)
            p = (p**ω + impulse**ω).ω
        # With a constraint the momenta need not be tangent before the next flight, whose
        # multipliers make up for it.
        return moving._replace(y=(p, q), forces=forces, is_tangent=False)


def _moved(x: PyTree, length: RealScalarLike, slope: PyTree) -> PyTree:
    """`x + length * slope`. Times may have a higher precision than `x`, and the result has
    that of `x`."""

    def moved_leaf(x: Array, slope: Array) -> Array:
        return x + jnp.asarray(length, jnp.result_type(x)) * slope

    return jtu.tree_map(moved_leaf, x, slope)


class Flight(AbstractPiece):
    r"""Positions move by free flight, $q \gets q + s h\, \partial V / \partial p$, for the
    share $s$ of the step; under a constraint by a step of RATTLE, on its surface.

    **Arguments:**

    - `share`: the share of the step, a number.
    """

    moves_positions: ClassVar[bool] = True

    def move(self, setting, moving, number):
        length = setting.length(self.share)
        surface = setting.surface
        if surface is not None:
            moving = moving.with_normal_space(surface)
            (p, unravel_p), (q, unravel_q) = map(jfu.ravel_pytree, moving.y)
            p, q, found = surface.free_flight(
                p, moving.normal_space, length, setting.pending
            )
            y = (unravel_p(p), unravel_q(q))
            return moving.after_move(y, self.share, found=moving.found & found)
        p, q = moving.y
        # Velocities do not depend on time, so any time will do. The kicks of `BAOAB`
        # evaluate forces at the start and at the end of the step. With the same times for
        # the first and the last flight, XLA computes once what depends on time alone.
        is_first = moving.elapsed == 0
        time = setting.time(0.0 if is_first else moving.elapsed_after(self.share))
        # The forces are not used, so XLA drops their computation.
        _, velocities = rate(setting.rest, time, moving.y, setting.args)
        return moving.after_move((p, _moved(q, length, velocities)), self.share)


class Flow(AbstractPiece):
    """The state moves by a flow for a share of the step: by a solver of this package, a
    [`diffrax_symplectic.linear_flow`][] or a function `flow(time, y, args)`, as for
    [`diffrax_symplectic.BAOAB`][].

    **Arguments:**

    - `share`: the share of the step.
    - `flow`: the solver, linear flow, or function.
    - `steps`: how many steps a solver takes for this share.

    **Raises:** a `ValueError` for any other flow.
    """

    moves_positions: ClassVar[bool] = True
    flow: AnyFlow
    steps: int = eqx.field(
        default=1, static=True, converter=ft.partial(whole_number, "steps")
    )

    def __check_init__(self):
        check_flow(self.flow, self.steps, type(self).__name__)

    def stage_vectors(self, num_noises: int) -> tuple[int, ...]:
        if not is_solver(self.flow):
            return ()
        return self.steps * self.flow.stage_vectors(num_noises)  # pyright: ignore

    def check_follows(self, drift: Terms, t0, y0: Y, args: Args) -> None:
        """Raises a `ValueError` if the flow does not take this drift or state."""
        if is_solver(self.flow):
            terms = diffrax.MultiTerm(*drift)
            self.flow.check(terms, t0, y0, args)  # pyright: ignore
        else:
            check_returns_pair(self.flow, t0, y0, args)  # pyright: ignore

    def begin(self, setting: Setting, y0: Y) -> PyTree[Array]:
        """The state of the flow at the start `y0` of a solve, from the setting of its first
        step: of a solver its state, of a function whether it returns NaN for `y0`."""
        if is_solver(self.flow):
            terms = diffrax.MultiTerm(*setting.rest)
            t0 = setting.time(0.0)
            t1 = setting.time(1.0)
            return self.flow.init(terms, t0, t1, y0, setting.args)  # pyright: ignore
        # Steps are positive even in a solve backward in time, where the flow runs back.
        time = direction(setting.rest) * setting.length(self.share)
        return returns_nan(self.flow, time, y0, setting.args)  # pyright: ignore

    def move(self, setting, moving, number):
        state = moving.flows[number]
        if is_solver(self.flow):
            y, state, result = self._after_steps(setting, moving, state)
        else:
            time = direction(setting.rest) * setting.length(self.share)
            y = self.flow(time, moving.y, setting.args)  # pyright: ignore
            R: Any = diffrax.RESULTS
            returned_nan_at_start = state
            result = R.where(returned_nan_at_start, R.nonfinite, result_of(None, y))
        return moving.after_move(
            y,
            self.share,
            flows=moving.flows | {number: state},
            results=moving.results | {number: result},
        )

    def _after_steps(
        self, setting: Setting, moving: Moving, state: PyTree[Array]
    ) -> tuple[Y, PyTree[Array], diffrax.RESULTS]:
        """`y`, the solver state and the result after the `steps` of a flow that is a
        solver. They divide its share of the step into equal parts. `state` is the solver
        state before the first of them."""
        solver: Any = self.flow
        terms = diffrax.MultiTerm(*setting.rest)
        t0 = setting.time(moving.elapsed)
        t1 = setting.time(moving.elapsed_after(self.share))
        h = (t1 - t0) / self.steps

        def step(carry: tuple[Any, ...], index: Any) -> tuple[tuple[Any, ...], None]:
            y, state, _ = carry
            start = t0 + index * h
            # A solver may reuse what it computed at the end of its last step. Since then
            # other pieces, such as a bath, have changed the state.
            made_jump = True
            y, _, _, state, result = solver.step(
                terms, start, start + h, y, setting.args, state, made_jump
            )
            return (y, state, result), None

        carry = moving.y, state, diffrax.RESULTS.successful
        if self.steps == 1:
            carry, _ = step(carry, 0)
        else:
            # The last result suffices: after a failure all further steps fail, since the
            # solver state records it, or since `y` is not finite.
            carry, _ = lax.scan(step, carry, jnp.arange(self.steps))
        return carry


class Bath(AbstractPiece):
    r"""Friction and noise move the momenta for the share $s$ of the step, by the implicit
    midpoint rule, one linear equation: with the friction $G$, the velocities $g =
    \partial V / \partial p$ and the noise $B W_s$ of this share,

    $$\bar p = p - s h\, G g(\tfrac12 (p + \bar p)) + B W_s, \qquad p \gets \bar p$$

    It keeps the Maxwell distribution exactly, for every friction and all masses.

    **Arguments:**

    - `share`: the share of the step, a positive number.

    **Raises:** a `ValueError` for any other share.
    """

    def __check_init__(self):
        if self.share <= 0:
            raise ValueError(
                f"A `Bath` takes a positive share of the step; got {self.share:g}."
            )

    def move(self, setting, moving, number):
        surface = setting.surface
        if surface is not None:
            moving = moving.made_tangent(surface).with_normal_space(surface)
        y = moving.y
        p, q = y
        time = setting.time(moving.elapsed)
        length = setting.length(self.share)
        if setting.noise:
            increments = setting.increments[moving.num_baths]
            noise_impulse, _ = apply(setting.noise, increments, setting.args, time, y)
        else:
            noise_impulse = jtu.tree_map(jnp.zeros_like, p)
        # A function of an impulse: the momenta after friction and this impulse.
        after_impulse = ft.partial(
            after_friction, setting.friction, time, length, y, setting.args
        )
        if surface is None:
            p = after_impulse(noise_impulse)
        else:
            p = _tangent_after_friction(
                after_impulse, noise_impulse, surface, moving.normal_space
            )
        return moving._replace(y=(p, q), num_baths=moving.num_baths + 1)


def _tangent_after_friction(
    after_impulse: Callable[[PyTree[Array]], PyTree[Array]],
    noise_impulse: PyTree[Array],
    surface: Surface,
    normal_space: NormalSpace,
) -> PyTree[Array]:
    """The momenta after friction and noise, made tangent to the surface of a constraint by
    impulses of the constraint forces, along its normals.

    `after_impulse(x)` are the momenta after friction and the impulse `x`: a function that
    is linear in `x`, up to a constant. Friction acts on the impulses of the constraint
    forces as on the impulse of the noise. Then friction and noise are the midpoint rule
    within the tangent space, which keeps its Maxwell distribution.
    """
    flat_noise_impulse, unravel = jfu.ravel_pytree(noise_impulse)

    def flat_after_impulse(impulse: Array) -> Array:
        return jfu.ravel_pytree(after_impulse(unravel(impulse)))[0]

    def response(impulse: Array) -> Array:
        """The change of the momenta, with friction, by an impulse along a normal."""
        _, change_of_p = jax.jvp(flat_after_impulse, (flat_noise_impulse,), (impulse,))
        return change_of_p

    flat_p = flat_after_impulse(flat_noise_impulse)
    return unravel(surface.tangent(flat_p, normal_space, response))


def first_alike(pieces: tuple[AbstractPiece, ...]) -> tuple[int, ...]:
    """For each piece the number of the first piece that is alike, which is its own number
    if none before it is alike. Flows that are alike share one state, kept by this number.

    Pieces are alike if they have the same class, and their static fields are equal and all
    other fields the same object."""

    def identity(piece: AbstractPiece) -> list[Any]:
        """A list that is equal for pieces that are alike."""
        values: list[Any] = [type(piece)]
        for field in dataclasses.fields(piece):
            value = getattr(piece, field.name)
            is_static = field.metadata.get("static", False)
            values.append(value if is_static else id(value))
        return values

    identities = [identity(piece) for piece in pieces]
    return tuple(identities.index(x) for x in identities)
