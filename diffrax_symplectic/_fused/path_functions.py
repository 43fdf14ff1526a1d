"""The functions of one path that kernels are made of, separated from the arrays that they
read. Kernels are compiled for the functions, and take the arrays as inputs.

A *system* is a PyTree whose leaves are all that a kernel reads, with the fields `terms`,
`y0` and `args` and the methods `with_args`, `init` and `step` of `_simulation.Problem`.
"""

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

    - `y`: the state of the path.
    - `solver_state`: the state of the solver.
    - `success`: whether the step succeeded.
    """

    y: Y
    solver_state: PyTree[Array]
    success: Bool[Array, ""]


class PathFunctions(NamedTuple):
    """The functions of one path of a system, which take the arrays of the system as an
    argument. Hashable: compiled kernels are kept by their `PathFunctions`, and equal ones
    have the same kernels.

    The methods have these arguments:

    - `arrays`: the arrays of the system.
    - `keys`: the random keys of the path, which replace those in the system's `terms`.
    - `own_args`: the arrays in the path's own `args`, if `args` are drawn for each path.
        Otherwise it is empty.

    The fields are:

    - `arrays`, `arrays_treedef`: the shapes and dtypes of the arrays of the system, and its
        structure with `None` for all other leaves.
    - `static`, `static_treedef`: the other leaves, such as the user's functions, and the
        structure with `None` for arrays.
    - `key`: the shape and dtype of a random key.
    - `own_args`: the shapes and dtypes of the argument `own_args` of the methods.
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

    # The programs of a kernel are traced from the methods below. These read nothing but
    # fields and arguments, so that equal `PathFunctions` have equal programs.

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
        # No solver's initial state depends on the size of the first step: any `h` serves.
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
        """The system with the `args` of a path, and the terms with the keys of the path.
        (`system.terms` keeps the keys of the system.)"""
        system = self.system(arrays)
        # With `None` the system keeps its own `args`.
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
    """Separates a system into the functions of one path, for which kernels are compiled,
    and the arrays of the system, which are inputs of the kernels.

    The functions must be hashable, since they are the key under which compiled kernels are
    kept. So they hold only the shapes and dtypes of arrays, not the values.

    - `key`: the random key from which the keys of the paths are derived.
    - `own_args`: an example of the arrays in the `args` of a path if `args` are drawn for
        each path, and otherwise `None`.
    - `paths_differ`: whether each path has its own initial state and `args`.

    Raises a `ValueError` if a key is of another random number generator than JAX's default.
    """
    # Arrays of NumPy are inputs of the kernel as well, so that a kernel serves for all
    # values of a parameter.
    arrays, static = eqx.partition(system, _is_array)
    array_leaves, arrays_treedef = jtu.tree_flatten(jtu.tree_map(jnp.asarray, arrays))
    static_leaves, static_treedef = jtu.tree_flatten(static)
    for x in [key, *array_leaves]:
        _check_generator(x)
    functions = PathFunctions(
        arrays=tuple(map(_struct, array_leaves)),
        arrays_treedef=arrays_treedef,
        static=tuple(static_leaves),
        static_treedef=static_treedef,
        key=_struct(key),
        own_args=tuple(map(_struct, jtu.tree_leaves(own_args))),
        paths_differ=paths_differ,
        # The dtype of Python's floats says whether JAX uses 64 bits.
        settings=(jax.default_backend(), jnp.result_type(float)),
    )
    return functions, array_leaves


def _is_array(x: Any) -> bool:
    return isinstance(x, jax.Array | np.ndarray)


def _check_generator(x: Array) -> None:
    """Raises a `ValueError` if `x` is a key of another generator than JAX's default."""
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    if is_key and not is_threefry(x):
        raise ValueError(
            '`engine="drjit"` has JAX\'s default generator of random numbers, '
            f"threefry2x32; got a key of `{jr.key_impl(x)}`. Pass "
            '`jax.random.key(seed)`, or `engine="jax"`.'
        )


def _struct(x: Array) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(x.shape, x.dtype)
