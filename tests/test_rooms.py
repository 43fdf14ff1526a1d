"""No import reaches past the `__init__.py` of a folder. (That they run downwards only is a
contract in `pyproject.toml`.)"""

import ast
from pathlib import Path

import diffrax_symplectic as ds


ROOT = Path(ds.__file__).parent


def test_nothing_reaches_past_the_entrance_of_a_folder():
    for file in ROOT.rglob("*.py"):
        is_entrance = file.name == "__init__.py" and file.parent != ROOT
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level > 0:
                # An entrance imports from all of its folder.
                own = is_entrance and node.level == 1
                where = node.module or ""
                assert own or "." not in where, f"{file} imports {where}"
