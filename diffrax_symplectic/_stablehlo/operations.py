"""The table of operations that can be replayed. An elementwise operation is a line in
`elementwise` or `complex`; any other is a function with the decorator `rule`."""

import functools as ft
from collections.abc import Callable
from typing import Any

from . import (  # noqa: F401 (they fill the table)
    control_flow,
    linear_algebra,
    moves,
    reductions,
    windows,
)
from .angles import lanes_with_too_large_angle
from .complex import complex_functions, is_complex
from .elementwise import elementwise
from .operation import NotReplayed, Operation, Rule, RULES
from .tensor import map_entries, same_table, Tensor


def rule_of(name: str) -> Rule | None:
    """The rule for an operation, by its name without the dialect; `None` if it has none."""
    of_real = elementwise().get(name)
    of_complex = complex_functions().get(name)
    if of_real is None and of_complex is None:
        return RULES.get(name)

    def entry_by_entry(operation: Operation, *xs: Tensor) -> list[Tensor]:
        # Any operand may be the complex one: the first of a selection is its mask.
        has_complex_operand = any(map(_has_complex_entries, xs))
        function = of_complex if has_complex_operand else of_real
        if function is None:
            numbers = "complex numbers" if has_complex_operand else "real numbers"
            raise NotReplayed(
                operation.mlir_op, f"`{operation.full_name}` of {numbers}"
            )
        return [map_entries(ft.partial(_applied, operation, function), *xs)]

    if name == "select":
        return ft.partial(_select, entry_by_entry)
    return entry_by_entry


def _has_complex_entries(x: Tensor) -> bool:
    # There is a first entry: `Replay` asks for no rule of arrays without entries.
    return is_complex(x.entries[0])


def _select(
    entry_by_entry: Rule,
    operation: Operation,
    mask: Tensor,
    if_true: Tensor,
    if_false: Tensor,
) -> list[Tensor]:
    """The rule of a selection, `entry_by_entry` unless both choices are the same table."""
    # `vmap` of a conditional selects between two equal tables: one stays in memory.
    if same_table(if_true, if_false):
        return [if_true]
    return entry_by_entry(operation, mask, if_true, if_false)


def _applied(operation: Operation, function: Callable, *entries: Any) -> Any:
    """An elementwise function of one entry of each operand. Dr.Jit's sine is wrong beyond
    some angle: lanes with a larger angle fail, and JAX simulates their paths again."""
    failed = lanes_with_too_large_angle(operation.name, *entries)
    if failed is not None:
        operation.fail(failed)
    return function(*entries)


def names() -> set[str]:
    """All operations in the table."""
    return {*elementwise(), *complex_functions(), *RULES}
