"""What README and docs show works."""

import csv
import importlib
import inspect
import json
import pkgutil
import re
import textwrap
from pathlib import Path
from string import Formatter

import diffrax
import jax.random as jr
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic import _solver
from diffrax_symplectic._expectation import choose
from diffrax_symplectic._solver import LANGEVIN, SOLVERS
from diffrax_symplectic._terms import FRICTION
from diffrax_symplectic._terms.constrained_drift import KEEP
from examples.notebooks import read_cells, SCRIPTS

from .families import slow_except


ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
# That of a docstring.
INDENTED = re.compile(r"^    ```python\n(.*?)^    ```", re.DOTALL | re.MULTILINE)
PAGES = {
    str(page.relative_to(ROOT)): blocks
    for page in [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
    if (blocks := BLOCK.findall(page.read_text()))
}


DOCSTRINGS = {
    name: blocks
    for name, value in vars(ds).items()
    if not name.startswith("_")
    and (blocks := INDENTED.findall(inspect.getdoc(value) or ""))
}


@pytest.fixture
def small_defaults(monkeypatch):
    """Default sizes of a tenth: programs without optimization take long for each path."""
    seconds = choose._SECONDS_OF_PATHS / 10
    monkeypatch.setattr(choose, "_SECONDS_OF_PATHS", seconds)


@pytest.mark.parametrize("name", DOCSTRINGS)
@pytest.mark.slow
def test_the_example_of_a_docstring_runs(name, small_defaults):
    for code in DOCSTRINGS[name]:
        exec(compile(textwrap.dedent(code), name, "exec"), {})


# Those that a new user runs first, beside README, whose program is run with the wheel.
FIRST_PAGES = "docs/index.md", "docs/concepts.md"


@pytest.mark.parametrize("page", slow_except(FIRST_PAGES, PAGES))
def test_code_of_a_page_runs_from_top_to_bottom(
    page, small_defaults, tmp_path, monkeypatch
):
    # Pictures are drawn into files, outside the checkout.
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.chdir(tmp_path)
    namespace = {}
    for number, code in enumerate(PAGES[page], start=1):
        exec(compile(code, f"{page}, block {number}", "exec"), namespace)


def test_every_page_starts_with_64_bits_and_takes_no_path_that_repeats_its_noise():
    assert all("jax_enable_x64" in blocks[0] for blocks in PAGES.values())
    shown = [*PAGES.values(), *DOCSTRINGS.values()]
    assert not any("UnsafeBrownianPath" in code for blocks in shown for code in blocks)
    faq = (ROOT / "docs" / "faq.md").read_text()
    assert "UnsafeBrownianPath` for short runs" in faq and "diffrax/issues/733" in faq


@pytest.fixture
def tables(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    return importlib.import_module("_tables")


def test_tables_of_solvers_are_up_to_date(tables):
    for page in (ROOT / "docs").rglob("*.md"):
        text = page.read_text()
        assert tables.with_tables(text) == text, "run `python docs/_tables.py`"


def test_notebooks_are_made_from_their_scripts():
    assert len(SCRIPTS) == 4
    folder = ROOT / "docs" / "examples"
    assert {p.stem for p in folder.glob("*.ipynb")} == {p.stem for p in SCRIPTS}
    for script in SCRIPTS:
        file = folder / f"{script.stem}.ipynb"
        cells = json.loads(file.read_text())["cells"]
        found = [
            (c["cell_type"], c["metadata"].get("title", ""), "".join(c["source"]))
            for c in cells
        ]
        assert found == read_cells(script), "run `python -m examples.notebooks`"
        # They were run from top to bottom, drew what has a title, and are small.
        code = [c for c in cells if c["cell_type"] == "code"]
        assert [c["execution_count"] for c in code] == [*range(1, len(code) + 1)]
        for cell in code:
            drawn = [o for o in cell["outputs"] if "image/png" in o.get("data", {})]
            assert len(drawn) == ("title" in cell["metadata"])
        assert file.stat().st_size < 150_000


def test_pages_of_evidence_have_the_text_of_the_programs_that_write_them():
    for name in ("stability", "hard_cases"):
        page = (ROOT / f"docs/{name}.md").read_text()
        for file in (ROOT / "examples" / name).glob("*.md"):
            text, place = file.read_text().strip(), 0
            # What stands between the values that are filled in.
            parts = [part for part, *_ in Formatter().parse(text)]
            for part in [text] if file.stem == "tail" else parts:
                place = page.find(part, place)
                assert place >= 0, (file, part)
    for page in (ROOT / "docs").rglob("*.md"):
        for module in re.findall("<!-- made by (.*) -->", page.read_text()):
            source = ROOT / f"{module.replace('.', '/')}.py"
            assert f'write("{module}"' in source.read_text()


def test_every_class_of_solvers_is_public_and_in_the_tables():
    known = {*SOLVERS, *LANGEVIN, ds.Splitting, ds.LinearFlow}
    for info in pkgutil.iter_modules(_solver.__path__):
        module = importlib.import_module(f"{_solver.__name__}.{info.name}")
        for name, kind in vars(module).items():
            if isinstance(kind, type) and issubclass(kind, ds.AbstractSymplecticSolver):
                if kind.record is not None:
                    assert getattr(ds, name, None) is kind and kind in known, name


def test_messages_name_solvers_that_keep_a_constraint_or_treat_friction():
    kinds = (*SOLVERS, *LANGEVIN)
    names = {kind.__name__ for kind in kinds}
    named = lambda message: {*re.findall(r"`(\w+)\(", message)} & names
    assert named(KEEP) == {kind.__name__ for kind in kinds if kind.keeps_constraints}
    # Any of them is an example of the others; another solver may be its flow.
    langevin = {kind.__name__ for kind in LANGEVIN}
    treat = r"solvers for heat baths, such as `(\w+)\(\)`, or `(\w+)\("
    assert {*re.search(treat, FRICTION).groups()} <= langevin  # pyright: ignore


def test_records_say_what_the_docstrings_say():
    # The claims of a docstring that are also in the record.
    number = {1: "1", 1.5: "3/2", 2: "2", 3: "3", 0.5: "1/2"}
    for solver in (*SOLVERS, *LANGEVIN):
        record = solver().record
        text = " ".join((solver.__doc__ or "").split()).lower()
        for kind, order in (("weak", record.weak), ("strong", record.strong)):
            for x in order if isinstance(order, tuple) else [order]:
                assert x is None or f"{kind} order {number[x]}" in text, (solver, kind)


def test_figures_below_the_first_picture_are_those_that_it_draws():
    text = " ".join((ROOT / "README.md").read_text().split())
    with (ROOT / "docs/img/first.csv").open() as file:
        rows = list(csv.reader(file))[1:]
    claims = re.findall(r"(\S+) in (\S+) seconds", text)
    assert len(claims) == 2
    assert set(claims) <= {(error, seconds) for _, _, error, seconds in rows}


def test_links_of_readme_lead_somewhere():
    links = re.findall(r"\]\((docs/.*?)\)", (ROOT / "README.md").read_text())
    assert len(links) > 5
    for link in links:
        page, _, anchor = link.partition("#")
        assert (ROOT / page).exists(), link
        if anchor:
            headings = re.findall("^#+ (.*)$", (ROOT / page).read_text(), re.M)
            assert anchor in [x.lower().replace(" ", "-") for x in headings], link


def test_docs_describe_every_public_name():
    pages = "".join(p.read_text() for p in (ROOT / "docs").rglob("*.md"))
    for name in vars(ds):
        if not name.startswith("_"):
            assert f"::: diffrax_symplectic.{name}\n" in pages, name


def test_every_source_has_one_entry_of_bibtex():
    package = Path(ds.__file__).parent
    text = "".join(p.read_text() for p in package.rglob("*.py"))
    bib = (package / "references.bib").read_text()
    linked = set(re.findall(r"\]\(https://doi\.org/(.*?)\)", text))
    entries = re.findall(r"doi = \{(.*)\}", bib)
    keys = re.findall(r"@\w+\{(.*),", bib)
    assert linked == set(entries)
    assert len(entries) == len(set(entries)) == len(keys) == len(set(keys))
    assert "```bibtex" not in text


def test_citation_prints_the_sources_of_solver_and_path_once(capsys):
    H0, noise = (lambda t, p, q, args: p**2 / 2), (lambda t, p, q, args: q)
    brownian = diffrax.VirtualBrownianTree(0, 1, 1e-3, (), jr.key(0))
    path = ds.TruncatedBrownianPath(brownian)
    terms = ds.hamiltonian_terms(H0, noise, path)
    ds.citation(terms, solver=ds.ImplicitMidpoint(), t0=0.0)
    ours = capsys.readouterr().out.split("% --- END AUTOGENERATED REFERENCES ---")[1]
    # Rule and path are from the same paper.
    assert "`diffrax_symplectic.ImplicitMidpoint`" in ours
    assert "`diffrax_symplectic.TruncatedBrownianPath`" in ours
    assert ours.count("@article{milstein2002numerical,") == ours.count("@") == 1
    ds.citation(solver=diffrax.Heun())
    printed = capsys.readouterr().out
    assert "AUTOGENERATED" in printed and "symplectic" not in printed
