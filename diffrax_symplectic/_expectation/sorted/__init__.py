"""Paths that are sorted before each step and take quasi-random points.

- `array_rqmc`: the sampling, Array-RQMC.
- `points`: randomized quasi-random points, as random words.
- `hilbert`: the order of paths, along Hilbert's curve.
"""

from .array_rqmc import ArrayRQMC, word_layout
