from .kernels import Kernels
from .layout import sample_key, split
