"""Where methods fail and where they hold: `python -m examples.stability [--quick]`."""

from ._page import run


if __name__ == "__main__":
    run("stability", __doc__, ("moments", "solvability", "stiff", "baths", "rounding"))
