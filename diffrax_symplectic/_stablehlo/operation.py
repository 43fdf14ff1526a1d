"""Operations of StableHLO, as rules see them.

Their semantics: https://openxla.org/stablehlo/spec.
"""

import functools as ft
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from .._compat import is_literal
from .backend import array_types
from .mlir import (
    attribute_entry,
    attribute_enum,
    attribute_integers,
    attribute_part,
    attribute_rows,
    attribute_value,
    constant_values,
    has_attribute,
    sole_operation,
)
from .tensor import Tensor


class Operation(NamedTuple):
    """An operation of a program.

    - `op`: the object of MLIR.
    - `run`: `run(i, arguments)` runs the region number `i`, such as the body of a loop.
    - `errors`: masks of the lanes that raise an error, to which rules append. The caller
        of the program sees to these lanes.
    """

    op: Any
    run: Callable[..., list[Tensor]]
    errors: list[Any]

    @property
    def name(self) -> str:
        """The name without the dialect, such as `add`."""
        return self.op.name.split(".")[-1]

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the first result."""
        return tuple(self.op.results[0].type.shape)

    @property
    def kind(self) -> Any:
        """The type of Dr.Jit arrays for the first result."""
        type_of_result = self.op.results[0].type
        # A token, which orders side effects, has no type of entries.
        name = str(getattr(type_of_result, "element_type", type_of_result))
        if name not in array_types():
            raise NotReplayed(self.op, f"numbers of type `{name}`")
        return array_types()[name]

    @property
    def value(self) -> np.ndarray:
        """The values of a constant."""
        return constant_values(self.op)

    @property
    def reduces_by(self) -> str | None:
        """The name of the operation that a reduction repeats, such as `add`; `None` if its
        region does more than one."""
        name = sole_operation(self.op.regions[0])
        return None if name is None else name.split(".")[-1]

    def has(self, name: str) -> bool:
        return has_attribute(self.op, name)

    def ints(self, name: str) -> list[int]:
        return attribute_integers(self.op, name)

    def optional(self, name: str) -> list[int]:
        """As `ints`, or nothing if there is no such attribute."""
        return self.ints(name) if self.has(name) else []

    def number(self, name: str) -> int:
        return attribute_value(self.op, name)

    def rows(self, name: str) -> np.ndarray:
        return attribute_rows(self.op, name)

    def letter(self, name: str) -> str:
        """An argument of LAPACK, such as `U` for an upper triangle."""
        return chr(attribute_entry(self.op, "mhlo.backend_config", name))

    def word(self, name: str) -> str:
        """The value of an enumeration, such as `LT`."""
        return attribute_enum(self.op, name)

    def part(self, name: str, key: str) -> list[int]:
        """An entry of an attribute with several, such as `offset_dims` of a `gather`."""
        return attribute_part(self.op, name, key)

    def shapes(self) -> list[tuple[int, ...]]:
        """The shapes of all results."""
        return [tuple(result.type.shape) for result in self.op.results]

    def fail(self, mask: Any) -> None:
        """Marks the lanes of this mask as failed."""
        # Often it is known while the kernel is recorded that no lane fails.
        if not (is_literal(mask) and not mask[0]):
            self.errors.append(mask)

    def failing(self, fn: Callable[[], Any]) -> tuple[Any, Any]:
        """What `fn` returns, and the mask of the lanes that fail in it: within a loop or
        branch a mask belongs to its inside, which has to return it."""
        num_before = len(self.errors)
        returned = fn()
        new_errors = self.errors[num_before:]
        del self.errors[num_before:]
        none = array_types()["i1"](False)
        return returned, ft.reduce(operator.or_, new_errors, none)


class NotReplayed(Exception):
    """An operation that cannot be replayed, and which part of it.

    - `location`: where it comes from, as JAX recorded it.
    """

    def __init__(self, op: Any, what: str | None = None):
        super().__init__(what or f"`{op.name}`")
        self.location = str(op.location)


# From an operation and its operands to its results.
Rule: TypeAlias = Callable[..., list[Tensor]]
RULES: dict[str, Rule] = {}


def rule(fn: Rule) -> Rule:
    """Registers a function as the rule for the operation of the same name."""
    # With an underscore, since Python has words such as `while` of its own.
    RULES[fn.__name__.strip("_")] = fn
    return fn
