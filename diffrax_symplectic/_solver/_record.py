"""What is known of a solver: one record on its class, from which its orders, suggestions,
the tables of the documentation and the tests of all solvers are made."""

from typing import Literal, NamedTuple, TypeAlias


Want: TypeAlias = Literal["expectations", "paths"]
Noises: TypeAlias = Literal["any", "commuting", "not commuting"]
# One order for all noises; or first that for one noise and for noises that commute, then
# that for all others.
Order: TypeAlias = int | float | tuple[int | float, int | float]


class Record(NamedTuple):
    """The facts about a solver that do not follow from its coefficients.

    - `weak`: the order of its expectations.
    - `strong`: the order of its paths, or `None` for a method for expectations alone.
    - `choose`: when to choose it, in a sentence.
    - `noises`: the noises for which it is chosen. It takes any.
    - `suggested`: what `suggest_solver` names it for.
    """

    weak: Order
    strong: Order | None
    choose: str
    noises: Noises = "any"
    suggested: tuple[Want, ...] = ()

    def weak_order(self, commute: bool) -> int:
        return int(_order(self.weak, commute))

    def strong_order(self, commute: bool) -> float | None:
        return None if self.strong is None else float(_order(self.strong, commute))

    def order(self, want: Want, commute: bool) -> int | float | None:
        of = {"expectations": self.weak_order, "paths": self.strong_order}
        return of[want](commute)

    def at_most(self, weak: int, strong: int) -> "Record":
        """That of a splitting of these orders around the solver."""
        return self._replace(
            weak=_at_most(self.weak, weak), strong=_at_most(self.strong, strong)
        )


def _at_most(order: Order | None, most: int) -> Order | None:
    if isinstance(order, tuple):
        first, then = (min(x, most) for x in order)
        return first if first == then else (first, then)
    return None if order is None else min(order, most)


def _order(order: Order, commute: bool) -> int | float:
    return order[0 if commute else 1] if isinstance(order, tuple) else order


def depends_on_noises(order: Order | None) -> bool:
    """Whether an order is another one for noises that do not commute."""
    return isinstance(order, tuple)
