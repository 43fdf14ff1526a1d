"""Operations of StableHLO, as rules see them.

Their semantics: https://openxla.org/stablehlo/spec.
"""

import re
from collections.abc import Callable
from typing import Any, NamedTuple, TypeAlias

from .backend import array_types
from .tensor import made_here, Tensor


class Operation(NamedTuple):
    """An operation of a program. `run(i, arguments)` runs its region `i`."""

    op: Any
    run: Callable[..., list[Tensor]]
    # Masks of the lanes that raise an error. JAX simulates these paths, and raises it.
    errors: list[Any]

    @property
    def name(self) -> str:
        return self.op.name.split(".")[-1]

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.op.results[0].type.shape)

    @property
    def kind(self) -> Any:
        return self.kind_of(self.op.results[0])

    def kind_of(self, value: Any) -> Any:
        """The type of Dr.Jit arrays for a value of the program."""
        name = str(getattr(value.type, "element_type", value.type))
        if name not in array_types():
            raise NotReplayed(self.op, f"numbers of type `{name}`")
        return array_types()[name]

    def ints(self, name: str) -> list[int]:
        return [int(i) for i in self.op.attributes[name]]

    def optional(self, name: str) -> list[int]:
        return self.ints(name) if name in self.op.attributes else []

    def number(self, name: str) -> int:
        return self.op.attributes[name].value

    def word(self, name: str) -> str:
        """The value of an enumeration, such as `#stablehlo<comparison_direction LT>`."""
        return re.findall(r"\w+", str(self.op.attributes[name]))[-1]

    def shapes(self) -> list[tuple[int, ...]]:
        return [tuple(x.type.shape) for x in self.op.results]

    def recorded(self, fn: Callable, *args: Any, **kwargs: Any) -> tuple:
        """The entries that a loop or conditional returns, recorded with `fn`."""
        number = len(self.errors)
        out = fn(*args, mode="symbolic", **kwargs)
        if len(self.errors) > number:
            raise NotReplayed(
                self.op, "an error that is raised within a loop or branch"
            )
        return tuple(map(made_here, out))

    def part(self, name: str, key: str) -> list[int]:
        """An entry of an attribute such as `#stablehlo.gather<offset_dims = [0], ...>`."""
        text = str(self.op.attributes[name])
        found = re.search(rf"\b{key} = (\[[^\]]*\]|\d+)", text)
        return [int(i) for i in re.findall(r"\d+", found[1])] if found else []


class NotReplayed(Exception):
    """An operation that cannot be replayed, and which part of it."""

    def __init__(self, op: Any, what: str | None = None):
        super().__init__(what or f"`{op.name}`")
        self.location = str(op.location)


# From an operation and its operands to its results.
Rule: TypeAlias = Callable[..., list[Tensor]]
RULES: dict[str, Rule] = {}


def rule(fn: Rule) -> Rule:
    """Registers a function as the rule for the operation of the same name."""
    RULES[fn.__name__.strip("_")] = fn
    return fn
