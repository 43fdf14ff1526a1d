"""Splittings for Langevin dynamics: a step that carries out one piece after another."""

import math
from collections.abc import Sequence
from typing import Any, ClassVar, NamedTuple, TYPE_CHECKING

import diffrax
import equinox as eqx
import optimistix as optx
from jax import lax
from jaxtyping import Array, PyTree

from .._arguments import check_state
from .._compat import unwrapped, ω
from .._custom_types import Args, Terms, Y
from .._tableau import Structure
from .._terms import (
    check_structure,
    constraint_of,
    momentum_first,
    rate,
    split_friction,
)
from .base import AbstractSymplecticSolver
from .bath import check_friction
from .constrained import end_on_surface, init_constrained
from .driven import drawn_variables
from .flow import Flow as AnyFlow, is_solver
from .pieces import (
    AbstractPiece,
    Bath,
    first_alike,
    Flight,
    Flow,
    Kick,
    kicks_and_rest,
    Moving,
    Setting,
    setting_of,
)
from .record import Record
from .step import Outcome, result_of
from .times import result_with_times_checked


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class SplittingState(NamedTuple):
    """The solver state: what a splitting hands on from step to step.

    - `forces`: the forces of the last kick if they serve for the first kick of the next
        step, else `None`.
    - `flows`: the state of each flow, by the number of its first piece, as in `Moving`.
    - `outcome`: with a constraint, whether its multipliers were found in all steps so far;
        otherwise `None`.
    """

    forces: PyTree[Array]
    flows: dict[int, PyTree[Array]]
    outcome: Outcome


