"""The rule of elementwise operations: it applies a function of the tables in
`elementwise.py` and `complex.py` to each entry."""

import operator
from collections.abc import Callable
from typing import Any

from .backend import dr
from .complex import complex_functions, log_of_power
from .elementwise import elementwise
from .operation import NotReplayed, Operation
from .tensor import map_entries, Tensor


# For each size of numbers in bytes, the largest angle for which Dr.Jit's sine and cosine
# are right to a unit in the last place. For twice this angle they are off by 4 units in
# single precision, and by 1e138 in double.
_LARGEST_ANGLES = {4: 2.0**13, 8: 2.0**31}


def _itself(a):
    return a


# For each operation that takes a sine or cosine, the angle as a function of the operands.
_ANGLES_OF_REAL: dict[str, Callable[..., Any]] = {
    "cosine": _itself,
    "sine": _itself,
    "tan": _itself,
}
_ANGLES_OF_COMPLEX: dict[str, Callable[..., Any]] = {
    "cosine": operator.attrgetter("real"),
    "exponential": operator.attrgetter("imag"),
    "power": lambda base, exponent: log_of_power(base, exponent).imag,
    "sine": operator.attrgetter("real"),
}


def entry_by_entry(operation: Operation, *xs: Tensor) -> list[Tensor]:
    """The rule of all operations that have no rule of their own."""
    name = operation.name
    if name not in elementwise() and name not in complex_functions():
        raise NotReplayed(operation.mlir_op)
    # Each operand has a first entry: `Replay` applies no rule for results without entries.
    is_complex = any(dr.is_complex_v(x.entries[0]) for x in xs)
    functions = complex_functions() if is_complex else elementwise()
    angles = _ANGLES_OF_COMPLEX if is_complex else _ANGLES_OF_REAL
    if name not in functions:
        raise operation.refusal(f"of {'complex' if is_complex else 'real'} numbers")

    def applied(*entries: Any) -> Any:
        if name in angles:
            # Dr.Jit's sine and cosine are wrong for larger angles: these lanes fail.
            angle = angles[name](*entries)
            largest = _LARGEST_ANGLES[dr.itemsize_v(angle)]
            operation.fail(dr.abs(angle) > largest)
        return functions[name](*entries)

    return [map_entries(applied, *xs)]
