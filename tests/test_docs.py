"""What README and docs show works."""

import re
from pathlib import Path

import diffrax
import pytest

import diffrax_symplectic as ds


ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
PAGES = {
    str(page.relative_to(ROOT)): blocks
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if (blocks := BLOCK.findall(page.read_text()))
}


@pytest.mark.parametrize("page", PAGES)
def test_code_of_a_page_runs_from_top_to_bottom(page):
    namespace = {}
    for number, code in enumerate(PAGES[page], start=1):
        exec(compile(code, f"{page}, block {number}", "exec"), namespace)


def test_every_page_is_looked_through():
    # No block is written in a way that the pattern above misses.
    for name, blocks in PAGES.items():
        assert (ROOT / name).read_text().count("```python") == len(blocks)
    assert {"README.md", "docs/index.md", "docs/own_tableau.md"} <= PAGES.keys()


def test_readme_and_docs_list_every_solver():
    readme = (ROOT / "README.md").read_text()
    pages = "".join(p.read_text() for p in (ROOT / "docs/solvers").glob("*.md"))
    for name, value in vars(ds).items():
        if isinstance(value, type) and issubclass(value, diffrax.AbstractSolver):
            abstract = name.startswith("Abstract")
            assert abstract or f"| `{name}(" in readme
            assert abstract or f"::: diffrax_symplectic.{name}\n" in pages


def test_docs_describe_every_public_name():
    pages = "".join(p.read_text() for p in (ROOT / "docs").rglob("*.md"))
    for name in vars(ds):
        if not name.startswith("_"):
            assert f"::: diffrax_symplectic.{name}\n" in pages, name
