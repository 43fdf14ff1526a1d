"""The sources of the notebooks in `docs/examples`, which import public names and, for the
models of the paper, `examples`.

A script is made of cells: `# %% [markdown]` begins a text, `# %%` begins code, and what
stands behind it describes the picture that the code draws.
"""

import re
from pathlib import Path
from typing import NamedTuple


SCRIPTS = sorted(Path(__file__).parent.glob("[!_]*.py"))
_HEAD = re.compile(r"^# %%(.*)\n", re.MULTILINE)


class Cell(NamedTuple):
    kind: str  # "markdown" or "code", as in a notebook
    title: str
    source: str


def read_cells(script: Path) -> list[Cell]:
    _, *parts = _HEAD.split(script.read_text())
    cells = []
    for head, body in zip(parts[::2], parts[1::2]):
        if head.strip() == "[markdown]":
            text = re.sub(r"^# ?", "", body, flags=re.MULTILINE)
            cells.append(Cell("markdown", "", text.strip()))
        else:
            cells.append(Cell("code", head.strip(), body.strip()))
    return cells
