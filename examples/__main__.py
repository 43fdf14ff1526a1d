"""All figures of the paper: `python -m examples`, or some: `python -m examples 2a 2c`."""

from . import kubo, linear_oscillator, rigid_body, synchrotron
from ._gallery import run


if __name__ == "__main__":
    run(
        linear_oscillator.FIGURES
        | kubo.FIGURES
        | synchrotron.FIGURES
        | rigid_body.FIGURES
    )
