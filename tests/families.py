"""Parameters of tests that run for every member of a family."""

from collections.abc import Collection, Iterable
from typing import Any

import pytest


def slow_except(quick: Collection, members: Iterable) -> list[Any]:
    """The `members` as parameters of a test. Those that are not `quick` are marked slow."""
    return [
        member if member in quick else pytest.param(member, marks=pytest.mark.slow)
        for member in members
    ]
