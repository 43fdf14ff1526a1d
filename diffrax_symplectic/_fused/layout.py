"""Splits a problem into what a fused kernel is compiled for and what it reads."""

import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from .._expectation.problem import Level, Problem
from .._terms import path_keys, with_keys
from .sweeps import without_rescue


class Layout(NamedTuple):
    """What a kernel is compiled for: a `Problem` without the values of its arrays, the
    implementation of random keys, and settings of JAX. Hashable."""

    treedef: Any
    static: tuple[Any, ...]
    structs: tuple[jax.ShapeDtypeStruct | None, ...]
    impl: str
    # The shapes of the arrays of `args` that each path has of its own, and whether each has
    # its own `y0`, too.
    own_args: tuple[jax.ShapeDtypeStruct, ...]
    paths_differ: bool
    settings: tuple[Any, ...]

    @property
    def arrays(self) -> list[jax.ShapeDtypeStruct]:
        return [s for s in self.structs if s is not None]

    @property
    def key(self) -> Any:
        return jax.eval_shape(lambda: jr.key(0, impl=self.impl))

    def problem(self, arrays: Sequence[Any]) -> Problem:
        left = iter(arrays)
        pairs = zip(self.static, self.structs)
        leaves = [x if s is None else next(left) for x, s in pairs]
        return self.treedef.unflatten(leaves)

    # The programs, each for one path

    def path_keys(self, arrays: list[Array], key, hi, lo) -> list[Array]:
        return path_keys(self.problem(arrays).terms, sample_key(key, hi, lo))

    def of_path(self, arrays: list[Array], own: list[Array]) -> tuple[Problem, PyTree]:
        """The problem and the terms of a path, from its keys and its own `args`."""
        p = self.problem(arrays)
        keys, args = own[: len(own) - len(self.own_args)], None
        if self.own_args:
            args = eqx.filter(p.args, eqx.is_array)
            args = jtu.tree_unflatten(jtu.tree_structure(args), own[len(keys) :])
        return p.with_args(args), with_keys(p.terms, keys)

    def start(self, arrays: list[Array], own: list[Array], y: list) -> list:
        """The leaves of the state of the solver at the start."""
        p, terms = self.of_path(arrays, own)
        y = jtu.tree_unflatten(jtu.tree_structure(p.y0), y)
        return jtu.tree_leaves(p.init(terms, 0, p.levels.h[0], y))

    def step(self, arrays, own, h, i, y: list, state: list):
        """The leaves after step number `i` of size `h`, and whether it succeeded."""
        p, terms = self.of_path(arrays, own)
        likes = p.y0, eqx.filter_eval_shape(p.init, terms, 0, h, p.y0)
        y, state = (
            jtu.tree_unflatten(jtu.tree_structure(like), x)
            for like, x in zip(likes, (y, state))
        )
        y, state, success = p.step(terms, i, h, y, state)
        return jtu.tree_leaves(y), jtu.tree_leaves(state), success


def sample_key(key: PRNGKeyArray, hi, lo) -> PRNGKeyArray:
    """The key of sample number `hi * 2^32 + lo`."""
    return jr.fold_in(jr.fold_in(key, hi), lo)


def split(problem: Problem, key: PRNGKeyArray) -> tuple[Layout, list[Array]]:
    """The layout and the arrays of a problem. Its root finders become plain sweeps, and the
    step size, times and numbers of steps are left out: they are inputs of the kernel."""
    none = jnp.zeros(1, jnp.int32)
    bare = dataclasses.replace(
        problem,
        solver=without_rescue(problem.solver),
        y0_of=None,
        args_of=None,
        levels=Level(none, jnp.ones_like(problem.levels.h[:1]), none, none[None]),
        weights=jnp.ones((1, 1)),
        at_end=True,
        max_steps=1,
    )
    is_array = lambda x: isinstance(x, jax.Array | np.ndarray)
    leaves, treedef = jtu.tree_flatten(bare)
    arrays = [jnp.asarray(x) if is_array(x) else None for x in leaves]
    static = tuple(None if is_array(x) else x for x in leaves)
    struct = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype)
    settings = jax.default_backend(), jax.config.read("jax_enable_x64")
    impl = str(jr.key_impl(key))
    own = None if problem.args_of is None else eqx.filter(problem.args, eqx.is_array)
    layout = Layout(
        treedef,
        static,
        tuple(None if x is None else struct(x) for x in arrays),
        impl,
        tuple(jtu.tree_leaves(jax.eval_shape(lambda: own))),
        problem.paths_differ,
        settings,
    )
    return layout, [x for x in arrays if x is not None]
