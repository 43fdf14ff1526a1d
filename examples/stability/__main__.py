"""Where methods fail and where they hold: `python -m examples.stability [--quick]`."""

from ._page import run


if __name__ == "__main__":
    modules = (
        "moments",
        "solvability",
        "stiff",
        "baths",
        "chain",
        "friction",
        "rounding",
    )
    run("stability", __doc__, modules)
