"""Solvers with another root finder in all of their parts."""

import dataclasses
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax.tree_util as jtu

from .._root_finder import PicardNewton
from .base import AbstractImplicitStages


def with_changed_stages(solver: Any, changed: Callable[[Any], Any]) -> Any:
    """The solver, with `changed(x)` in place of itself or of each solver `x` in it whose
    stage equations a `PicardNewton` solves."""

    def is_implicit(x: Any) -> bool:
        return isinstance(x, AbstractImplicitStages)

    def replaced(x: Any) -> Any:
        if is_implicit(x) and isinstance(x.root_finder, PicardNewton):
            return changed(x)
        return x

    return jtu.tree_map(replaced, solver, is_leaf=is_implicit)


def without_newton(solver: Any) -> Any:
    """The solver, and all solvers in it, with a root finder that ends after its sweeps."""

    def swept(x: Any) -> Any:
        sweeps = dataclasses.replace(x.root_finder, newton_steps=0)
        return eqx.tree_at(lambda stages: stages.root_finder, x, sweeps)

    return with_changed_stages(solver, swept)
