"""Control flow for batches: loops that all paths share, work that only stragglers need, and
values that are computed once."""

import functools as ft
from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree

from ._compat import is_traced, with_captured_arrays
from ._custom_types import IntScalarLike


_T = TypeVar("_T")

# Stragglers are gathered and served in groups of the batch's size over this number, so that
# no batch has more groups. Usually there are few stragglers, and each group costs its full
# size. When all paths computed for as long as any was pending, ensembles with a few hard
# paths took 8 to 85 times as long.
_MOST_GROUPS = 256


@jax.custom_batching.custom_vmap
def largest_in_batch(number: IntScalarLike) -> IntScalarLike:
    """The largest `number` over all paths of a batch, itself not batched. A loop of this
    length keeps unbatched values unbatched."""
    return number


@largest_in_batch.def_vmap
def _(size, in_batched, number):
    del size
    largest = jnp.max(number, 0) if in_batched[0] else number
    # The function is called again, since an outer batch may have numbers, too.
    return largest_in_batch(largest), False


def batched_like(values: _T, others: PyTree) -> _T:
    """The same `values`, batched if any array in `others` is.

    JAX traces a loop again whenever one more of its values turns out to be batched, and
    nested loops again each time. Batching the initial values before the loop halves the
    time to trace `StrangGauss`.
    """
    arrays = [leaf for leaf in jtu.tree_leaves(others) if eqx.is_array(leaf)]
    # `jnp.array` makes arrays of JAX, and no operations of the program: `custom_jvp` does
    # not convert arrays of NumPy, over which a user may have batched.
    return _batched(*jtu.tree_map(jnp.array, (values, arrays)))


@jax.custom_batching.custom_vmap
def _all_or_none(values: _T, others: list[Array]) -> _T:
    del others
    return values


@_all_or_none.def_vmap
def _(size, in_batched, values, others):
    # JAX calls this rule only if anything is batched. Then all values become so.
    repeated = _repeated(size, in_batched[0], values)
    return _all_or_none(repeated, others), _all_batched(values)


def _repeated(size: int, is_batched: PyTree[bool], values: _T) -> _T:
    """`values`, with those that are not batched repeated for each path of the batch."""

    def repeat(is_batched: bool, x: Array) -> Array:
        return x if is_batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))

    return jtu.tree_map(repeat, is_batched, values)


def _all_batched(values: PyTree) -> PyTree[bool]:
    """What a batching rule returns if all `values` are batched: `True` for each."""
    return jtu.tree_map(lambda _: True, values)


# Custom batching rules cannot be differentiated in reverse mode.
_batched = jax.custom_jvp(_all_or_none)


@_batched.defjvp
def _(primals, tangents):
    return _batched(*primals), tangents[0]


def error_if_alone(pred: Bool[Array, ""], message: str) -> Bool[Array, ""]:
    """Returns `pred`, and raises an error when run if it is true. Under `vmap` nothing is
    raised, since an error of one path would stop all others of its batch."""

    @jax.custom_batching.custom_vmap
    def checked(pred):
        return eqx.error_if(pred, pred, message)

    @checked.def_vmap
    def _(size, in_batched, pred):
        del size
        return pred, in_batched[0]

    return checked(pred)


def refused_where(fault: Bool[Array, ""], advice: str) -> Bool[Array, ""]:
    """Returns `fault`. If it is true, raises a `ValueError`; or if it is not known while
    tracing, an error when run, except under `vmap`, as `error_if_alone`."""
    if is_traced(fault):
        return error_if_alone(fault, advice)
    if fault:
        raise ValueError(advice)
    return fault


def where_pending(fn: Callable[[_T], _T], pending: Bool[Array, ""], value: _T) -> _T:
    """`fn(value)` where `pending`, and `value` elsewhere. Not differentiable.

    Under `vmap` a conditional becomes a select: all paths compute, with memory for all.
    Here the stragglers (`pending` paths) are gathered from the batch and served in groups.
    """
    # `fn` is traced once, here: under `vmap`, `jax.jit` would trace it again.
    call, arrays = with_captured_arrays(fn, value)
    # Each level of nested batches runs the same program.
    in_groups = jax.jit(ft.partial(_in_groups, call))

    # Of the arrays that `fn` captures, each path has its own, with a leading axis for the
    # paths, and all paths have common ones.
    @jax.custom_batching.custom_vmap
    def serve(pending, value, own_arrays, common_arrays):
        return in_groups(pending, value, own_arrays, common_arrays)

    # Nested batches are joined into one, so that stragglers of all share the groups: arrays
    # of paths, of shape `(outer, inner, ...)`, become `(outer * inner, ...)`.
    @serve.def_vmap
    def _(outer_size, in_batched, *paths_and_common):
        # The first three arguments have an axis for the inner paths, `common_arrays` have
        # none.
        *are_paths_batched, are_common_batched = in_batched
        *inner_paths, common_arrays = paths_and_common
        paths = _repeated(outer_size, are_paths_batched, inner_paths)
        pending, _, _ = paths
        _, inner_size = pending.shape

        def join_axes(x: Array) -> Array:
            return x.reshape(outer_size * inner_size, *x.shape[2:])

        def separate_axes(x: Array) -> Array:
            return x.reshape(outer_size, inner_size, *x.shape[1:])

        # A common array that differs between the outer batches is repeated for the inner
        # ones, and is one of the paths' own.
        def own_if_batched(is_batched: bool, x: Array) -> Array | None:
            return jnp.repeat(x, inner_size, axis=0) if is_batched else None

        pending, value, own_arrays = jtu.tree_map(join_axes, paths)
        new_own_arrays = jtu.tree_map(own_if_batched, are_common_batched, common_arrays)
        joined_value = serve(
            pending,
            value,
            eqx.combine(own_arrays, new_own_arrays),
            jtu.tree_map(_none_if_batched, are_common_batched, common_arrays),
        )
        return jtu.tree_map(separate_axes, joined_value), _all_batched(value)

    # One path is a batch of one, and all captured arrays are common.
    no_own_arrays = jtu.tree_map(lambda _: None, arrays)
    pending, value = _with_axis((pending, value))
    return _first(serve(pending, value, no_own_arrays, arrays))


