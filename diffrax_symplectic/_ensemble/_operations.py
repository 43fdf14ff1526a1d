"""The table of operations that can be replayed. An elementwise operation is a line in
`_elementwise`; any other is a function with the decorator `rule`."""

from . import _control_flow, _linear_algebra, _moves  # noqa: F401 (they fill the table)
from ._elementwise import elementwise
from ._operation import Rule, RULES
from ._tensor import each


def rule_of(name: str) -> Rule | None:
    """The rule for an operation, by its name without the dialect."""
    if fn := elementwise().get(name):
        return lambda o, *xs: [each(fn, *xs)]
    return RULES.get(name)


def names() -> set[str]:
    """All operations in the table."""
    return {*elementwise(), *RULES}
