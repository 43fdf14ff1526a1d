from .backend import array_types, drjit
from .operation import NotReplayed
from .replay import Replay
from .tensor import flat, MOST_IN_REGISTERS, scalar, Table, Tensor, unflat
