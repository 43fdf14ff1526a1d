"""The Brownian paths that terms hold: which ones, with which keys, and others in their
place. Which path a solver needs is said by the solver."""

import itertools
import operator
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, PRNGKeyArray, PyTree

from .._brownian import (
    checked_shape,
    derived_key,
    increment_struct,
    is_key,
    is_random,
    laws_of,
    UnspecifiedPath,
)
from .._compat import at_trace_time, is_traced, not_a_path


# The first seed of paths made from shapes beside paths of the user's, whose keys come from
# small seeds as a rule: equal keys would give both the same noise.
_SEED_BESIDE_OTHERS = 0x5EED0000


def as_path(path: Any) -> diffrax.AbstractBrownianPath:
    """`path`, or an `UnspecifiedPath` for a shape. Otherwise raises a `ValueError`."""
    if isinstance(path, diffrax.AbstractBrownianPath):
        return path
    if _is_shape(path):
        return UnspecifiedPath(shape=checked_shape(path, "path"))
    is_class = isinstance(path, type)
    got = f"the class {path.__name__}" if is_class else f"a {type(path).__name__}"
    raise ValueError(
        "`path` must be a Brownian path, for example `solver.path((m,), key)`, or its "
        f"shape `(m,)`; got {got}. (For a system without noise pass neither `noise` nor "
        "`path`.)"
    )


def _is_shape(path: Any) -> bool:
    """Whether this is `(m,)`, or a PyTree of `jax.ShapeDtypeStruct`s."""
    if isinstance(path, tuple) and all(isinstance(n, int) for n in path):
        return True
    leaves = jtu.tree_leaves(path)
    is_struct = [isinstance(x, jax.ShapeDtypeStruct) for x in leaves]
    return len(leaves) > 0 and all(is_struct)


def shapes_as_paths(terms: PyTree) -> PyTree:
    """The terms with an `UnspecifiedPath` in each `ControlTerm` that has a shape in place
    of its path."""

    def with_path(term: Any) -> Any:
        shape = not_a_path(term) if _is_control(term) else None
        if shape is None:
            return term
        return eqx.tree_at(lambda term: term.control, term, as_path(shape))

    return jtu.tree_map(with_path, terms, is_leaf=_is_control)


def which_are_shapes(terms: PyTree) -> list[bool]:
    """For each Brownian path of the terms, in order, whether its shape stands in its
    place."""
    return [_is_unspecified(path) for path in brownian_paths(shapes_as_paths(terms))]


def brownian_paths(terms: PyTree) -> list[diffrax.AbstractBrownianPath]:
    """All Brownian paths of the terms, one for each place."""
    return [x for x in jtu.tree_leaves(terms, is_leaf=_is_path) if _is_path(x)]


def random_paths(terms: PyTree) -> list[diffrax.AbstractBrownianPath]:
    """Those Brownian paths of the terms that have a random key."""
    return [path for path in brownian_paths(terms) if is_random(path)]


def has_unknown_law(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether the law of this path is not known here, as for the user's own classes, which
    need not be Brownian motions."""
    return laws_of(path) is None and not _is_unspecified(path)


def path_numbers(paths: Sequence[diffrax.AbstractBrownianPath]) -> tuple[int, ...]:
    """The number of the Brownian motion that each path samples, counted from 0. Equal paths
    sample the same one; two shapes of paths never do."""
    found: list[diffrax.AbstractBrownianPath] = []
    numbers = []
    for path in paths:
        same = (k for k, other in enumerate(found) if _are_equal(path, other))
        numbers.append(next(same, len(found)))
        if numbers[-1] == len(found):
            found.append(path)
    return tuple(numbers)


def _are_equal(
    path: diffrax.AbstractBrownianPath, other: diffrax.AbstractBrownianPath
) -> bool:
    """Whether two paths are the same. Traced paths are if they hold the same arrays, since
    their values are not known."""
    if _is_unspecified(path):
        return False
    with at_trace_time():
        equal = eqx.tree_equal(path, other)
    if is_traced(equal):
        return all(map(operator.is_, jtu.tree_leaves(path), jtu.tree_leaves(other)))
    return bool(equal)


def replace_paths(terms: PyTree, new: Callable) -> PyTree:
    """The terms with `new(path)` in place of each Brownian path."""

    def replaced(x: Any) -> Any:
        return new(x) if _is_path(x) else x

    return jtu.tree_map(replaced, terms, is_leaf=_is_path)


def with_paths_for_shapes(terms: PyTree, make: Callable) -> PyTree:
    """The terms with `make(shape, key)` in place of each shape of a path. The keys differ:
    each shape is a Brownian motion of its own."""
    terms = shapes_as_paths(terms)
    alone = all(map(_is_unspecified, brownian_paths(terms)))
    seeds = itertools.count(0 if alone else _SEED_BESIDE_OTHERS)

    def new(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        if not isinstance(path, UnspecifiedPath):
            return path
        return make(path.shape, jr.key(next(seeds)))

    return replace_paths(terms, new)


def with_paths(
    make: Callable, numbers: tuple[int, ...], terms: PyTree, key: PRNGKeyArray
) -> PyTree:
    """The terms with new paths, made from a shape and a key. `numbers` are the
    `path_numbers` of their random paths; others are not replaced. Paths of the user's own
    classes only get other keys."""
    left = iter(numbers)

    def new(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        if not is_random(path):
            return path
        number = next(left)
        # With one Brownian motion, which is the usual case, the user's key is its key: the
        # same path can then be made by hand.
        own = key if number == 0 else jr.fold_in(key, number + 1)
        if not has_unknown_law(path):
            return make(increment_struct(path), own)
        derived = lambda x: derived_key(own, x) if is_key(x) else x
        return jtu.tree_map(derived, path)

    return replace_paths(terms, new)


def path_keys(terms: PyTree[diffrax.AbstractTerm], key: PRNGKeyArray) -> list[Array]:
    """New random keys for the paths in `terms`, derived from `key`. Paths that share a key
    get the same new one."""
    old = filter(is_key, jtu.tree_leaves(brownian_paths(terms)))
    return [derived_key(key, x) for x in old]


def with_keys(terms: PyTree[diffrax.AbstractTerm], keys: list[Array]) -> PyTree:
    """The terms with these keys, from `path_keys`, in their paths."""
    left = iter(keys)

    def rekeyed(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        return jtu.tree_map(lambda x: next(left) if is_key(x) else x, path)

    return replace_paths(terms, rekeyed)


def _is_path(x: Any) -> bool:
    return isinstance(x, diffrax.AbstractBrownianPath)


def _is_unspecified(path: Any) -> bool:
    return isinstance(path, UnspecifiedPath)


def _is_control(x: Any) -> bool:
    return isinstance(x, diffrax.ControlTerm)
