"""Both engines take the same paths whatever control flow a Hamiltonian has. Where Dr.Jit's
program is wrong, LLVM may abort the process: the systems run in processes of their own."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from ..drjit_here import needs_drjit
from ..families import slow_except
from .fuzz import cases


pytestmark = needs_drjit

# A process takes seconds to start, so several systems share one.
ENDS = [*range(3, len(cases()), 12), len(cases())]
QUICK, *LONG = map(range, [0, *ENDS[:-1]], ENDS)
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
    slow_except([QUICK], [QUICK, *LONG]),
    ids=lambda group: f"{group.start}-{group.stop - 1}",
)
def test_control_flow_gives_the_same_paths(group):
    apart, ended, left = {}, {}, [*group]
    while left:
        done, message = measured(left)
        apart |= done
        left = left[len(done) :]
        if left:
            ended[left.pop(0)] = message
    assert not ended
    assert {number: ulps for number, ulps in apart.items() if ulps > ULPS} == {}
