"""The record of facts about a solver."""

from typing import Literal, NamedTuple, TypeAlias


Want: TypeAlias = Literal["weak", "strong"]
Noises: TypeAlias = Literal["any", "commuting", "not commuting"]
# One order for all noises; or the orders for noises that commute and for others.
Order: TypeAlias = int | float | tuple[int | float, int | float]


class Record(NamedTuple):
    """Facts about a solver that do not follow from its coefficients. Orders, suggestions,
    the tables of the documentation and the tests of all solvers are made from its record.

    - `weak`: its weak order.
    - `strong`: its strong order, or `None` for a weak method.
    - `choose`: when to choose it, in a sentence.
    - `noises`: the noises for which it is recommended. It accepts any.
    - `stationary`: the second moments, of `"qq"`, `"pq"` and `"pp"`, of a harmonic mode in
        a heat bath whose stationary values are exact for every stable step.
    - `right_energy_unresolved`: whether noise gives a harmonic mode without friction the
        right energy for steps that do not resolve it; `None` if such steps are unstable.
    - `most_friction`: the greatest friction, as a rate times the step, for which the
        stationary energies of a resolved harmonic mode in a heat bath are right to within a
        tenth, among the values that `examples/stability/friction.py` tries; `None` if there
        is no limit. Given for the solvers that `suggest_solver` returns.
    - `most_frequency`: the largest frequency of the drift, as omega h, up to which two
        levels were measured to hold their error bars; `None` if nothing is promised.

    The last four fields are measured, in `tests/test_advice.py`, for the solvers that
    `suggest_solver` returns. Leave them out for other solvers: the documentation then
    promises nothing and warns of nothing. For `LevyAreaMidpoint` they cannot be computed,
    since its random variables have no finite set of outcomes. Its record repeats that of
    the midpoint rule, and a test compares the steps of both.
    """

    weak: Order
    strong: Order | None
    choose: str
    noises: Noises = "any"
    stationary: tuple[str, ...] = ()
    right_energy_unresolved: bool | None = None
    most_friction: float | None = None
    most_frequency: float | None = None

    @property
    def reason(self) -> str:
        """When to choose the solver, and its limits by `most_frequency`,
        `right_energy_unresolved` and `most_friction`, in sentences for users."""
        sentences = [self.choose]
        if self.most_frequency is not None:
            sentences.append(f"Not for long steps, omega h > {self.most_frequency:g}.")
        # If stationary momenta are exact, a heat bath corrects the energy.
        if self.right_energy_unresolved is False and "pp" in self.stationary:
            sentences.append("If noise drives stiff modes, only in a heat bath.")
        elif self.right_energy_unresolved is False:
            sentences.append("Not if noise drives stiff modes.")
        if self.most_friction is not None:
            limit = f"{self.most_friction:g}"
            sentences.append(f"In a heat bath, only up to gamma h = {limit}.")
        return " ".join(sentences)

    def order(self, want: Want, commute: bool) -> int | float | None:
        """The weak or strong order: for noises that commute, or for others."""
        order = self.weak if want == "weak" else self.strong
        if not isinstance(order, tuple):
            return order
        commuting, others = order
        return commuting if commute else others
