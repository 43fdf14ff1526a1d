"""Where methods fail and where they hold: `python -m examples.stability [--quick]`."""

import argparse
import time
from pathlib import Path

from . import moments, rounding, solvability, stiff
from ._page import Page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="small sizes; writes to examples/output and leaves docs alone",
    )
    page = Page("stability", parser.parse_args().quick)
    start = time.perf_counter()
    sections = [Path(__file__).with_name("page.md").read_text()]
    for module in (moments, solvability, stiff, rounding):
        begin = time.perf_counter()
        sections.append(module.section(page))
        print(f"({time.perf_counter() - begin:.0f} seconds)", flush=True)
    page.write(sections)
    print(f"\nAll done in {time.perf_counter() - start:.0f} seconds.")


if __name__ == "__main__":
    main()
