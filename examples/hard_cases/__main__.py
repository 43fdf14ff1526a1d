"""Hard cases: `python -m examples.hard_cases [--quick]`."""

from ..stability._page import run
from . import chain, double_well, henon_heiles, learning, nls, spins, two_body


if __name__ == "__main__":
    modules = (two_body, double_well, chain, henon_heiles, spins, nls, learning)
    run("hard_cases", __doc__, modules)
