"""Langevin dynamics: friction on velocities, and the noise of a temperature.

- `terms`: `langevin_terms` and `bath_terms`.
- `friction`: the forms of friction, numbers, a matrix or directions, and its root in the
  noise.
- `diffrax_langevin`: Diffrax's own Langevin terms, with their state `(x, v)`.
"""

from .diffrax_langevin import momentum_first
from .friction import FrictionAlong, semidefinite_root
from .terms import bath_terms, BathNoise, langevin_terms
