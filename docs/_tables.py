"""The tables of solvers in these pages, made from the solvers' records, and the list of
all public names:

    python docs/_tables.py

writes them into the files. A test tells if that was forgotten.
"""

import dataclasses
import re
from pathlib import Path

import diffrax_symplectic as ds
from diffrax_symplectic._solver import AbstractSplitting, AbstractSymplecticSolver, Want
from diffrax_symplectic._suggest import ranked, SOLVERS


_TABLE = re.compile(r"<!-- solvers: (.*?) -->.*?<!-- end -->", re.DOTALL)
_DOCS = Path(__file__).parent
_SEVERAL = re.compile(r"; (\S+) if noises do not commute")
_OBJECT = re.compile(r"^::: diffrax_symplectic\.(\w+)$", re.MULTILINE)
# The page of a solver, by the module that it stands in.
_PAGES = {
    "general": "general",
    "separable": "separable",
    "additive": "additive",
    "beyond": "beyond",
    "langevin": "langevin",
    "splitting": "langevin",
}
_STRUCTURES = {
    "any": "any Stratonovich system",
    "separable": "separable",
    "additive": "additive noise",
    "constant": "additive, constant noise",
    "separable and constant": "separable, constant noise",
}
_NOISES = {
    "any": "any number",
    "commuting": "one noise, or noises that commute",
    "not commuting": "noises that do not commute",
}
# Examples of solvers without defaults. A splitting is shown around any solver.
_SPLIT = (
    ds.BAOAB(1.0),
    ds.LangevinMiddle(1.0),
    ds.Damped(ds.NinomiyaVictoir(), 1.0),
    ds.LinearFlow(ds.NinomiyaVictoir(), lambda time, y, args: y),
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
    """The table of all solvers, of those of a page, or of what is suggested for `weak` or
    `strong` approximation; the names of those for any system; or all public names."""
    solvers = [*(solver() for solver in SOLVERS), *_SPLIT]
    if name in ("weak", "strong"):
        return _suggested(name)
    if name == "names any":
        names = [f"`{s.__name__}`" for s in SOLVERS if s().structure == "any"]
        return f"{', '.join(names[:-1])} and {names[-1]}"
    if name == "names":
        return _names()
    if name == "all":
        columns = ("name", "structure", "strong", "weak", "without noise", "solves for")
    elif name in _PAGES.values():
        solvers = [s for s in solvers if _page(s) == name]
        columns = ("solver", "noises", "when to choose it")
        if name in ("separable", "additive", "langevin"):  # any number of noises
            columns = ("solver", "when to choose it")
    else:
        raise ValueError(f"There is no table `{name}` of solvers.")
    rows = [_facts(s) for s in solvers]
    heads = [column.replace("name", "solver") for column in columns]
    text = _rows(heads, [[row[column] for column in columns] for row in rows])
    # The overview is narrow.
    return _SEVERAL.sub(r" (\1)", text) if name == "all" else text


def _page(solver: AbstractSymplecticSolver) -> str:
    return _PAGES[type(solver).__module__.split(".")[-1]]


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
        "name": f"[`{type(solver).__name__}`]({_page(solver)}.md)",
        "solver": _code(solver),
        "structure": _STRUCTURES[solver.structure],
        "noises": _NOISES[record.noises],
        "strong": _order(record.strong),
        "weak": _order(record.weak),
        "without noise": str(solver.order(None)),
        "solves for": _stage_vectors(solver),
        "when to choose it": record.choose,
    }
    if isinstance(solver, AbstractSplitting):
        facts |= {
            "structure": "as `solver`",
            "noises": "as `solver`",
            "strong": f"at most {solver.strong}",
            "weak": f"at most {solver.weak}",
            "without noise": "at most 2",
            "solves for": "as `solver`",
            "when to choose it": solver.choose,
        }
    return facts


def _suggested(want: Want) -> str:
    """All that `suggest_solver` names for some system with few noises, best first."""
    structures = tuple(_STRUCTURES)
    of = lambda commute: ranked(want, structures, commute, 2)
    found = {type(s): s for commute in (True, False) for s in of(commute)}
    rows = []
    for solver in found.values():
        facts = _facts(solver)
        system, noises = facts["structure"], solver.record.noises
        if noises != "any":
            system += f"; {_NOISES[noises]}"
        name = f"`{type(solver).__name__}`"
        rows.append([name, system, facts[want], facts["when to choose it"]])
    heads = ["solver", "structure and noises", f"{want} order", "when to choose it"]
    return _rows(heads, rows)


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


if __name__ == "__main__":
    for page in _DOCS.rglob("*.md"):
        page.write_text(with_tables(page.read_text()))
