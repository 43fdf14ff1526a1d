"""All figures of the paper: `python -m examples`, or some: `python -m examples 2a 2c`."""

from . import kubo, linear_oscillator, rigid_body, synchrotron
from ._gallery import run


FIGURES = (
    linear_oscillator.FIGURES | kubo.FIGURES | synchrotron.FIGURES | rigid_body.FIGURES
)
# A quick one beside the longest, so that there is soon something to look at. The longest
# start early so that both processes end at about the same time.
FIRST = {name: FIGURES[name] for name in ("1", "3", "2c", "6a", "6b")}


if __name__ == "__main__":
    run(FIRST | FIGURES)
