"""The pieces of a splitting: each moves momenta or positions, for a share of the step."""

import abc
import functools as ft
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .._arguments import whole_number
from .._custom_types import Args, RealScalarLike, Terms, Y
from .._terms import apply, NormalSpace, rate, Surface
from .base import real_number
from .bath import after_friction
from .flow import after_flow, check_flow, Flow as AnyFlow, is_solver, moved


if TYPE_CHECKING:
    from typing import ClassVar as AbstractClassVar, ClassVar as AbstractVar
else:
    from equinox import AbstractClassVar, AbstractVar


class Setting(NamedTuple):
    """What all pieces of a step have in common.

    - `kicks`: the terms whose forces are the kicks.
    - `rest`: the terms that free flight or flows follow.
    - `friction`, `noise`: the terms of the baths.
    - `increments`: of each bath in turn, those of all noises.
    - `args`: as for `diffrax.diffeqsolve`.
    - `lengths`, `times`: for shares `s` of the step, such as 0.5, the length `s h` of this
        share and the time `t0 + s h` after it. Pieces with equal shares get the same array,
        which is computed once.
    - `surface`: the surface of the constraint, if there is one.
    - `pending`: whether multipliers have to be found: not for a path that failed before.
    """

    kicks: Terms
    rest: Terms
    friction: Terms
    noise: Terms
    increments: list[list]
    args: Args
    lengths: dict[float, RealScalarLike]
    times: dict[float, RealScalarLike]
    surface: Surface | None = None
    pending: Bool[Array, ""] | None = None


class Moving(NamedTuple):
    """The state in the course of a step.

    - `y`: the momenta and positions.
    - `forces`: those of the kicks at `y`, if they are known.
    - `elapsed`: the share of the step for which positions have moved.
    - `num_baths`: how many baths have acted.
    - `normal_space`: with a constraint, the directions normal to it at `y`, if known.
    - `is_tangent`: with a constraint, whether the momenta are tangent to it.
    - `found`: with a constraint, whether all multipliers were found.
    """

    y: Y
    forces: PyTree[Array] | None
    elapsed: float = 0.0
    num_baths: int = 0
    normal_space: NormalSpace | None = None
    is_tangent: bool = True
    found: Any = True

    def after_move(self, y: Y, share: float, **changes: Any) -> "Moving":
        """The state after the positions have moved for this share of the step. Forces and
        normals, known at the old positions, are dropped."""
        return self._replace(
            y=y,
            forces=None,
            elapsed=_rounded(self.elapsed + share),
            normal_space=None,
            is_tangent=False,
            **changes,
        )

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
        p = surface.tangent(p, moving.normal_space)  # pyright: ignore
        return moving._replace(y=(unravel_p(p), self.y[1]), is_tangent=True)


# The state after a piece; the state of its flow; and the result of its flow.
_Moved = tuple[Moving, PyTree[Array], diffrax.RESULTS | None]


class AbstractPiece(eqx.Module):
    """A piece of a [`diffrax_symplectic.Splitting`][]: for `share` of the step it moves
    momenta, positions, or both."""

    share: AbstractVar[float]
    moves_positions: AbstractClassVar[bool]

    @abc.abstractmethod
    def move(
        self, setting: Setting, moving: Moving, flow_state: PyTree[Array]
    ) -> _Moved:
        """The state after this piece. `flow_state` is the state of its flow, if it has
        one."""


_share = ft.partial(real_number, "share")


class Kick(AbstractPiece):
    r"""Momenta move by the forces, $p \gets p + s h f(t, q)$, for the share $s$ of the
    step. Forces are those of the whole drift; in a splitting with a
    [`diffrax_symplectic.Flow`][] those of the `slow` potential alone.

    **Arguments:**

    - `share`: the share of the step, a number.
    """

    moves_positions: ClassVar[bool] = False
    share: float = eqx.field(static=True, converter=_share)

    def move(self, setting, moving, flow_state):
        if not setting.kicks:
            return moving, None, None
        p, q = moving.y
        forces = moving.forces
        if forces is None:
            time = setting.times[moving.elapsed]
            forces, _ = rate(setting.kicks, time, moving.y, setting.args)
        p = moved(p, setting.lengths[self.share], forces)
        # With a constraint the momenta need not be tangent before the next flight, whose
        # multipliers make up for it.
        return moving._replace(y=(p, q), forces=forces, is_tangent=False), None, None


