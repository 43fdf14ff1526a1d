"""Langevin dynamics: friction on velocities, and the noise of a temperature.

- `terms`: `langevin_terms` and `bath_terms`.
- `friction`: the forms of a friction (numbers, a matrix or directions), the force of
  friction, and the root of the friction in the noise.
- `diffrax_langevin`: Diffrax's own Langevin terms, with their state `(x, v)`.
"""

from .diffrax_langevin import momentum_first
from .friction import FrictionAlong, semidefinite_root
from .terms import bath_terms, BathNoise, langevin_terms
