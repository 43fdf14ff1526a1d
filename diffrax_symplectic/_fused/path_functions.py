"""The functions of one path that kernels are made of, apart from the values they read."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, PRNGKeyArray, PyTree

from .._compat import is_threefry
from .._custom_types import Y
from .._terms import path_keys, with_keys


class Stepped(NamedTuple):
    """A path after a step.

    - `y`: its state.
    - `solver_state`: the state of its solver.
    - `success`: whether the step succeeded.
    """

    y: Y
    solver_state: PyTree[Array]
    success: Bool[Array, ""]


class PathFunctions(NamedTuple):
    """A system without the values of its arrays, as functions of these values. Hashable: it
    is what a kernel is compiled for.

    A system is a PyTree whose leaves are all that a kernel reads, with the fields `terms`,
    `y0` and `args` and the methods `with_args`, `init` and `step` of
    `_simulation.Problem`. For the random keys in `terms` each path substitutes its own.

    In these functions `arrays` are the arrays of the system. Each path has `keys` of its
    own, the words of the random keys in its terms; and if its `args` are drawn, `own_args`,
    the arrays in them, of which there are none otherwise.

    - `arrays`, `arrays_treedef`: the shapes and types of the arrays of the system, and its
        structure with `None` for all other leaves.
    - `static`, `static_treedef`: the other leaves, such as the user's functions, which are
        part of what is compiled, and the structure with `None` for arrays.
    - `key`: the shape and type of a random key.
    - `own_args`: the shapes of the arrays of `args` that each path has of its own.
    - `paths_differ`: whether each path has its own initial state and `args`.
    - `settings`: settings of JAX that programs depend on.
    """

    arrays: tuple[jax.ShapeDtypeStruct, ...]
    arrays_treedef: Any
    static: tuple[Any, ...]
    static_treedef: Any
    key: jax.ShapeDtypeStruct
    own_args: tuple[jax.ShapeDtypeStruct, ...]
    paths_differ: bool
    settings: tuple[Any, ...]

    # The programs of a kernel are traced from the methods below. All that they read is a
    # field above or an argument, so that equal `PathFunctions` have equal programs.

    def system(self, arrays: Sequence[Any]) -> PyTree:
        """The system with these arrays."""
        return eqx.combine(
            self.arrays_treedef.unflatten(arrays),
            self.static_treedef.unflatten(self.static),
        )

    def path_keys(self, arrays: Sequence[Any], key, high, low) -> list[Array]:
        """The random keys in the terms of path number `high * 2^32 + low`."""
        return path_keys(self.system(arrays).terms, sample_key(key, high, low))

    def start(
        self,
        arrays: Sequence[Any],
        keys: list[Array],
        own_args: Sequence[Any],
        y: Y,
    ) -> PyTree[Array]:
        """The state of the solver before the first step of a path from `y`."""
        system, terms = self._system_and_terms(arrays, keys, own_args)
        # Any size of the first step will do: no solver's initial state depends on it.
        h = jnp.ones((), jnp.result_type(*jtu.tree_leaves(y)))
        return system.init(terms, 0, h, y)

    def step(
        self,
        arrays: Sequence[Any],
        keys: list[Array],
        own_args: Sequence[Any],
        h: Array,
        i: Array,
        y: Y,
        solver_state: PyTree[Array],
    ) -> Stepped:
        """A path after step number `i` of size `h` from `y`."""
        system, terms = self._system_and_terms(arrays, keys, own_args)
        return Stepped(*system.step(terms, i, h, y, solver_state))

    def _system_and_terms(
        self, arrays: Sequence[Any], keys: list[Array], own_args: Sequence[Any]
    ) -> tuple[PyTree, PyTree]:
        """The system with the `args` of a path, and its terms with the keys of the path.
        (The terms within the system keep the keys of the system.)"""
        system = self.system(arrays)
        args_or_none = None
        if len(own_args) > 0:
            treedef = jtu.tree_structure(eqx.filter(system.args, eqx.is_array))
            args_or_none = jtu.tree_unflatten(treedef, own_args)
        return system.with_args(args_or_none), with_keys(system.terms, keys)


def sample_key(key: PRNGKeyArray, high, low) -> PRNGKeyArray:
    """The key of sample number `high * 2^32 + low`."""
    return jr.fold_in(jr.fold_in(key, high), low)


def functions_and_arrays(
    system: PyTree,
    key: PRNGKeyArray,
    own_args: PyTree[Array],
    paths_differ: bool,
) -> tuple[PathFunctions, list[Array]]:
    """The functions of one path, for which a kernel is compiled, and the arrays of the
    system, which the kernel reads.

    `own_args` is an example of the arrays in `args` that each path has of its own, and
    `paths_differ` says whether each has its own initial state and `args`.
    """
    for x in [key, *jtu.tree_leaves(system)]:
        if isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            if not is_threefry(x):
                raise ValueError(
                    '`engine="drjit"` has JAX\'s default generator of random numbers, '
                    f"threefry2x32; got a key of `{jr.key_impl(x)}`. Pass "
                    '`jax.random.key(seed)`, or `engine="jax"`.'
                )
    # Arrays of NumPy are inputs, too: another parameter must not need another kernel.
    arrays, static = eqx.partition(system, _is_array)
    array_leaves, arrays_treedef = jtu.tree_flatten(jtu.tree_map(jnp.asarray, arrays))
    static_leaves, static_treedef = jtu.tree_flatten(static)
    functions = PathFunctions(
        arrays=tuple(map(_struct, array_leaves)),
        arrays_treedef=arrays_treedef,
        static=tuple(static_leaves),
        static_treedef=static_treedef,
        key=_struct(key),
        own_args=tuple(map(_struct, jtu.tree_leaves(own_args))),
        paths_differ=paths_differ,
        # The type of Python's floats says whether JAX has 64 bits.
        settings=(jax.default_backend(), jnp.result_type(float)),
    )
    return functions, array_leaves


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray)


def _struct(x: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)
