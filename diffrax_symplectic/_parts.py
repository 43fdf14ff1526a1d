"""The parts of a PyTree that are of some class, such as the Brownian paths in terms."""

import functools as ft
from collections.abc import Callable
from typing import Any, TypeVar

import jax.tree_util as jtu
from jaxtyping import PyTree


_T = TypeVar("_T")
_Tree = TypeVar("_Tree", bound=PyTree)


def parts_of(kind: type[_T] | tuple[type[_T], ...], tree: PyTree) -> list[_T]:
    """All parts of this class in a PyTree. One that occurs twice is returned twice. Parts
    within other parts are not returned."""
    is_part = ft.partial(_is_instance, kind)
    return [x for x in jtu.tree_leaves(tree, is_leaf=is_part) if is_part(x)]


def with_parts(
    kind: type[_T] | tuple[type[_T], ...], new_part: Callable[[_T], Any], tree: _Tree
) -> _Tree:
    """The PyTree with `new_part(part)` in place of each part of this class."""
    is_part = ft.partial(_is_instance, kind)

    def replace(x: Any) -> Any:
        return new_part(x) if is_part(x) else x

    return jtu.tree_map(replace, tree, is_leaf=is_part)


def _is_instance(kind: Any, x: Any) -> bool:
    return _is_subclass(type(x), kind)


# `isinstance(x, kind)` reads `x.__class__`, which takes a microsecond for a Module, and a
# call of `expectation` asks for some thousand Modules. So the answers are kept by class.
@ft.lru_cache(maxsize=1024)
def _is_subclass(kind_of_x: type, kind: Any) -> bool:
    return issubclass(kind_of_x, kind)
