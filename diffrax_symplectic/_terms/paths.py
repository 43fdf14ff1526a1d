"""The Brownian paths that terms hold: finding them, comparing them, and replacing them or
their random keys.

In place of a path, terms may hold only its shape, as an `UnspecifiedPath`, until it is
known which path the solver needs. A path that stands in several terms is one Brownian
motion: paths are numbered by the motion that they sample, see `motion_numbers`.
"""

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


# The first seed of paths that are made from shapes, if the terms also hold paths of the
# user's. Users make keys from small seeds as a rule, and two paths with equal keys would
# have the same noise.
_SEED_BESIDE_OTHERS = 0x5EED0000


def as_path(path: Any) -> diffrax.AbstractBrownianPath:
    """`path` itself, or an `UnspecifiedPath` if it is a shape. Raises a `ValueError` if it
    is neither."""
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
    """The terms with an `UnspecifiedPath` in each `ControlTerm` that the user gave a shape
    in place of a path."""

    def with_path(term: Any) -> Any:
        shape = not_a_path(term)
        if shape is None:
            return term
        return eqx.tree_at(lambda term: term.control, term, as_path(shape))

    return with_parts(diffrax.ControlTerm, with_path, terms)


def which_are_shapes(terms: PyTree) -> list[bool]:
    """For each Brownian path of the terms, in order, whether the terms hold its shape
    instead of the path."""
    paths = brownian_paths(shapes_as_paths(terms))
    return [isinstance(path, UnspecifiedPath) for path in paths]


def brownian_paths(terms: PyTree) -> list[diffrax.AbstractBrownianPath]:
    """The Brownian paths of the terms, in order. A path that several terms hold is listed
    for each of them."""
    return parts_of(diffrax.AbstractBrownianPath, terms)


def random_paths(terms: PyTree) -> list[diffrax.AbstractBrownianPath]:
    """Those Brownian paths of the terms that draw their noise from a random key. The shapes
    of paths count as such paths."""
    return [path for path in brownian_paths(terms) if is_random(path)]


def has_unknown_law(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether the law of the increments of a path is not known. This is so for the user's
    own classes, which need not be Brownian motions."""
    return laws_of(path) is None and not isinstance(path, UnspecifiedPath)


def motion_numbers(paths: Sequence[diffrax.AbstractBrownianPath]) -> tuple[int, ...]:
    """For each path the number of the Brownian motion that it samples, counted from 0.
    Equal paths sample the same motion. Each shape of a path is a motion of its own."""
    numbers: list[int] = []
    for path in paths:
        # `zip` ends with `numbers`, so it pairs only the earlier paths with their numbers.
        earlier = (n for n, other in zip(numbers, paths) if _are_equal(path, other))
        next_free_number = len(set(numbers))
        numbers.append(next(earlier, next_free_number))
    return tuple(numbers)


def _are_equal(
    path: diffrax.AbstractBrownianPath, other: diffrax.AbstractBrownianPath
) -> bool:
    """Whether two paths sample the same Brownian motion. Shapes of paths never do. Traced
    paths, whose values are not known, do if they hold the same array objects."""
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
    """The terms with `make_path(shape, key)` in place of each shape that stands for a path.
    The keys differ, since each shape is a Brownian motion of its own."""
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
    """The terms with new noise, derived from `key`, in each random path: one that draws its
    noise from a random key.

    - A path whose law is known, or a shape, becomes `make_path(shape, new_key)`.
    - A path whose law is unknown gets keys derived from `new_key` in place of its own.

    `numbers` are the `motion_numbers` of the random paths. Paths with the same number get
    the same new key."""
    remaining_numbers = iter(numbers)

    def new_path(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        if not is_random(path):
            return path
        number = next(remaining_numbers)
        # The first Brownian motion gets the user's key itself, so that in the usual case of
        # a single motion the same path can be made by hand.
        path_key = key if number == 0 else jr.fold_in(key, number + 1)
        if not has_unknown_law(path):
            return make_path(increment_struct(path), path_key)

        def with_new_key(x: Any) -> Any:
            return derived_key(path_key, x) if is_key(x) else x

        return jtu.tree_map(with_new_key, path)

    return replace_paths(terms, new_path)


def path_keys(terms: PyTree[diffrax.AbstractTerm], key: PRNGKeyArray) -> list[Array]:
    """New random keys, derived from `key`, one for each key in the paths of `terms`, in
    order. Equal keys get equal new keys."""
    old_keys = filter(is_key, jtu.tree_leaves(brownian_paths(terms)))
    return [derived_key(key, old_key) for old_key in old_keys]


def with_keys(terms: PyTree[diffrax.AbstractTerm], keys: list[Array]) -> PyTree:
    """The terms with `keys` in place of the random keys in their paths, in order. `keys`
    are those of `path_keys(terms, key)`."""
    remaining_keys = iter(keys)

    def with_next_keys(path: diffrax.AbstractBrownianPath) -> PyTree:
        return jtu.tree_map(lambda x: next(remaining_keys) if is_key(x) else x, path)

    return replace_paths(terms, with_next_keys)
