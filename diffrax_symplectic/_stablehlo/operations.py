"""Operations of each entry, by the tables of functions in `elementwise` and `complex`."""

import operator
from collections.abc import Callable
from typing import Any

from .backend import dr
from .complex import complex_functions, log_of_power
from .elementwise import elementwise
from .operation import NotReplayed, Operation
from .tensor import map_entries, Tensor


# The largest angles whose sine and cosine Dr.Jit has to a unit in the last place, for each
# size of numbers in bytes. For twice this angle they are off by 4 units in single
# precision, and by 1e138 in double.
_LARGEST_ANGLES = {4: 2.0**13, 8: 2.0**31}


def _itself(a):
    return a


# For each function, the angle whose sine or cosine it takes, as a function of its operands.
_ANGLES_OF_REAL: dict[str, Callable[..., Any]] = dict.fromkeys(
    ("cosine", "sine", "tan"), _itself
)
_ANGLES_OF_COMPLEX: dict[str, Callable[..., Any]] = {
    "cosine": operator.attrgetter("real"),
    "exponential": operator.attrgetter("imag"),
    "power": lambda base, exponent: log_of_power(base, exponent).imag,
    "sine": operator.attrgetter("real"),
}


def entry_by_entry(operation: Operation, *xs: Tensor) -> list[Tensor]:
    """The rule of all operations that have no rule of their own."""
    name = operation.name
    of_real = elementwise().get(name)
    of_complex = complex_functions().get(name)
    if of_real is None and of_complex is None:
        raise NotReplayed(operation.mlir_op)
    # There is a first entry: `Replay` asks for no rule of arrays without entries.
    has_complex_operand = any(dr.is_complex_v(x.entries[0]) for x in xs)
    function = of_complex if has_complex_operand else of_real
    angles = _ANGLES_OF_COMPLEX if has_complex_operand else _ANGLES_OF_REAL
    if function is None:
        raise operation.refusal(
            f"of {'complex' if has_complex_operand else 'real'} numbers"
        )

    def applied(*entries: Any) -> Any:
        if name in angles:
            # JAX simulates the paths of lanes that fail again.
            angle = angles[name](*entries)
            largest = _LARGEST_ANGLES[dr.itemsize_v(angle)]
            operation.fail(dr.abs(angle) > largest)
        return function(*entries)

    return [map_entries(applied, *xs)]