class AbstractLangevinSplitting(AbstractSymplecticSolver):
    """A solver for Langevin dynamics that carries out one piece after another."""

    pieces: AbstractVar[tuple[AbstractPiece, ...]]

    def _first_alike(self) -> tuple[int, ...]:
        """For each piece the number of the first piece that is alike."""
        return first_alike(self.pieces)

    @property
    def variables(self) -> tuple[str, ...]:
        # Two baths need `H` for independent shares of the increment of a step.
        return ("W", "H") if len(self._baths) == 2 else ("W",)

    @property
    def symmetric(self) -> bool:
        """Whether the pieces are the same in reverse."""
        numbers = self._first_alike()
        return numbers == numbers[::-1]

    @property
    def has_flow(self) -> bool:
        """Whether there is a flow other than free flight."""
        return any(isinstance(piece, Flow) for piece in self.pieces)

    @property
    def kicks_at_ends(self) -> bool:
        """Whether a step kicks before positions first move, and after they last move. Then
        the forces of its last kick serve for the first kick of the next step, too."""
        moves = [i for i, piece in enumerate(self.pieces) if piece.moves_positions]
        kicks = [i for i, piece in enumerate(self.pieces) if isinstance(piece, Kick)]
        return kicks[0] < moves[0] and kicks[-1] > moves[-1]

    @property
    def _baths(self) -> list[Bath]:
        return [piece for piece in self.pieces if isinstance(piece, Bath)]

    @property
    def _flows(self) -> dict[int, Flow]:
        """The flows, each once, by the number of the first piece that is this flow."""
        first_pieces = {number: self.pieces[number] for number in self._first_alike()}
        return {
            i: piece for i, piece in first_pieces.items() if isinstance(piece, Flow)
        }

    @property
    def structure(self) -> Structure:
        for piece in self._flows.values():
            if is_solver(piece.flow):
                return piece.flow.structure  # pyright: ignore
        return "separable"

    @property
    def friction_without_inverse(self) -> float:
        """The smallest rate of friction times step size for which a step has no inverse.
        For `2 / s`, a bath with the share `s` multiplies momenta by zero: it is a step of
        the midpoint rule."""
        return 2 / max(bath.share for bath in self._baths)

    def stage_vectors(self, num_noises):
        flows = [piece for piece in self.pieces if isinstance(piece, Flow)]
        return tuple(size for flow in flows for size in flow.stage_vectors(num_noises))

    @property
    def undoes_its_steps(self) -> bool:
        solvers: list[Any] = [x.flow for x in self._flows.values() if is_solver(x.flow)]
        return self.symmetric and all(solver.undoes_its_steps for solver in solvers)

    def order(self, terms):
        return 2 if self.symmetric else 1

    def check(self, terms, t0, y0: Y, args: Args) -> None:
        solver_name = type(self).__name__
        check_state(solver_name, y0)
        terms, y0 = momentum_first(terms, y0)
        drift, friction, noise = split_friction(terms)
        kicks, rest = kicks_and_rest(self.has_flow, drift)
        # Only the kicks must be separable. A flow checks the terms that it follows, below.
        check_structure("separable", kicks, noise, t0, y0, args, solver_name)
        if not all(isinstance(unwrapped(term), diffrax.ODETerm) for term in drift):
            raise ValueError(
                f"`{solver_name}` needs a drift driven by time: pass `langevin_terms(H0, "
                "friction, temperature, path)`."
            )
        check_friction(drift, friction, t0, y0, args, solver_name)
        for piece in self._flows.values():
            piece.check_follows(rest, t0, y0, args)

    def init(self, terms, t0, t1, y0, args) -> Any:
        """Checks the arguments, and makes the `SplittingState` for the first step."""
        outcome = self._outcome_at_start(terms, t0, y0, args)
        terms, y0 = momentum_first(terms, y0)
        setting = setting_of(terms, t0, t1, y0, args, self.has_flow)
        forces = None
        if self.kicks_at_ends and setting.kicks:
            forces, _ = rate(setting.kicks, t0, y0, args)
        flows = {i: flow.begin(setting, y0) for i, flow in self._flows.items()}
        return SplittingState(forces, flows, outcome)

    def _outcome_at_start(self, terms, t0, y0: Y, args: Args) -> Outcome:
        """The `outcome` of a `SplittingState` before the first step. Raises a `ValueError`
        unless the state and the terms suit the solver."""
        if constraint_of(terms) is None or not self.keeps_constraints:
            # `check` refuses a constraint that the solver does not keep.
            self.check(terms, t0, y0, args)
            return None
        for piece in self._flows.values():
            if not getattr(piece.flow, "keeps_constraints", False):
                raise ValueError(
                    f"The flow {piece.flow!r} does not keep the constraint of the "
                    "terms. Use `BAOAB()` or `BAOAB(StormerVerlet())`."
                )
        return init_constrained(self, terms, t0, y0, args)

    def _increments(self, noise: Terms, t0, t1) -> list[list]:
        """For each bath the increments of all noise terms in its share of the step. Without
        noise the list is empty."""
        if len(noise) == 0:
            return []
        names = list(self.variables)
        variables = drawn_variables(noise, names, t0, t1, type(self).__name__)
        if names == ["W"]:
            return [variables["W"]]
        # W and H are independent, with the variances h and h / 12. Let s be the share of
        # the first bath, and w^2 = 12 s (1 - s). Then the increment s W + w H of the first
        # bath has the variance (s^2 + w^2 / 12) h = s h. The rest of W, (1 - s) W - w H, is
        # the increment of the second bath. It has the variance (1 - s) h, and the
        # covariance of both increments is (s (1 - s) - w^2 / 12) h = 0.
        share, _ = [bath.share for bath in self._baths]
        weight = math.sqrt(12 * share * (1 - share))
        W = variables["W"]
        first = (share * W**ω + weight * variables["H"] ** ω).ω
        return [first, (W**ω - first**ω).ω]

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        # Diffrax's own Langevin terms have the state (x, v). Within the step the momentum
        # comes first.
        ordered_terms, start = momentum_first(terms, y0)
        forces, flows, outcome = solver_state
        setting = setting_of(ordered_terms, t0, t1, start, args, self.has_flow)
        increments = self._increments(setting.noise, t0, t1)
        setting = setting._replace(increments=increments)
        if setting.surface is not None:
            setting = setting._replace(pending=outcome == optx.RESULTS.successful)
        # `forces` are known from the end of the last step. The state may have jumped since.
        if forces is not None and made_jump is not False:
            forces = _forces_after_jump(setting, forces, made_jump, t0, start)
        moving = Moving(start, forces, flows)
        for number, piece in zip(self._first_alike(), self.pieces):
            moving = piece.move(setting, moving, number)
        if setting.surface is None:
            end = moving.y
            result = result_of(None, end)
            R: Any = diffrax.RESULTS
            # A flow that failed gives the step its own result.
            for flow_result in moving.results.values():
                result = R.where(flow_result == R.successful, result, flow_result)
        else:
            end, outcome = end_on_surface(moving, setting.surface, outcome)
            result = result_of(outcome, end)
        result = result_with_times_checked(ordered_terms, t0, t1, result)
        # This exchanges the halves of Diffrax's own state once more.
        _, y1 = momentum_first(terms, end)
        forces = moving.forces if self.kicks_at_ends else None
        state = SplittingState(forces, moving.flows, outcome)
        return y1, None, dict(y0=y0, y1=y1), state, result


def _forces_after_jump(
    setting: Setting, last_forces: PyTree[Array], made_jump, t0, y0: Y
) -> PyTree[Array]:
    """The forces at the start `y0` of a step: `last_forces`, which are those at the end of
    the last step, unless the state jumped since then."""

    def compute_forces() -> PyTree[Array]:
        forces, _ = rate(setting.kicks, t0, y0, setting.args)
        return forces

    return lax.cond(made_jump, compute_forces, lambda: last_forces)


