"""What the modules of the package import and use of each other and of other packages. (That
imports run downwards only is a contract in `pyproject.toml`.)"""

import ast
import functools as ft
import re
from collections.abc import Iterable
from pathlib import Path

import diffrax_symplectic as ds


ROOT = Path(ds.__file__).parent
# Private modules, and public ones without a promise to be kept.
PRIVATE_IMPORT = re.compile(r"\._(?!_)|\.internal|jax\.extend|jax\.interpreters")
# Private attributes, and parts of the state and of the settings of others that are no part
# of their documented interface.
PRIVATE_ATTRIBUTE = re.compile(
    r"(^|\.)_[a-z]\w*$|^jax\.core\.|^jax\.config\.read$|\.(tprev|tnext|save_state|"
    r"saveat_ts_index|controller_state|tol|canonicalize_dtype|ensure_compile_time_eval|"
    r"compute|__notes__)$"
)


@ft.cache
def modules() -> dict[Path, ast.Module]:
    return {file: ast.parse(file.read_text()) for file in ROOT.rglob("*.py")}


def imports(nodes: Iterable[ast.AST]) -> set[str]:
    """What these nodes import from other packages."""
    names = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom) and node.level == 0:
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def private_attributes(tree: ast.AST) -> set[str]:
    """Attributes of what others do not promise to keep."""
    # Of a NamedTuple these are public, in spite of their names.
    own = {"_replace", "_asdict", "_fields"}
    attributes = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            own.add(node.name)
        if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            own.add(node.target.id)
        if isinstance(node, ast.Attribute):
            attributes.append(node)
    names = {ast.unparse(node) for node in attributes if node.attr not in own}
    of_others = {name for name in names if name.split(".")[0] not in ("self", "cls")}
    return {name for name in of_others if PRIVATE_ATTRIBUTE.search(name)}


def test_private_parts_of_others_are_used_in_one_module_only():
    """If this fails: move the use to `_compat.py`, with a test in `test_private_parts`."""
    for file, tree in modules().items():
        if file != ROOT / "_compat.py":
            private = set(filter(PRIVATE_IMPORT.search, imports(ast.walk(tree))))
            assert not private | private_attributes(tree), file


def test_what_takes_long_to_import_is_imported_when_it_is_needed():
    for file, tree in modules().items():
        packages = {name.split(".")[0] for name in imports(tree.body)}
        assert packages.isdisjoint({"scipy", "drjit", "matplotlib"}), file


def test_nothing_reaches_past_the_entrance_of_a_folder():
    for file, tree in modules().items():
        is_entrance = file.name == "__init__.py" and file.parent != ROOT
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.level > 0:
                # An entrance imports from all of its folder.
                own = is_entrance and node.level == 1
                where = node.module or ""
                assert own or "." not in where, f"{file} imports {where}"
