"""Operations of StableHLO, as rules see them.

Their semantics: https://openxla.org/stablehlo/spec.
"""

import functools as ft
import operator
import re
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from .._compat import is_literal
from .backend import array_types
from .tensor import Tensor


# The number of the region of an operation that has a single one, such as a reduction.
ONLY_REGION = 0


class Operation(NamedTuple):
    """An operation of a program.

    - `mlir_op`: the object of MLIR.
    - `run`: `run(i, arguments)` returns the results of region number `i`, such as the body
        of a loop.
    - `failures`: masks of the lanes that fail, for example since the program would raise an
        error there. Rules append to them. The caller of the program sees to these lanes.
    """

    mlir_op: Any
    run: Callable[..., list[Tensor]]
    failures: list[Any]

    @property
    def full_name(self) -> str:
        """The name with the dialect, such as `stablehlo.add`, as in messages."""
        return self.mlir_op.name

    @property
    def name(self) -> str:
        """The name without the dialect, such as `add`."""
        return self.full_name.split(".")[-1]

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the first result."""
        return tuple(self.mlir_op.results[0].type.shape)

    @property
    def dtype(self) -> Any:
        """The type of Dr.Jit arrays for the entries of the first result. Raises a
        `NotReplayed` if Dr.Jit has none."""
        type_of_result = self.mlir_op.results[0].type
        # A token, which orders side effects, has no type of entries.
        name = str(getattr(type_of_result, "element_type", type_of_result))
        if name not in array_types():
            raise NotReplayed(self.mlir_op, f"numbers of type `{name}`")
        return array_types()[name]

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """The shapes of all results."""
        return [tuple(result.type.shape) for result in self.mlir_op.results]

    def refusal(self, why: str) -> "NotReplayed":
        """An error that says why an operation of this name cannot be replayed."""
        return NotReplayed(self.mlir_op, f"`{self.full_name}` {why}")

    # The methods below read an attribute of the operation, by its name in StableHLO. If
    # one of them fails after an upgrade of JAX, print the operation.

    def has(self, name: str) -> bool:
        return name in self.mlir_op.attributes

    def integers(self, name: str) -> list[int]:
        """A list of integers, which is empty if there is no such attribute."""
        return [int(i) for i in self.mlir_op.attributes[name]] if self.has(name) else []

    def integer(self, name: str) -> int:
        return self.mlir_op.attributes[name].value

    def matrix(self, name: str) -> np.ndarray:
        return np.asarray(self.mlir_op.attributes[name])

    def letter(self, name: str) -> str:
        """An argument of LAPACK, such as `U` for an upper triangle."""
        return chr(self.mlir_op.attributes["mhlo.backend_config"][name].value)

    def word(self, name: str) -> str:
        """The value of an enumeration, which MLIR only prints: of `LT` as
        `#stablehlo<comparison_direction LT>`."""
        return re.findall(r"\w+", str(self.mlir_op.attributes[name]))[-1]

    def part(self, name: str, key: str) -> list[int]:
        """An entry of an attribute with several, which MLIR only prints: as
        `#stablehlo.gather<offset_dims = [0], index_vector_dim = 1>`. Entries that are zero
        or empty are not printed."""
        # A list in brackets, or one number.
        text = str(self.mlir_op.attributes[name])
        entry = re.search(rf"\b{key} = (\[[^\]]*\]|\d+)", text)
        return [] if entry is None else [*map(int, re.findall(r"\d+", entry[1]))]

    def fail(self, mask: Any) -> None:
        """Marks the lanes of this mask as failed."""
        # Often it is known while the kernel is recorded that no lane fails.
        if not (is_literal(mask) and not mask[0]):
            self.failures.append(mask)

    def with_failures(self, fn: Callable[[], Any]) -> tuple[Any, Any]:
        """What `fn` returns, and the mask of the lanes that fail in it, which are taken out
        of `failures`: a mask that is recorded within a loop or branch cannot be used
        outside, so the loop or branch has to return it."""
        num_before = len(self.failures)
        returned = fn()
        new_failures = self.failures[num_before:]
        del self.failures[num_before:]
        no_lane = array_types()["i1"](False)
        return returned, ft.reduce(operator.or_, new_failures, no_lane)


class NotReplayed(Exception):
    """An operation that cannot be replayed.

    - `location`: where it comes from, as JAX recorded it.
    """

    def __init__(self, mlir_op: Any, what: str | None = None):
        """`what` is the message: the part that cannot be replayed. Without it, the message
        is the name of the operation."""
        super().__init__(what or f"`{mlir_op.name}`")
        self.location = str(mlir_op.location)


# From an operation and its operands to its results.
Rule: TypeAlias = Callable[..., list[Tensor]]
RULES: dict[str, Rule] = {}


def rule(fn: Rule) -> Rule:
    """Registers a function as the rule for the operation of the same name."""
    # With an underscore, since Python has words such as `while` of its own.
    RULES[fn.__name__.strip("_")] = fn
    return fn
