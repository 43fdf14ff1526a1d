"""The steps of many paths as one kernel, which keeps the state of each path in registers.

The modules:

- `path_functions.py`: the functions of one path, such as a step.
- `program.py`: such a function, lowered by JAX to StableHLO.
- `kernels.py`: the loop over steps, in which `_stablehlo` replays the program of a step.
    Each path is a *lane*, an element of every Dr.Jit array.
- `sweeps.py`: the root finder for the stage equations of implicit solvers, a loop that
    each path ends by itself. If the loop does not solve a step, the path stops, and the
    caller simulates the path by other means.

Usage:

    functions, arrays = functions_and_arrays(
        system, key, own_args=None, paths_differ=False
    )
    kernels = Kernels(functions)
    lanes, shared = kernels.lanes_and_shared(
        arrays, key, h, first_path=0, num_paths=1000, y0=y0, own_args=None
    )
    lanes = kernels.advance(lanes, shared, first_step=0, end_step=100)

Kernels depend on `functions` alone: the same kernels serve for all values of `arrays`, step
sizes, and numbers of steps and paths.
"""

from .kernels import Kernels, Lanes
from .path_functions import PathFunctions, sample_key, functions_and_arrays
from .sweeps import by_sweeps_alone
