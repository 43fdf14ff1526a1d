"""Solvers with another root finder in all of their parts."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.tree_util as jtu

from .._root_finder import PicardNewton
from .base import AbstractImplicitStages


def with_changed_stages(solver: Any, change: Callable[[Any], Any]) -> Any:
    """The solver, with each solver in it (or itself) whose stage equations a `PicardNewton`
    solves replaced by what `change` returns for it."""

    def change_if_possible(x: Any) -> Any:
        if _is_implicit(x) and isinstance(x.root_finder, PicardNewton):
            return change(x)
        return x

    return jtu.tree_map(change_if_possible, solver, is_leaf=_is_implicit)


def has_newton(solver: Any) -> bool:
    """Whether Newton's method solves steps that the sweeps of a `PicardNewton` do not, in
    the solver or one in it."""
    parts = jtu.tree_leaves(solver, is_leaf=_is_implicit)
    finders = [x.root_finder for x in parts if _is_implicit(x)]
    return any(isinstance(x, PicardNewton) and x.newton_steps > 0 for x in finders)


def without_newton(solver: Any) -> Any:
    """The solver, and all solvers in it, with a root finder that ends after its sweeps."""

    def with_sweeps_alone(implicit_solver: Any) -> Any:
        sweeps = dataclasses.replace(implicit_solver.root_finder, newton_steps=0)
        return eqx.tree_at(lambda x: x.root_finder, implicit_solver, sweeps)

    return with_changed_stages(solver, with_sweeps_alone)


def _is_implicit(x: Any) -> bool:
    return isinstance(x, AbstractImplicitStages)
