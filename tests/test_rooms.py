"""The folders of the package stand one above another, as `CONTRIBUTING.md` says: no import
runs upwards, and none reaches past the `__init__.py` of a folder."""

import ast
import graphlib
from pathlib import Path

import pytest

import diffrax_symplectic as ds


ROOT = Path(ds.__file__).parent
# From the bottom up. Those in a row do not import each other.
FLOORS = [
    ("_citation", "_compat", "_custom_types", "_products"),
    ("_programs",),
    ("_arguments", "_batch", "_lapack", "_stablehlo"),
    ("_brownian", "_root_finder"),
    ("_tableau",),
    ("_terms",),
    ("_solver",),
    ("_fused",),
    ("_simulation",),
    ("_ensemble", "_expectation"),
    ("_adjoint", "_suggest", "_verify"),
    ("_compare",),
    ("__init__",),
]
# Of the folders and modules in `_expectation`.
FLOORS_OF_EXPECTATION = [
    ("linear_maps", "progress"),
    ("sampling", "fields_in_time"),
    ("estimate", "batch", "cost", "kinks"),
    ("jumps", "fast_drive", "long_steps", "out_of_range", "strong_friction"),
    ("run", "call"),
    ("independent", "fitted", "sorted"),
    ("fused_paths",),
    ("choose",),
    ("finer_level",),
    ("expectation", "monte_carlo"),
    ("__init__",),
]
HOUSES = {ROOT: FLOORS, ROOT / "_expectation": FLOORS_OF_EXPECTATION}
ROOMS = [
    (house, room) for house, rows in HOUSES.items() for row in rows for room in row
]
FILES = sorted(ROOT.rglob("*.py"))
NAME = lambda x: x.name if isinstance(x, Path) else x


def floor_of(house: Path, room: str) -> int:
    """The number of the row in which a room is."""
    (number,) = [k for k, row in enumerate(HOUSES[house]) if room in row]
    return number


def room_of(file: Path, house: Path = ROOT) -> str:
    """The folder of a module, or the module itself if it stands in none."""
    return file.relative_to(house).parts[0].removesuffix(".py")


def imported(file: Path, house: Path = ROOT) -> list[tuple[str, ...]]:
    """The modules of other rooms that a file imports, as parts of their names."""
    depth = len(file.relative_to(house).parts)
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        # As many dots as folders, the house included: from another room.
        if isinstance(node, ast.ImportFrom) and node.level == depth:
            names = [alias.name for alias in node.names]
            modules = [node.module] if node.module else names
            found += [tuple(module.split(".")) for module in modules]
    return found


@pytest.mark.parametrize("house", HOUSES, ids=NAME)
def test_every_room_has_a_floor(house):
    rooms = {room_of(file, house) for file in house.rglob("*.py")}
    assert rooms == {room for row in HOUSES[house] for room in row}


@pytest.mark.parametrize("house, room", ROOMS, ids=NAME)
def test_no_import_runs_upwards(house, room):
    own = floor_of(house, room)
    for file in house.rglob("*.py"):
        if room_of(file, house) == room:
            for other, *_ in imported(file, house):
                assert floor_of(house, other) < own, f"{file} imports {other}"


def test_the_folder_of_stablehlo_needs_nothing_of_the_rest():
    used = {
        other
        for file in FILES
        if room_of(file) == "_stablehlo"
        for other, *_ in imported(file)
    }
    assert used == {"_compat"}


@pytest.mark.parametrize("house", HOUSES, ids=NAME)
def test_nothing_reaches_past_the_entrance_of_a_folder(house):
    for file in house.rglob("*.py"):
        for module in imported(file, house):
            assert len(module) == 1, f"{file} imports {'.'.join(module)}"


def in_room(room: str) -> list[Path]:
    """The files of a room but for its entrance, which imports from all of it."""
    files = (ROOT / room).rglob("*.py")
    return sorted(file for file in files if file != ROOT / room / "__init__.py")


FOLDERS = [x for row in FLOORS for x in row if (ROOT / x).is_dir()]


@pytest.mark.parametrize("room", FOLDERS)
def test_the_modules_of_a_room_import_each_other_one_way_only(room):
    needs: dict[str, set[str]] = {}
    for file in in_room(room):
        # An inner folder counts as one module.
        own = file.relative_to(ROOT / room).parts[0].removesuffix(".py")
        used = {other for other, *_ in imported(file, ROOT / room)}
        needs.setdefault(own, set()).update(used - {own})
    # Raises a `CycleError` that names the modules of a cycle.
    graphlib.TopologicalSorter(needs).prepare()


def test_nothing_reaches_past_the_entrance_of_an_inner_folder():
    for room in FOLDERS:
        for file in in_room(room):
            for module in imported(file, ROOT / room):
                assert len(module) == 1, f"{file} imports {'.'.join(module)}"