def check_has_no_bath(flow: AnyFlow) -> None:
    """Raises a `ValueError` for a flow with friction and noise of its own."""
    if issubclass(type(flow), AbstractLangevinSplitting):
        raise ValueError(
            f"`{type(flow).__name__}` has a bath of its own. Pass a solver for systems "
            "without noise as `flow`, such as `StormerVerlet()`."
        )


class Splitting(AbstractLangevinSplitting):
    r"""Langevin dynamics by a splitting of your own.

    !!! example

        OBABO, with friction and noise at both ends of a step:

        ```python
        from diffrax_symplectic import Bath, Flight, Kick, Splitting

        half_bath, half_kick = Bath(1 / 2), Kick(1 / 2)
        obabo = Splitting([half_bath, half_kick, Flight(1), half_kick, half_bath])
        ```

    A step carries out one piece after another. Each [`diffrax_symplectic.Kick`][],
    [`diffrax_symplectic.Flight`][] or [`diffrax_symplectic.Bath`][] takes its share of the
    step; in place of free flight there may be a [`diffrax_symplectic.Flow`][]. Takes the
    same terms and states as [`diffrax_symplectic.BAOAB`][], also with constraints.

    All else follows from the pieces. If they are the same in reverse, the weak order is 2,
    as is the order without noise; otherwise both are 1. The strong order is 1. A kick at
    the end of a step shares its forces with one at the start of the next step. Two baths
    get independent increments for their shares $s$ and $1 - s$ of the step:
    $s W + \sqrt{12 s (1 - s)}\, H$ and the rest of $W$, where $W$ is the increment and $H$
    the space-time Lévy area of the step. So with two baths the path needs $H$, as made by
    `solver.path(shape, key)`.

    Which stationary moments are exact depends on the order: in a harmonic well, the
    momenta of OBABO, and the positions of BAOAB and ABOBA.

    **Source:** [Leimkuhler and Matthews (2013)](https://doi.org/10.1093/amrx/abs010);
    OBABO is the scheme of [Bussi and Parrinello
    (2007)](https://doi.org/10.1103/PhysRevE.75.056707).

    **Arguments:**

    - `pieces`: the pieces, in the order in which they act. The shares of the kicks add up
        to one, as do the shares of the flights or flows, and of one or two baths.

    **Raises:** a `ValueError` for other pieces.
    """

    pieces: tuple[AbstractPiece, ...]
    # `first_alike(pieces)`, computed when the solver is made. Flows that are alike are the
    # same object, but no longer so in a compiled program, which makes its arguments anew.
    positions: tuple[int, ...] = eqx.field(static=True, repr=False)

    keeps_constraints: ClassVar[bool] = True

    def __init__(self, pieces: Sequence[AbstractPiece]):
        self.pieces = _checked_pieces(pieces)
        self.positions = first_alike(self.pieces)

    def _first_alike(self) -> tuple[int, ...]:
        return self.positions

    @property
    def record(self) -> Record:  # pyright: ignore
        return Record(
            weak=2 if self.symmetric else 1,
            strong=1,
            choose="A splitting of your own for heat baths.",
        )


def _checked_pieces(pieces: Any) -> tuple[AbstractPiece, ...]:
    """The pieces as a tuple. Raises a `ValueError` unless there are kicks, baths, and
    either flights or flows, the shares of each kind of piece add up to one, and there are
    at most two baths."""
    if not isinstance(pieces, list | tuple):
        raise ValueError(f"`pieces` must be a list of pieces; got {pieces!r}.")
    for piece in pieces:
        if not isinstance(piece, AbstractPiece):
            raise ValueError(
                "The pieces of a `Splitting` are such as `Kick(1 / 2)`, `Flight(1)`, "
                f"`Bath(1)` and `Flow(1, solver)`; got {piece!r}."
            )
        if isinstance(piece, Flow):
            check_has_no_bath(piece.flow)
    has_flow = any(isinstance(piece, Flow) for piece in pieces)
    if has_flow and any(isinstance(piece, Flight) for piece in pieces):
        raise ValueError(
            "A `Splitting` with a `Flow` has no `Flight`: the flow moves the positions."
        )
    # The first three kinds are needed: shares of a kind that is missing add up to zero.
    kinds = [Kick, Bath, Flow if has_flow else Flight, *map(type, pieces)]
    for kind in dict.fromkeys(kinds):
        total = sum(piece.share for piece in pieces if isinstance(piece, kind))
        if abs(total - 1) > 1e-12:
            raise ValueError(
                "The shares of each kind of piece add up to one; those of "
                f"`{kind.__name__}` add up to {total:.6g}."
            )
    num_baths = sum(isinstance(piece, Bath) for piece in pieces)
    if num_baths > 2:
        raise ValueError(
            "A `Splitting` has one or two baths, which share the noise of a step by `W` "
            f"and `H`; got {num_baths}."
        )
    return tuple(pieces)
