"""The table of operations that can be replayed. An elementwise operation is a line in
`elementwise` or `complex`; any other is a function with the decorator `rule`."""

from typing import Any

from . import (  # noqa: F401 (they fill the table)
    control_flow,
    linear_algebra,
    moves,
    reductions,
    windows,
)
from .angles import too_large
from .complex import complex_functions, is_complex
from .elementwise import elementwise
from .operation import NotReplayed, Operation, Rule, RULES
from .tensor import each, same_table, Tensor


def rule_of(name: str) -> Rule | None:
    """The rule for an operation, by its name without the dialect."""
    of_real = elementwise().get(name)
    of_complex = complex_functions().get(name)
    if of_real is None and of_complex is None:
        return RULES.get(name)

    def entry_by_entry(o: Operation, *xs: Tensor) -> list[Tensor]:
        if name == "select" and same_table(xs[1], xs[2]):
            # As in `vmap` of a conditional: a table stays in memory.
            return [xs[1]]
        # Of a selection the first operand is not complex.
        pairs = any(is_complex(x.entries[0]) for x in xs)
        function = of_complex if pairs else of_real
        if function is None:
            raise NotReplayed(o.op, f"`{o.op.name}` of complex numbers")

        def checked(*entries: Any) -> Any:
            # JAX has sines and cosines of all angles: it gets such paths.
            lost = too_large(name, *entries)
            if lost is not None:
                o.fail(lost)
            return function(*entries)

        return [each(checked, *xs)]

    return entry_by_entry


def names() -> set[str]:
    """All operations in the table."""
    return {*elementwise(), *complex_functions(), *RULES}
