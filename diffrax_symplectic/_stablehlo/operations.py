"""The rule of elementwise operations: it applies a function of the tables in
`elementwise.py` and `complex.py` to each entry."""

import operator
from collections.abc import Callable
from typing import Any, NamedTuple

from .backend import dr
from .complex import complex_functions, log_of_power
from .elementwise import elementwise
from .operation import NotReplayed, Operation
from .tensor import map_entries, Tensor


class _Limit(NamedTuple):
    """For which operands Dr.Jit's function is accurate: those for which the absolute value
    of a certain number is at most `largest`.

    - `number`: maps the operands to this number, such as the angle of a sine.
    - `largest`: the limit, by the size of the number's type in bytes: 4 or 8.
    """

    number: Callable[..., Any]
    largest: dict[int, float]


# Up to these angles Dr.Jit's sine and cosine are right to a unit in the last place. For
# twice these angles they are off by 4 units in single precision, and by 1e138 in double.
_LARGEST_ANGLES = {4: 2.0**13, 8: 2.0**31}
# Up to these quotients a remainder is right: every whole number is a float.
_LARGEST_QUOTIENTS = {4: 2.0**24, 8: 2.0**53}


def _itself(a):
    return a


def _quotient(a, b):
    # The remainder by zero is NaN, which needs no limit. So its quotient counts as zero.
    return dr.select(b == 0, 0, a / b)


_LIMITS_OF_REAL = {
    "cosine": _Limit(_itself, _LARGEST_ANGLES),
    "remainder": _Limit(_quotient, _LARGEST_QUOTIENTS),
    "sine": _Limit(_itself, _LARGEST_ANGLES),
    "tan": _Limit(_itself, _LARGEST_ANGLES),
}
_LIMITS_OF_COMPLEX = {
    "cosine": _Limit(operator.attrgetter("real"), _LARGEST_ANGLES),
    "exponential": _Limit(operator.attrgetter("imag"), _LARGEST_ANGLES),
    "power": _Limit(
        lambda base, exponent: log_of_power(base, exponent).imag, _LARGEST_ANGLES
    ),
    "sine": _Limit(operator.attrgetter("real"), _LARGEST_ANGLES),
}


def entry_by_entry(operation: Operation, *xs: Tensor) -> list[Tensor]:
    """The rule of all operations that have no rule of their own: applies a function to each
    entry, and marks the lanes as failed in which the function is not accurate."""
    name = operation.name
    if name not in elementwise() and name not in complex_functions():
        raise NotReplayed(operation.mlir_op)
    # Each operand has a first entry: `Replay` applies no rule for results without entries.
    is_complex = any(dr.is_complex_v(x.entries[0]) for x in xs)
    functions = complex_functions() if is_complex else elementwise()
    limits = _LIMITS_OF_COMPLEX if is_complex else _LIMITS_OF_REAL
    if name not in functions:
        raise operation.refusal(f"of {'complex' if is_complex else 'real'} numbers")

    def applied(*entries: Any) -> Any:
        # Remainders of integers are exact, and need no limit.
        if name in limits and not dr.is_integral_v(entries[0]):
            number = limits[name].number(*entries)
            largest = limits[name].largest[dr.itemsize_v(number)]
            # Lanes beyond the limit fail. (NaN does not: the function returns NaN.)
            operation.fail(dr.abs(number) > largest)
        return functions[name](*entries)

    return [map_entries(applied, *xs)]
