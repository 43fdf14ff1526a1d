"""The table of the operations that can be replayed. One that acts on each entry by itself
is a line in `_elementwise`; any other is a function with the decorator `rule`."""

from . import _control_flow, _moves  # noqa: F401 (they fill the table)
from ._elementwise import elementwise
from ._operation import Rule, RULES
from ._tensor import each


def rule_of(name: str) -> Rule | None:
    """The rule for the operation of this name, without that of its dialect."""
    if fn := elementwise().get(name):
        return lambda o, *xs: [each(fn, *xs)]
    return RULES.get(name)


def names() -> set[str]:
    """All of the table."""
    return {*elementwise(), *RULES}
