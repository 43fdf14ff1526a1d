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
    ("_citation", "_compat", "_custom_types", "_signature"),
    ("_arguments", "_batch", "_lapack", "_stablehlo"),
    ("_brownian", "_root_finder"),
    ("_tableau",),
    ("_terms",),
    ("_solver",),
    ("_fused",),
    ("_expectation",),
    ("_adjoint", "_suggest", "_verify"),
    ("_compare",),
    ("__init__",),
]
FLOOR_OF = {room: floor for floor, rooms in enumerate(FLOORS) for room in rooms}
FILES = sorted(ROOT.rglob("*.py"))


def room_of(file: Path) -> str:
    """The folder of a module, or the module itself if it stands in none."""
    return file.relative_to(ROOT).parts[0].removesuffix(".py")


def imported(file: Path, *, within: int = 0) -> list[tuple[str, ...]]:
    """The modules of other rooms that a file imports, as parts of their names; or with
    `within=1` other modules and folders of the same room."""
    depth = len(file.relative_to(ROOT).parts)
    found = []
    for node in ast.walk(ast.parse(file.read_text())):
        # As many dots as folders, the package included: from another room.
        if isinstance(node, ast.ImportFrom) and node.level == depth - within:
            names = [alias.name for alias in node.names]
            modules = [node.module] if node.module else names
            found += [tuple(module.split(".")) for module in modules]
    return found


def test_every_room_has_a_floor():
    assert {room_of(file) for file in FILES} == FLOOR_OF.keys()


@pytest.mark.parametrize("room", FLOOR_OF)
def test_no_import_runs_upwards(room):
    for file in FILES:
        if room_of(file) == room:
            for other, *_ in imported(file):
                assert FLOOR_OF[other] < FLOOR_OF[room], f"{file} imports {other}"


def test_the_folder_of_stablehlo_needs_nothing_of_the_rest():
    used = {
        other
        for file in FILES
        if room_of(file) == "_stablehlo"
        for other, *_ in imported(file)
    }
    assert used == {"_compat"}


def test_nothing_reaches_past_the_entrance_of_a_folder():
    for file in FILES:
        for module in imported(file):
            assert len(module) == 1, f"{file} imports {'.'.join(module)}"


def in_room(room: str) -> list[Path]:
    """The files of a room but for its entrance, which imports from all of it."""
    files = (ROOT / room).rglob("*.py")
    return sorted(file for file in files if file != ROOT / room / "__init__.py")


@pytest.mark.parametrize("room", [x for x in FLOOR_OF if (ROOT / x).is_dir()])
def test_the_modules_of_a_room_import_each_other_one_way_only(room):
    needs: dict[str, set[str]] = {}
    for file in in_room(room):
        # An inner folder counts as one module.
        own = file.relative_to(ROOT / room).parts[0].removesuffix(".py")
        used = {other for other, *_ in imported(file, within=1)}
        needs.setdefault(own, set()).update(used - {own})
    # Raises a `CycleError` that names the modules of a cycle.
    graphlib.TopologicalSorter(needs).prepare()


def test_nothing_reaches_past_the_entrance_of_an_inner_folder():
    for room in FLOOR_OF:
        for file in in_room(room):
            for module in imported(file, within=1):
                assert len(module) == 1, f"{file} imports {'.'.join(module)}"
