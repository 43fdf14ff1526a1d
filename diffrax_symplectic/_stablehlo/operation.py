"""Operations of StableHLO, as the argument of rules; and the table of all rules.

A *rule* is a function from an operation and its operands to its results. Its arrays hold
many paths at once, each in a *lane* of its own. The specification of operations:
https://openxla.org/stablehlo/spec.
"""

import functools as ft
import operator
import re
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from .._compat import is_literal
from .backend import array_types
from .tensor import Tensor


# The number of the region of an operation with a single region, such as a reduction.
ONLY_REGION = 0


class Operation(NamedTuple):
    """An operation of a program.

    - `mlir_op`: MLIR's object for the operation.
    - `run`: `run(i, arguments)` returns the results of region number `i`. A *region* is
        code that belongs to the operation, such as the body of a loop.
    - `failures`: masks of lanes whose results are not valid, for example since the program
        would raise an error in these lanes. All operations of a program append to the same
        list by `fail`. The caller of the program computes these lanes by other means.
    """

    mlir_op: Any
    run: Callable[..., list[Tensor]]
    failures: list[Any]

    @property
    def full_name(self) -> str:
        """The name with the dialect, such as `stablehlo.add`."""
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
        """The Dr.Jit type of an entry of the first result. Raises a `NotReplayed` if Dr.Jit
        has no such type."""
        type_of_result = self.mlir_op.results[0].type
        # The result may be a token, which orders side effects and has no entries.
        name = str(getattr(type_of_result, "element_type", type_of_result))
        if name not in array_types():
            raise NotReplayed(self.mlir_op, f"numbers of type `{name}`")
        return array_types()[name]

    @property
    def shapes(self) -> list[tuple[int, ...]]:
        """The shapes of all results."""
        return [tuple(result.type.shape) for result in self.mlir_op.results]

    def refusal(self, why: str) -> "NotReplayed":
        """The error to raise if this operation cannot be replayed. `why` stands in the
        message after the name of the operation, as in "`stablehlo.sort` of more than 16
        numbers"."""
        return NotReplayed(self.mlir_op, f"`{self.full_name}` {why}")

    # The methods below read an attribute of the operation, by its name in StableHLO. If one
    # of them fails after an upgrade of JAX, print the operation to see what has changed.

    def has(self, name: str) -> bool:
        """Whether the operation has an attribute of this name."""
        return name in self.mlir_op.attributes

    def integers(self, name: str) -> list[int]:
        """The integers of a list or, row by row, of a matrix. If there is no attribute of
        this name, the list is empty."""
        return [int(i) for i in self.mlir_op.attributes[name]] if self.has(name) else []

    def integer(self, name: str) -> int:
        return self.mlir_op.attributes[name].value

    def letter(self, name: str) -> str:
        """An argument of LAPACK, such as `U` for an upper triangle."""
        return chr(self.mlir_op.attributes["mhlo.backend_config"][name].value)

    def word(self, name: str) -> str:
        """The value of an enumeration, such as `LT`. MLIR gives it only in printed form, as
        `#stablehlo<comparison_direction LT>`."""
        return re.findall(r"\w+", str(self.mlir_op.attributes[name]))[-1]

    def integers_of_field(self, name: str, field: str) -> list[int]:
        """The integers in a field of an attribute that has several fields. MLIR gives such
        an attribute only in printed form, as
        `#stablehlo.gather<offset_dims = [0, 2], index_vector_dim = 1>`. A single number is
        returned as a list of one. A field that is zero or empty is not printed, and the
        list is empty."""
        printed = str(self.mlir_op.attributes[name])
        # A list in brackets, or a single number.
        value = re.search(rf"\b{field} = (\[[^\]]*\]|\d+)", printed)
        return [] if value is None else [*map(int, re.findall(r"\d+", value[1]))]

    def fail(self, mask: Any) -> None:
        """Marks the lanes of this mask as failed."""
        # Often it is known while the kernel is recorded that no lane fails.
        is_known_false = is_literal(mask) and not mask[0]
        if not is_known_false:
            self.failures.append(mask)

    def with_failures(self, fn: Callable[[], Any]) -> tuple[Any, Any]:
        """Calls `fn`, which runs a region of a loop or conditional of the kernel. Returns
        its results, and the mask of the lanes that fail in it.

        The masks that `fn` adds to `failures` are removed from there. Dr.Jit allows no use
        of them outside of the loop or branch in which they were recorded, unless the loop
        or branch returns them.
        """
        num_before = len(self.failures)
        results = fn()
        new_failures = self.failures[num_before:]
        del self.failures[num_before:]
        no_lane = array_types()["i1"](False)
        return results, ft.reduce(operator.or_, new_failures, no_lane)


class NotReplayed(Exception):
    """Raised for an operation that cannot be replayed.

    - `location`: the printed location of the operation, from which `source_lines` reads the
        lines of Python.
    """

    def __init__(self, mlir_op: Any, what: str | None = None):
        """`what` is the message, which says what cannot be replayed. By default it is the
        name of the operation."""
        super().__init__(what or f"`{mlir_op.name}`")
        self.location = str(mlir_op.location)


Rule: TypeAlias = Callable[..., list[Tensor]]
# The rules that the decorator `rule` registers, by the names of their operations.
RULES: dict[str, Rule] = {}


def rule(fn: Rule) -> Rule:
    """Registers a function as the rule for the operation of the same name, apart from
    underscores at the ends."""
    # The functions have an underscore in front since some names, such as `while`, are
    # keywords of Python.
    RULES[fn.__name__.strip("_")] = fn
    return fn
