"""What a program is traced for: a PyTree without the values of its arrays."""

import collections
import functools as ft
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu


# The most signatures that a function remembers. Each holds the user's functions.
_MOST_REMEMBERED = 128
Result = TypeVar("Result")


class Signature(NamedTuple):
    """The structure of a PyTree, the shapes and dtypes of its arrays, its other leaves, and
    settings of JAX on which a trace depends. Hashable if these leaves are.

    - `leaves`: for each leaf, its shape and dtype if it is an array, and otherwise its type
        and the leaf itself: `1`, `1.0` and `True` are equal, but not the same input.
    """

    treedef: Any
    leaves: tuple[Any, ...]
    settings: tuple[Any, ...]


def signature(tree: Any) -> Signature:
    leaves, treedef = jtu.tree_flatten(tree)
    settings = (jax.default_backend(), jnp.result_type(float))
    return Signature(treedef, tuple(map(_leaf_signature, leaves)), settings)


def _leaf_signature(leaf: Any) -> tuple[Any, ...]:
    if eqx.is_array(leaf):
        # Traces tell JAX's arrays of weak types from others.
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)
    return type(leaf), leaf


def once_for_each_signature(fn: Callable[..., Result]) -> Callable[..., Result]:
    """A function that depends on the signature of its arguments only, and is called once
    for each. Tracing anew takes longer than a short ensemble: the checks of shapes took 5
    of 11 ms for 64 paths."""
    results: collections.OrderedDict[Signature, Result] = collections.OrderedDict()

    @ft.wraps(fn)
    def call_once(*args: Any) -> Result:
        of_args = signature(args)
        try:
            is_known = of_args in results
        except TypeError:
            # A leaf cannot be hashed.
            return fn(*args)
        if not is_known:
            # If `fn` raises an error, nothing is remembered.
            results[of_args] = fn(*args)
        # The least recently used result is dropped first.
        results.move_to_end(of_args)
        if len(results) > _MOST_REMEMBERED:
            results.popitem(last=False)
        return results[of_args]

    return call_once