class Flight(AbstractPiece):
    r"""Positions move by free flight, $q \gets q + s h\, \partial V / \partial p$, for the
    share $s$ of the step; under a constraint by a step of RATTLE, on its surface.

    **Arguments:**

    - `share`: the share of the step, a number.
    """

    moves_positions: ClassVar[bool] = True
    share: float = eqx.field(static=True, converter=_share)

    def move(self, setting, moving, flow_state):
        if setting.surface is not None:
            return self._on_surface(setting, moving, setting.surface), None, None
        p, q = moving.y
        # Velocities do not depend on time, so any time will do. The start of the step for
        # the first flight, and its end for the last one, are times at which the kicks of
        # `BAOAB` evaluate forces: XLA then computes once what depends on time alone. Of the
        # rates only the velocities are used; XLA drops the forces.
        time = setting.times[0.0]
        if moving.elapsed > 0:
            time = setting.times[_rounded(moving.elapsed + self.share)]
        _, velocities = rate(setting.rest, time, moving.y, setting.args)
        q = moved(q, setting.lengths[self.share], velocities)
        return moving.after_move((p, q), self.share), None, None

    def _on_surface(self, setting: Setting, moving: Moving, surface: Surface) -> Moving:
        normal_space = moving.with_normal_space(surface).normal_space
        (p, unravel_p), (q, unravel_q) = map(jfu.ravel_pytree, moving.y)
        length = jnp.asarray(setting.lengths[self.share], p.dtype)
        p, q, found = surface.free_flight(
            p,
            normal_space,  # pyright: ignore
            length,
            setting.pending,  # pyright: ignore
        )
        y = (unravel_p(p), unravel_q(q))
        return moving.after_move(y, self.share, found=moving.found & found)


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
    share: float = eqx.field(static=True, converter=_share)
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

    def move(self, setting, moving, flow_state):
        y, flow_state, result = after_flow(
            self.flow,
            self.steps,
            setting.rest,
            setting.times[moving.elapsed],
            setting.times[_rounded(moving.elapsed + self.share)],
            setting.lengths[self.share],
            moving.y,
            setting.args,
            flow_state,
        )
        # With a constraint the step fails unless all is `found`, and otherwise by `result`.
        found = moving.found
        if setting.surface is not None:
            found = found & (result == diffrax.RESULTS.successful)
        return moving.after_move(y, self.share, found=found), flow_state, result


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

    moves_positions: ClassVar[bool] = False
    share: float = eqx.field(static=True, converter=_share)

    def __check_init__(self):
        if self.share <= 0:
            raise ValueError(
                f"A `Bath` takes a positive share of the step; got {self.share:g}."
            )

    def move(self, setting, moving, flow_state):
        if setting.surface is not None:
            moving = moving.made_tangent(setting.surface)
        y = moving.y
        p, q = y
        time = setting.times[moving.elapsed]
        noise_impulse = None
        if len(setting.noise) > 0:
            increments = setting.increments[moving.num_baths]
            noise_impulse, _ = apply(setting.noise, increments, setting.args, time, y)

        def after_bath(impulse: PyTree[Array] | None) -> PyTree[Array]:
            """The momenta after friction, and an impulse spread over the length of it."""
            length = setting.lengths[self.share]
            return after_friction(
                setting.friction, time, length, y, setting.args, impulse
            )

        if setting.surface is None:
            p = after_bath(noise_impulse)
        else:
            moving = moving.with_normal_space(setting.surface)
            if noise_impulse is None:
                noise_impulse = jtu.tree_map(jnp.zeros_like, p)
            p = _tangent_after_bath(
                setting.surface,
                moving.normal_space,  # pyright: ignore
                after_bath,
                noise_impulse,
            )
        moving = moving._replace(y=(p, q), num_baths=moving.num_baths + 1)
        return moving, None, None


