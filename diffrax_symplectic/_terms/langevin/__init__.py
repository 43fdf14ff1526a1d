"""Langevin dynamics: friction on velocities, and the noise of a temperature.

- `terms`: `langevin_terms`, `bath_terms`, and the terms taken apart again.
- `friction`: the forms of friction, numbers, a matrix or directions, and its root in the
  noise.
- `diffrax_langevin`: Diffrax's own Langevin terms, with their state `(x, v)`.
"""

from .diffrax_langevin import momentum_first
from .friction import FrictionAlong, semidefinite_root
from .terms import AbstractFriction, bath_terms, BathNoise
from .terms import friction_apart, langevin_terms, split_friction
