"""Both engines take the same paths whatever a Hamiltonian is made of. Where a program of
Dr.Jit is wrong, LLVM may abort the process: the systems run in processes of their own."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ..drjit_here import needs_drjit
from ..families import slow_except
from .fuzz import NUM_CASES


pytestmark = needs_drjit

# A process takes seconds to start, so several systems share one.
GROUPS = [range(0, 2)] + [
    range(begin, min(begin + 9, NUM_CASES)) for begin in range(2, NUM_CASES, 9)
]
# Four steps; units in the last place of the largest number.
ULPS = 32


def measured(numbers: list[int]) -> tuple[dict[int, float], str]:
    """How far the engines are apart, up to the first system that ends the process; and
    what the process wrote last."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.fused.fuzz", *map(str, numbers)],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        timeout=600,
    )
    return dict(map(json.loads, done.stdout.splitlines())), done.stderr[-300:]


@pytest.mark.parametrize(
    "group",
    slow_except(GROUPS[:1], GROUPS),
    ids=lambda group: f"{group.start}-{group.stop - 1}",
)
def test_systems_of_all_parts_have_the_same_paths(group):
    apart, ended, left = {}, {}, [*group]
    while left:
        done, message = measured(left)
        apart |= done
        left = left[len(done) :]
        if left:
            ended[left.pop(0)] = message
    assert not ended
    assert {number: ulps for number, ulps in apart.items() if ulps > ULPS} == {}
