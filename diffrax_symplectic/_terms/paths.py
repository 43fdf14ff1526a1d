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
from .._parts import parts_of, with_parts


# The first seed of paths made from shapes beside paths of the user's, whose keys come from
# small seeds as a rule: equal keys would give both the same noise.
_SEED_BESIDE_OTHERS = 0x5EED0000


def as_path(path: Any) -> diffrax.AbstractBrownianPath:
    """`path`, or an `UnspecifiedPath` for a shape. Otherwise raises a `ValueError`."""
    if isinstance(path, diffrax.AbstractBrownianPath):
        return path
    is_tuple = isinstance(path, tuple) and all(isinstance(n, int) for n in path)
    leaves = jtu.tree_leaves(path)
    are_structs = all(isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves)
    if is_tuple or (len(leaves) > 0 and are_structs):
        return UnspecifiedPath(shape=checked_shape(path, "path"))
    if isinstance(path, type):
        got = f"the class {path.__name__}"
    elif isinstance(path, int):
        got = f"{path}, for which write `({path},)`"
    else:
        got = f"a {type(path).__name__}"
    raise ValueError(
        "`path` must be a Brownian path, for example `solver.path((m,), key)`, or its "
        f"shape `(m,)`; got {got}. (For a system without noise pass neither `noise` nor "
        "`path`.)"
    )


def shapes_as_paths(terms: PyTree) -> PyTree:
    """The terms with an `UnspecifiedPath` in each `ControlTerm` that has a shape in place
    of its path."""

    def with_path(term: Any) -> Any:
        shape = not_a_path(term)
        if shape is None:
            return term
        return eqx.tree_at(lambda term: term.control, term, as_path(shape))

    return with_parts(diffrax.ControlTerm, with_path, terms)


def which_are_shapes(terms: PyTree) -> list[bool]:
    """For each Brownian path of the terms, in order, whether the terms hold its shape
    instead of the path."""
    return [
        isinstance(x, UnspecifiedPath) for x in brownian_paths(shapes_as_paths(terms))
    ]


def brownian_paths(terms: PyTree) -> list[diffrax.AbstractBrownianPath]:
    """All Brownian paths of the terms, one for each place."""
    return parts_of(diffrax.AbstractBrownianPath, terms)


def random_paths(terms: PyTree) -> list[diffrax.AbstractBrownianPath]:
    """The Brownian paths of the terms that draw their noise from a random key, and the
    shapes of paths."""
    return [path for path in brownian_paths(terms) if is_random(path)]


def has_unknown_law(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether the law of this path is not known here, as for the user's own classes, which
    need not be Brownian motions."""
    return laws_of(path) is None and not isinstance(path, UnspecifiedPath)


def motion_numbers(paths: Sequence[diffrax.AbstractBrownianPath]) -> tuple[int, ...]:
    """The number of the Brownian motion that each path samples, counted from 0. Equal paths
    sample the same one; two shapes of paths never do."""
    numbers: list[int] = []
    for path in paths:
        matches = (n for n, other in zip(numbers, paths) if _are_equal(path, other))
        numbers.append(next(matches, max(numbers, default=-1) + 1))
    return tuple(numbers)


def _are_equal(
    path: diffrax.AbstractBrownianPath, other: diffrax.AbstractBrownianPath
) -> bool:
    """Whether two paths are the same. The values of traced paths are not known: these are
    the same if they hold the same arrays."""
    if isinstance(path, UnspecifiedPath):
        return False
    with at_trace_time():
        equal = eqx.tree_equal(path, other)
    if is_traced(equal):
        return all(map(operator.is_, jtu.tree_leaves(path), jtu.tree_leaves(other)))
    return bool(equal)


def replace_paths(terms: PyTree, new_path: Callable) -> PyTree:
    """The terms with `new_path(path)` in place of each Brownian path."""
    return with_parts(diffrax.AbstractBrownianPath, new_path, terms)


def with_paths_for_shapes(terms: PyTree, make_path: Callable) -> PyTree:
    """The terms with `make_path(shape, key)` in place of each shape of a path. The keys
    differ: each shape is a Brownian motion of its own."""
    terms = shapes_as_paths(terms)
    has_only_shapes = all(which_are_shapes(terms))
    seeds = itertools.count(0 if has_only_shapes else _SEED_BESIDE_OTHERS)

    def new_path(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        if not isinstance(path, UnspecifiedPath):
            return path
        return make_path(path.shape, jr.key(next(seeds)))

    return replace_paths(terms, new_path)


def with_paths(
    make_path: Callable, numbers: tuple[int, ...], terms: PyTree, key: PRNGKeyArray
) -> PyTree:
    """The terms with `make_path(shape, key)` in place of each random path. `numbers` are
    the `motion_numbers` of the random paths: those with the same number get the same key.
    Paths of the user's own classes only get other keys."""
    remaining_numbers = iter(numbers)

    def new_path(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        if not is_random(path):
            return path
        number = next(remaining_numbers)
        # With one Brownian motion, which is the usual case, the user's key is its key: the
        # same path can then be made by hand.
        path_key = key if number == 0 else jr.fold_in(key, number + 1)
        if not has_unknown_law(path):
            return make_path(increment_struct(path), path_key)

        def with_new_key(x: Any) -> Any:
            return derived_key(path_key, x) if is_key(x) else x

        return jtu.tree_map(with_new_key, path)

    return replace_paths(terms, new_path)


def path_keys(terms: PyTree[diffrax.AbstractTerm], key: PRNGKeyArray) -> list[Array]:
    """New random keys for the paths in `terms`, derived from `key`. Paths that share a key
    get the same new one."""
    old_keys = filter(is_key, jtu.tree_leaves(brownian_paths(terms)))
    return [derived_key(key, old_key) for old_key in old_keys]


def with_keys(terms: PyTree[diffrax.AbstractTerm], keys: list[Array]) -> PyTree:
    """The terms with these keys, from `path_keys`, in their paths."""
    remaining_keys = iter(keys)

    def with_next_keys(path: diffrax.AbstractBrownianPath) -> PyTree:
        return jtu.tree_map(lambda x: next(remaining_keys) if is_key(x) else x, path)

    return replace_paths(terms, with_next_keys)
