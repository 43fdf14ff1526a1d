"""The steps of many paths as one kernel, which keeps the state of each path in registers.

JAX lowers a step of one path to StableHLO (`path_functions.py`, `program.py`), and
`_stablehlo` replays it within a loop of Dr.Jit, with a lane for each path (`kernels.py`).
The stage equations of implicit solvers are solved by a loop of each path's own
(`sweeps.py`). A path with a step that it does not solve stops, and the caller simulates it
by other means.

    functions, arrays = functions_and_arrays(system, key, None, False)
    kernels = Kernels(functions)
    # Paths 0 to 999.
    lanes, shared = kernels.lanes_and_shared(arrays, key, h, 0, 1000, y0, None)
    # Steps 0 to 99.
    lanes = kernels.advance(lanes, shared, 0, 100)

Kernels depend on `functions` alone, so that the same serve for all values of `arrays`, step
sizes, and numbers of steps and paths.
"""

from .kernels import Kernels, Lanes
from .path_functions import PathFunctions, sample_key, functions_and_arrays
from .sweeps import by_sweeps_alone
