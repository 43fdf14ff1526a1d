"""All figures of the paper: `python -m examples`, or some: `python -m examples 2a 2c`."""

from ._command import run


# The modules of the figures, in the order in which they begin: a quick one beside the
# longest, so that there is soon something to look at, and the longest early, so that both
# processes end at about the same time.
FIGURES = {
    "1": "linear_oscillator",
    "3": "kubo",
    "6b": "rigid_body",
    "6a": "synchrotron",
    "2b": "linear_oscillator",
    "4": "synchrotron",
    "2c": "kubo",
    "poisson": "rigid_body",
    "5": "rigid_body",
    "2d": "synchrotron",
    "2a": "linear_oscillator",
}


if __name__ == "__main__":
    run(FIGURES)
