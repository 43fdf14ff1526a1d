from .kernels import Kernels, Lanes, Shared
from .path_functions import PathFunctions, sample_key, split
from .sweeps import without_rescue