def _tangent_after_bath(
    surface: Surface,
    normal_space: NormalSpace,
    after_bath: Callable[[PyTree[Array]], PyTree[Array]],
    noise_impulse: PyTree[Array],
) -> PyTree[Array]:
    """The momenta after friction, noise and those constraint forces that make them tangent
    to the surface. `after_bath(impulse)` are the momenta after friction and an impulse, of
    noise or constraint forces. It is linear in the impulse, up to a constant."""
    flat_noise_impulse, unravel = jfu.ravel_pytree(noise_impulse)

    def flat_after_bath(impulse: Array) -> Array:
        return jfu.ravel_pytree(after_bath(unravel(impulse)))[0]

    # The impulses of the constraint forces enter as that of the noise does, so that
    # friction acts on them, too: then friction and noise are the midpoint rule within the
    # tangent space, which keeps its Maxwell distribution.
    def response(normal: Array) -> Array:
        """The change of the momenta by a unit impulse along this normal."""
        _, change_of_p = jax.jvp(flat_after_bath, (flat_noise_impulse,), (normal,))
        return change_of_p

    p = flat_after_bath(flat_noise_impulse)
    return unravel(surface.tangent(p, normal_space, response))


def _rounded(elapsed: float) -> float:
    """A sum of shares without its rounding errors, so that equal sums, such as 0.1 + 0.2
    and 0.3, are one key of `Setting.lengths` and `Setting.times`."""
    return round(elapsed, 12)


def lengths_and_times(
    pieces: tuple[AbstractPiece, ...], t0: RealScalarLike, t1: RealScalarLike
) -> tuple[dict[float, RealScalarLike], dict[float, RealScalarLike]]:
    """The `lengths` and `times` of a `Setting`, for a step from `t0` to `t1` of size `h`.

    `lengths[s]` is `s h`, for the share of each piece and for each sum of shares;
    `times[s]` is `t0 + s h` for each of these sums, and exactly `t1` at the end."""
    h = t1 - t0
    lengths: dict[float, Any] = {1.0: h}
    times: dict[float, Any] = {0.0: t0, 1.0: t1}
    elapsed = 0.0
    for piece in pieces:
        if piece.share not in lengths:
            lengths[piece.share] = piece.share * h
        if piece.moves_positions:
            elapsed = _rounded(elapsed + piece.share)
        if elapsed in times:
            continue
        if elapsed not in lengths:
            lengths[elapsed] = elapsed * h
        times[elapsed] = t0 + lengths[elapsed]
    return lengths, times


def first_alike(pieces: tuple[AbstractPiece, ...]) -> tuple[int, ...]:
    """For each piece the number of the first piece that is alike, which is its own number
    if none before it is. Flows that are alike share one state, kept under this number."""
    first_numbers = []
    for piece in pieces:
        alike = [_are_alike(piece, other) for other in pieces]
        first_numbers.append(alike.index(True))
    return tuple(first_numbers)


def _are_alike(one: AbstractPiece, other: AbstractPiece) -> bool:
    if type(one) is not type(other) or one.share != other.share:
        return False
    if isinstance(one, Flow) and isinstance(other, Flow):
        return one.flow is other.flow and one.steps == other.steps
    return True


def are_kicks_at_both_ends(pieces: tuple[AbstractPiece, ...]) -> bool:
    """Whether there is a kick before positions move, and one after they last did. Then the
    forces of the last kick serve for the first kick of the next step, too."""
    moves = [i for i, piece in enumerate(pieces) if piece.moves_positions]
    kicks = [i for i, piece in enumerate(pieces) if isinstance(piece, Kick)]
    return kicks[0] < moves[0] and kicks[-1] > moves[-1]
