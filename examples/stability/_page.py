"""Where tables, pictures and pages go."""

import argparse
import importlib
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt

from .._command import compile_quickly, hasten


ROOT = Path(__file__).parents[2]


class Page(NamedTuple):
    """`docs/<name>.md` and the pictures in `docs/<name>/`. A quick run writes them to
    `examples/output`, so that what is published always comes from a full one."""

    name: str
    quick: bool

    @property
    def folder(self) -> Path:
        return ROOT / ("examples/output" if self.quick else "docs")

    def picture(self, figure, name: str, caption: str) -> str:
        """Saves and closes it; returns the Markdown that shows it."""
        path = self.folder / self.name / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
        plt.close(figure)
        print(f"picture: {path.relative_to(ROOT)}", flush=True)
        return f"![{caption}]({self.name}/{name}.png)"

    def write(self, sections: Iterable[str]) -> None:
        path = self.folder / f"{self.name}.md"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("\n\n".join(s.strip() for s in sections) + "\n")
        print(f"page: {path.relative_to(ROOT)}", flush=True)


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table, printed too."""
    rows = [[str(cell) for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(header, *rows)]
    for row in ([*header], *rows):
        print("  ".join(x.ljust(w) for x, w in zip(row, widths)), flush=True)
    lines = ["| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
    return "\n".join(lines + ["| " + " | ".join(row) + " |" for row in rows])


def merged(rows: Iterable[Sequence[str]]) -> list[Sequence[str]]:
    """The rows, one for all names that have the same cells."""
    names: dict[tuple[str, ...], list[str]] = {}
    for name, *cells in rows:
        names.setdefault(tuple(cells), []).append(name)
    return [(", ".join(same), *cells) for cells, same in names.items()]


def fill(module: str, **values) -> str:
    """The text next to a module, with what was measured put in the braces."""
    return Path(module).with_suffix(".md").read_text().format(**values)


def run(name: str, description: str | None, modules: Sequence[str]) -> None:
    """The command that makes a page: the text of `page.md` next to the modules, a section
    of each, and the text of `tail.md`. They are imported here, for they use JAX."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="small sizes; writes to examples/output and leaves docs alone",
    )
    page = Page(name, parser.parse_args().quick)
    if page.quick:
        compile_quickly()
        hasten()
    start = time.perf_counter()
    # It imports JAX.
    from ..benchmarks._timing import machine

    head = (ROOT / "examples" / name / "page.md").read_text()
    sections = [head.format(machine=machine())]
    for module in modules:
        begin = time.perf_counter()
        source = importlib.import_module(f"examples.{name}.{module}")
        sections.append(source.section(page))
        print(f"({time.perf_counter() - begin:.0f} seconds)", flush=True)
    tail = ROOT / "examples" / name / "tail.md"
    page.write([*sections, tail.read_text()] if tail.exists() else sections)
    print(f"\nAll done in {time.perf_counter() - start:.0f} seconds.")
