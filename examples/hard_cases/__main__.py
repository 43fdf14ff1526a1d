"""Hard cases: `python -m examples.hard_cases [--quick]`."""

from ..stability._page import run


if __name__ == "__main__":
    run(
        "hard_cases",
        __doc__,
        (
            "two_body",
            "double_well",
            "rods",
            "nls",
            "learning",
        ),
    )
