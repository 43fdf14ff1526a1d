"""The drift of a system whose positions are constrained."""

from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree

from .._arguments import check_takes
from .._custom_types import Args
from .._parts import parts_of, with_parts
from .callers import AbstractCaller


_T = TypeVar("_T")
Constraint = Callable[[PyTree, Args], Float[Array, " c"]]

# The advice of every error. These two solvers find the multipliers of a constraint.
KEEP = (
    "Use `StormerVerlet()`, or for the terms of `langevin_terms` `BAOAB()`: they keep the "
    "constraint to rounding"
)


class ConstrainedDrift(diffrax.AbstractTerm, AbstractCaller):
    """The drift of Hamiltonians for positions with `constraint(q, args) = 0`.

    Its vector field depends on multipliers, which only some solvers find. Those solvers
    read `drift` and `constraint`. All other solvers, also those of Diffrax, ask for the
    product of the vector field with the length of a step, which raises an error.
    """

    drift: diffrax.AbstractTerm
    constraint: Constraint

    def __check_init__(self):
        check_takes("constraint", self.constraint, "q", "args")

    def called_with(self, t, y, args):
        _, q = y
        return {"constraint": (q, args)}

    def vf(self, t, y, args) -> PyTree[Array]:
        # An error here would come before any solve, also of the solvers that find the
        # multipliers: Diffrax looks at the structure of the vector field. Its values must
        # not be used, hence NaN.
        return jtu.tree_map(lambda x: jnp.full_like(x, jnp.nan), y)

    def contr(self, t0, t1, **kwargs) -> Any:
        return self.drift.contr(t0, t1, **kwargs)

    def prod(self, vf, control) -> NoReturn:
        raise ValueError(
            "These terms are constrained, and cannot be solved without multipliers. "
            f"{KEEP}."
        )


def with_constraint(
    drift: diffrax.AbstractTerm, constraint: Constraint | None
) -> diffrax.AbstractTerm:
    """The drift with its constraint, if there is one."""
    return drift if constraint is None else ConstrainedDrift(drift, constraint)


def constraint_of(terms: PyTree[diffrax.AbstractTerm]) -> Constraint | None:
    """The constraint of these terms, if there is one. Raises a `ValueError` if there are
    several."""
    # `parts_of` also looks into a `MultiTerm`, and into Diffrax's wrapper for the direction
    # of time.
    constraints = [term.constraint for term in parts_of(ConstrainedDrift, terms)]
    # The multipliers of all constraints belong to one equation: a step that keeps one
    # constraint would leave the other.
    if len(constraints) > 1:
        raise ValueError(
            f"Only one of the terms may be constrained; got {len(constraints)}. Return all "
            "constraints from one function, as one array of shape `(c,)`."
        )
    return constraints[0] if len(constraints) > 0 else None


def without_constraint(terms: _T) -> _T:
    """The same terms without their constraint, if they have one."""
    return with_parts(ConstrainedDrift, lambda term: term.drift, terms)


def check_unconstrained(terms: PyTree[diffrax.AbstractTerm], caller_name: str) -> None:
    """Raises a `ValueError` if the terms have a constraint."""
    if constraint_of(terms) is not None:
        raise ValueError(f"`{caller_name}` takes no constrained terms. {KEEP}.")
