"""The table of solvers in these pages, made from the solvers' records, and the list of all
public names:

    python docs/_tables.py

writes both into the files. A test tells if that was forgotten.
"""

import re
from pathlib import Path

import diffrax_symplectic as ds
from diffrax_symplectic._solver import AbstractSymplecticSolver, LANGEVIN, SOLVERS


_TABLE = re.compile(r"<!-- solvers: (.*?) -->.*?<!-- end -->", re.DOTALL)
_DOCS = Path(__file__).parent
_OBJECT = re.compile(r"^::: diffrax_symplectic\.(\w+)$", re.MULTILINE)
_STRUCTURES = {
    "any": "any",
    "separable": "separable",
    "additive": "additive noise",
    "constant": "additive, constant noise",
    "separable and constant": "separable, constant noise",
}
# Shown around any solver.
_LINEAR_FLOW = ds.LinearFlow(ds.NinomiyaVictoir(), lambda time, y, args: y)
# Any splitting that is the same in reverse.
_HALF_KICK, _HALF_FLIGHT = ds.Kick(1 / 2), ds.Flight(1 / 2)
_SPLITTING = ds.Splitting(
    [_HALF_KICK, _HALF_FLIGHT, ds.Bath(1), _HALF_FLIGHT, _HALF_KICK]
)


def with_tables(markdown: str) -> str:
    """The page with its tables, each between `<!-- solvers: ... -->` and `<!-- end -->`,
    as they are now."""

    def current(found: re.Match) -> str:
        text = table(found[1])
        inside = f"\n\n{text}\n\n" if text.startswith(("|", "**")) else text
        return f"<!-- solvers: {found[1]} -->{inside}<!-- end -->"

    return _TABLE.sub(current, markdown)


def table(name: str) -> str:
    """The table of all solvers, the names of the solvers for any system, or all public
    names."""
    solvers = [
        *(solver() for solver in (*SOLVERS, *LANGEVIN)),
        _SPLITTING,
        _LINEAR_FLOW,
    ]
    if name == "names any":
        names = [f"`{s.__name__}`" for s in SOLVERS if s().structure == "any"]
        return f"{', '.join(names[:-1])} and {names[-1]}"
    if name == "names":
        return _names()
    if name != "all":
        raise ValueError(f"There is no table `{name}` of solvers.")
    columns = ("solver", "structure", "strong", "weak", "without noise")
    columns += ("when to choose it",)
    rows = [_facts(solver) for solver in solvers]
    return _rows(columns, [[row[column] for column in columns] for row in rows])


def _page(solver: AbstractSymplecticSolver) -> str:
    """The page that describes a solver."""
    name = type(solver).__name__
    (page,) = [
        page
        for page in (_DOCS / "solvers").glob("*.md")
        if name in _OBJECT.findall(page.read_text())
    ]
    return page.stem


def _names() -> str:
    """All public names in alphabetical order, a line for each letter, linked to where they
    are described."""
    lines: dict[str, dict[str, str]] = {}
    for page in _DOCS.rglob("*.md"):
        for name in _OBJECT.findall(page.read_text()):
            where = f"{page.relative_to(_DOCS)}#diffrax_symplectic.{name}"
            lines.setdefault(name[0].upper(), {})[name] = f"[`{name}`]({where})"
    ordered = lambda names: [
        names[x] for x in sorted(names, key=lambda x: (x.lower(), x))
    ]
    return "\n\n".join(f"**{x}** {', '.join(ordered(lines[x]))}" for x in sorted(lines))


def _facts(solver: AbstractSymplecticSolver) -> dict[str, str]:
    record = solver.record
    assert record is not None
    facts = {
        "solver": f"[`{type(solver).__name__}`]({_page(solver)}.md)",
        "structure": _STRUCTURES[solver.structure],
        "strong": _order(record.strong),
        "weak": _order(record.weak),
        "without noise": str(solver.order(None)),
        "when to choose it": record.choose,
    }
    if isinstance(solver, ds.LinearFlow):
        facts |= {
            "structure": "as `solver`",
            "strong": f"at most {solver.strong}",
            "weak": f"at most {solver.weak}",
            "without noise": "at most 2",
            "when to choose it": solver.choose,
        }
    return facts


def _rows(columns, rows: list[list[str]]) -> str:
    lines = [list(columns), ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |".replace("|  |", "| |") for line in lines)


def _order(order) -> str:
    if order is None:
        return ""
    if isinstance(order, tuple):
        commuting, others = map(_fraction, order)
        return f"{commuting} ({others})"  # if noises do not commute
    return _fraction(order)


def _fraction(x: float) -> str:
    return f"{x:g}" if x == int(x) else f"{int(2 * x)}/2"


if __name__ == "__main__":
    for page in _DOCS.rglob("*.md"):
        page.write_text(with_tables(page.read_text()))