def _none_if_batched(is_batched: bool, x: Array) -> Array | None:
    return None if is_batched else x


def _with_axis(tree: _T) -> _T:
    """The arrays as those of a batch of one."""
    return jtu.tree_map(lambda x: x[None], tree)


def _first(tree: _T) -> _T:
    """The arrays of the first path of a batch."""
    return jtu.tree_map(lambda x: x[0], tree)


def _in_groups(
    call: Callable,
    pending: Bool[Array, " size"],
    value: _T,
    own_arrays: PyTree[Array | None],
    common_arrays: PyTree[Array | None],
) -> _T:
    """`value` of a batch, with `call` applied for the paths that are `pending`. The second
    argument of `call` are the arrays that it captures: of `own_arrays`, with an axis for
    the paths, and of `common_arrays`, without."""
    size = len(pending)
    # The quotient is rounded up, so that a small batch has groups of one.
    group_size = -(-size // _MOST_GROUPS)

    def call_for_path(value: _T, own_arrays: PyTree) -> _T:
        return call(value, eqx.combine(own_arrays, common_arrays))

    def keep_value(value: _T, own_arrays: PyTree) -> _T:
        del own_arrays
        return value

    if size == 1:
        # A conditional is cheaper than a loop, and stays one: there is no batch.
        only_path = _first((value, own_arrays))
        return _with_axis(lax.cond(pending[0], call_for_path, keep_value, *only_path))

    def serve_group(carry):
        """Applies `call` for the next group of the paths that are pending, and removes
        these from `pending`."""
        pending, value = carry
        # The first pending paths, by their numbers in the batch: the largest entries of
        # zeros and ones. (`jnp.nonzero` compiles to a dozen kernels.) If fewer paths are
        # pending than a group has, the rest of it gets the number `size`, which is beyond
        # the batch, so that `scatter` drops it. Unsigned numbers need no code for negative
        # ones.
        is_pending, numbers = lax.top_k(pending.astype(jnp.float32), group_size)
        places = jnp.where(is_pending > 0, numbers, size).astype(jnp.uint32)
        gathered = jtu.tree_map(lambda x: x[places], (value, own_arrays))
        values_of_group = jax.vmap(call_for_path)(*gathered)

        def scatter(x: Array, x_of_group: Any) -> Array:
            return x.at[places].set(x_of_group, mode="drop")

        pending = scatter(pending, False)
        return pending, jtu.tree_map(scatter, value, values_of_group)

    def any_pending(carry):
        pending, _ = carry
        return jnp.any(pending)

    _, value = lax.while_loop(any_pending, serve_group, (pending, value))
    return value


def materialize(fn: Callable[[], _T]) -> _T:
    """`fn()`, computed once and stored.

    On CPUs, XLA may fuse a computation into every kernel that reads its result, and so
    repeat it. For Gaussian numbers and transcendental functions this costs more than it
    saves. XLA does not fuse across the boundary of a conditional, so `fn` is called in one
    branch of a conditional, and a barrier hides that the condition is always true.
    """

    # `fn` is traced once, although it is called for its shapes, in a branch, and elsewhere
    # than on CPUs. (It is wrapped in a function, since JAX names what it traces, and prints
    # a bound method with all that it is bound to, for 50 ms each time.)
    @jax.jit
    def once() -> _T:
        return fn()

    def computed_in_conditional() -> _T:
        structs = jax.eval_shape(once)

        def zeros() -> _T:
            return jtu.tree_map(lambda struct: lax.full_like(struct, 0), structs)

        return lax.cond(lax.optimization_barrier(True), once, zeros)

    return lax.platform_dependent(cpu=computed_in_conditional, default=once)
