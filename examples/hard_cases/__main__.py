"""Hard cases: `python -m examples.hard_cases [--quick]`."""

import argparse
import time
from pathlib import Path

from ..stability._page import Page
from . import chain, double_well, henon_heiles, two_body


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--quick",
        action="store_true",
        help="small sizes; writes to examples/output and leaves docs alone",
    )
    page = Page("hard_cases", parser.parse_args().quick)
    start = time.perf_counter()
    sections = [Path(__file__).with_name("page.md").read_text()]
    for module in (two_body, double_well, chain, henon_heiles):
        begin = time.perf_counter()
        sections.append(module.section(page))
        print(f"({time.perf_counter() - begin:.0f} seconds)", flush=True)
    page.write(sections)
    print(f"\nAll done in {time.perf_counter() - start:.0f} seconds.")


if __name__ == "__main__":
    main()
