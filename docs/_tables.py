"""The tables of solvers on the site, made from the solvers' records."""

import dataclasses
import re

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import path_of
from diffrax_symplectic._solver import AbstractSplitting, AbstractSymplecticSolver, Want
from diffrax_symplectic._suggest import ranked, SOLVERS


_MARKER = re.compile(r"<!-- solvers: (.*?) -->")
# The family of a solver, which has a page, is the module that it stands in.
_FAMILIES = ("general", "separable", "additive", "beyond")
_STRUCTURES = {
    "any": "any Stratonovich system",
    "separable": "separable",
    "additive": "additive noise",
    "constant": "additive, constant noise",
    "separable and constant": "separable, constant noise",
}
_NOISES = {
    "any": "any number",
    "commuting": "one, or those that commute",
    "not commuting": "those that do not commute",
}
# Examples of those that have no defaults. A splitting is shown as one around any solver.
_SPLIT = (
    ds.BAOAB(1.0),
    ds.LangevinMiddle(1.0),
    ds.Damped(ds.NinomiyaVictoir(), 1.0),
    ds.LinearFlow(ds.NinomiyaVictoir(), lambda time, y, args: y),
)


def with_tables(markdown: str) -> str:
    """The page with a table in place of each `<!-- solvers: ... -->`."""
    return _MARKER.sub(lambda found: table(found[1]), markdown)


def table(name: str) -> str:
    """The table of all solvers, of a family, or of what is suggested for `weak` or
    `strong` approximation; or the names of those for any system."""
    solvers = [*(solver() for solver in SOLVERS), *_SPLIT]
    if name in ("weak", "strong"):
        return _suggested(name)
    if name == "names any":
        names = [f"`{s.__name__}`" for s in SOLVERS if s().structure == "any"]
        return f"{', '.join(names[:-1])} and {names[-1]}"
    if name in _FAMILIES:
        solvers = [s for s in solvers if type(s).__module__.endswith(f".{name}")]
    elif name != "all":
        raise ValueError(f"There is no table `{name}` of solvers.")
    left_out: tuple[str, ...] = ()
    if name in _FAMILIES:
        left_out = ("when to choose it",)
    if name in ("general", "beyond"):
        left_out += ("structure",)
    rows = [_facts(s) for s in solvers]
    columns = [column for column in rows[0] if column not in left_out]
    return _rows(columns, [[row[column] for column in columns] for row in rows])


def _facts(solver: AbstractSymplecticSolver) -> dict[str, str]:
    record = solver.record
    assert record is not None
    facts = {
        "solver": _code(solver),
        "structure": _STRUCTURES[solver.structure],
        "chosen for noises": _NOISES[record.noises],
        "strong order": _order(record.strong),
        "weak order": _order(record.weak),
        "order without noise": str(solver.order(None)),
        "stage vectors solved": _stage_vectors(solver),
        "when to choose it": record.choose,
    }
    if isinstance(solver, AbstractSplitting):
        own = ("solver", "strong order", "weak order", "order without noise")
        facts |= {column: "as `solver`" for column in facts if column not in own}
        facts |= {
            "strong order": f"at most {solver.strong}",
            "weak order": f"at most {solver.weak}",
            "order without noise": "at most 2",
            "when to choose it": solver.choose,
        }
    return facts


def _suggested(want: Want) -> str:
    """All that `suggest_solver` names for some system with few noises, best first."""
    structures = tuple(_STRUCTURES)
    of = lambda commute: ranked(want, structures, commute, 2)
    found = {type(s): s for commute in (True, False) for s in of(commute)}
    order = {"weak": "weak order", "strong": "strong order"}[want]
    columns = ("structure", "chosen for noises", order, "when to choose it")
    rows = []
    for solver in found.values():
        facts = _facts(solver)
        path = f"`{_path(solver, want)}`"
        name = f"`{type(solver).__name__}`"
        rows.append([name, *(facts[column] for column in columns), path])
    return _rows(["solver", *columns, "its `path(shape, key)`"], rows)


def _path(solver: AbstractSymplecticSolver, want: Want) -> str:
    bounded = len(solver.stage_vectors(1)) > 0
    return path_of(solver.variables, gaussian=want == "strong", bounded=bounded).code


def _rows(columns, rows: list[list[str]]) -> str:
    lines = [list(columns), ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |".replace("|  |", "| |") for line in lines)


def _code(solver: AbstractSymplecticSolver) -> str:
    """How the solver is constructed, with the parameters of the method."""
    stages = ("root_finder", "root_find_max_steps")
    own = [f for f in dataclasses.fields(solver) if f.init and f.name not in stages]
    given = ", ".join(
        f.name if f.default is dataclasses.MISSING else f"{f.name}={_plain(f.default)}"
        for f in own
    )
    return f"`{type(solver).__name__}({given})`"


def _plain(value) -> str:
    return f"{value:g}" if type(value) is float else repr(value)


def _order(order) -> str:
    if order is None:
        return ""
    if isinstance(order, tuple):
        commuting, others = map(_fraction, order)
        return f"{commuting}; {others} if noises do not commute"
    return _fraction(order)


def _fraction(x: float) -> str:
    return f"{x:g}" if x == int(x) else f"{int(2 * x)}/2"


def _stage_vectors(solver: AbstractSymplecticSolver) -> str:
    one, two = solver.stage_vectors(1), solver.stage_vectors(2)
    if len(one) == 0:
        return "none: explicit"
    if len(one) != len(two):
        return f"{one[0]} for each noise, and {' + '.join(map(str, one[:2]))}"
    text = " + ".join(map(str, one))
    return f"half of {text}" if solver.structure == "separable" else text
