"""What `expectation` says of its steps, without samples, which take most of the time."""

from typing import Any

import jax.random as jr

from diffrax_symplectic._expectation.expectation import messages_on_steps
from diffrax_symplectic._simulation import Problem


def messages(
    phi, terms, solver, t0, t1, dt0, y0, args: Any = None, levels: int = 2
) -> list[str]:
    """The warnings of steps of a call of `expectation` with these arguments."""
    problem = Problem.of(
        phi, terms, solver, t0, t1, dt0, y0, args, None, levels, key=jr.key(0)
    )
    return messages_on_steps(problem.with_any_steps(), dt0)
