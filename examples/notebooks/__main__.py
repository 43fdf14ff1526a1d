"""Runs the scripts in Jupyter and writes them as notebooks, with what they print and draw:
`python -m examples.notebooks [--output folder] [name ...]`. Needs the extra `docs`."""

# The checks of types run without that extra.
# pyright: reportMissingImports=false

import argparse
import os
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook
from traitlets.config import Config

from . import Cell, read_cells, SCRIPTS


DOCS = Path(__file__).parents[2] / "docs" / "examples"
# Without the version of Python that a notebook was last run by.
METADATA = {
    "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    "language_info": {"name": "python"},
}
# Through files, not through ports of this machine.
CONFIG = Config({"KernelManager": {"transport": "ipc"}})


def _cell(number: int, cell: Cell) -> nbformat.NotebookNode:
    new = {"markdown": new_markdown_cell, "code": new_code_cell}[cell.kind]
    metadata = {"title": cell.title} if cell.title else {}
    return new(cell.source, id=f"cell-{number}", metadata=metadata)


def _drop_progress(notebook: nbformat.NotebookNode) -> None:
    """Removes what calls print that take long, which depends on the machine."""
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [
                output
                for output in cell.outputs
                if not output.get("text", "").startswith("`expectation` after")
            ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=DOCS)
    names = [script.stem for script in SCRIPTS]
    parser.add_argument("names", nargs="*", metavar="name", help=", ".join(names))
    arguments = parser.parse_args()
    if not set(arguments.names) <= set(names):
        parser.error(f"the notebooks are {', '.join(names)}")
    folder = arguments.output
    # `examples` sets it, for programs. In Jupyter pictures go into the notebook.
    os.environ.pop("MPLBACKEND", None)
    folder.mkdir(parents=True, exist_ok=True)
    for script in SCRIPTS:
        if arguments.names and script.stem not in arguments.names:
            continue
        begin = time.perf_counter()
        notebook = new_notebook(
            cells=[_cell(i, cell) for i, cell in enumerate(read_cells(script))],
            metadata=METADATA,
        )
        # Raises what a cell raises. The times of cells, which always change, are left out.
        NotebookClient(
            notebook, config=CONFIG, coalesce_streams=True, record_timing=False
        ).execute()
        notebook.metadata = METADATA
        _drop_progress(notebook)
        nbformat.write(notebook, folder / f"{script.stem}.ipynb")
        print(f"{script.stem}: {time.perf_counter() - begin:.0f} seconds", flush=True)


if __name__ == "__main__":
    main()
