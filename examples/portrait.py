"""The picture of the tutorial, which is drawn by the code of the page itself, up to where
it saves it.

    python -m examples.portrait
"""

import os
import re
from pathlib import Path


DOCS = Path(__file__).parent.parent / "docs"
BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def main() -> None:
    os.environ["MPLBACKEND"] = "Agg"
    # The page saves its picture in the working directory.
    os.chdir(DOCS / "img")
    names = {}
    for code in BLOCK.findall((DOCS / "tutorial.md").read_text()):
        exec(code, names)
        if "savefig" in code:
            return


if __name__ == "__main__":
    main()
