"""Control flow for batches of paths under `vmap`: loops that all paths share, work for only
those paths that need it, and values that are computed once."""

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

# Stragglers are the paths that need more work than most. They are gathered from the batch
# and served in groups. A group has the size of the batch divided by this number, so
# that there are at most this many groups. Groups are small, since usually there are few
# stragglers, and each group costs its full size. When all paths computed for as long as any
# was pending, ensembles with a few hard paths took 8 to 85 times as long.
_MOST_GROUPS = 256


@jax.custom_batching.custom_vmap
def largest_in_batch(number: IntScalarLike) -> IntScalarLike:
    """The largest `number` over all paths of a batch. The result is not batched, so that a
    loop of this length keeps unbatched values unbatched."""
    return number


@largest_in_batch.def_vmap
def _(size, in_batched, number):
    del size
    largest = jnp.max(number, 0) if in_batched[0] else number
    # The batch may be one of several in an outer batch, each with its own largest number.
    return largest_in_batch(largest), False


def batched_like(values: _T, others: PyTree) -> _T:
    """The same `values`. Under `vmap`, all of them become batched if any array in `values`
    or `others` is.

    JAX traces a loop again whenever one more of its values turns out to be batched, and
    nested loops again each time. Batching the initial values before the loop halves the
    time to trace `StrangGauss`.
    """
    arrays = [leaf for leaf in jtu.tree_leaves(others) if eqx.is_array(leaf)]
    # `_batched_together` takes no arrays of NumPy, over which a user may have batched.
    # `jnp.array` converts them, without an operation in the program.
    return _batched_together(*jtu.tree_map(jnp.array, (values, arrays)))


@jax.custom_batching.custom_vmap
def _batched_without_derivative(values: _T, others: list[Array]) -> _T:
    """Returns `values`. Its rule for `vmap` makes all of them batched."""
    del others
    return values


@_batched_without_derivative.def_vmap
def _(size, in_batched, values, others):
    # JAX calls this rule only if anything is batched.
    are_values_batched, _ = in_batched
    repeated = _repeated(size, are_values_batched, values)
    return _batched_without_derivative(repeated, others), _all_batched(values)


def _repeated(size: int, is_batched: PyTree[bool], values: _T) -> _T:
    """`values`, with those that are not batched repeated for each path of the batch."""

    def repeat(is_batched: bool, x: Array) -> Array:
        return x if is_batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))

    return jtu.tree_map(repeat, is_batched, values)


def _all_batched(values: PyTree) -> PyTree[bool]:
    """What a batching rule returns if all `values` are batched: `True` for each."""
    return jtu.tree_map(lambda _: True, values)


# JAX cannot differentiate a custom batching rule in reverse mode. So the function has a
# rule for derivatives, too, the rule of the identity.
_batched_together = jax.custom_jvp(_batched_without_derivative)


@_batched_together.defjvp
def _(primals, tangents):
    values_dot, _ = tangents
    return _batched_together(*primals), values_dot


def error_if_alone(pred: Bool[Array, ""], message: str) -> Bool[Array, ""]:
    """Returns `pred`. If it is true, raises an error when run. Under `vmap` it only returns
    `pred`, since an error of one path would stop all others of its batch."""

    @jax.custom_batching.custom_vmap
    def checked(pred):
        return eqx.error_if(pred, pred, message)

    @checked.def_vmap
    def _(size, in_batched, pred):
        del size
        return pred, in_batched[0]

    return checked(pred)


def refused_where(fault: Bool[Array, ""], advice: str) -> Bool[Array, ""]:
    """Returns `fault`. If it is true, raises a `ValueError` with this advice. If `fault` is
    not known while tracing, it is checked when run, by `error_if_alone`."""
    if is_traced(fault):
        return error_if_alone(fault, advice)
    if fault:
        raise ValueError(advice)
    return fault


def where_pending(fn: Callable[[_T], _T], pending: Bool[Array, ""], value: _T) -> _T:
    """`fn(value)` where `pending`, and `value` elsewhere. Not differentiable.

    Under `vmap` a conditional becomes a select: all paths compute, with memory for all.
    Here only the stragglers compute, the paths that are `pending`:

    1. A single path counts as a batch of one path.
    2. Under `vmap`, the batches are joined into one batch of all paths.
    3. `_in_groups` gathers the stragglers from the batch and calls `fn` for them.
    """
    # `fn` is traced once, here: under `vmap`, `jax.jit` would trace it again.
    call, arrays = with_captured_arrays(fn, value)
    # Each level of nested batches runs the same program.
    in_groups = jax.jit(ft.partial(_in_groups, call))

    # All arguments but the last are of a batch: they have a leading axis for the paths. Of
    # the arrays that `fn` captures, `own_arrays` differ between paths, and `common_arrays`
    # are the same for all paths. Both have the structure of `arrays`, with `None` in place
    # of arrays in the other.
    @jax.custom_batching.custom_vmap
    def serve(pending, value, own_arrays, common_arrays):
        return in_groups(pending, value, own_arrays, common_arrays)

    # `vmap` adds an outer axis. Both axes become one: arrays of paths, of shape
    # `(outer, inner, ...)`, are reshaped to `(outer * inner, ...)`.
    @serve.def_vmap
    def _(outer_size, in_batched, pending, value, own_arrays, common_arrays):
        *are_paths_batched, are_common_batched = in_batched
        paths = _repeated(outer_size, are_paths_batched, [pending, value, own_arrays])
        _, inner_size = paths[0].shape

        def join_axes(x: Array) -> Array:
            return x.reshape(outer_size * inner_size, *x.shape[2:])

        def separate_axes(x: Array) -> Array:
            return x.reshape(outer_size, inner_size, *x.shape[1:])

        # A common array with the outer axis is no longer common. It is repeated for the
        # inner paths.
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

    # All captured arrays are common to the one path of its batch.
    no_own_arrays = jtu.tree_map(lambda _: None, arrays)
    pending, value = _with_axis((pending, value))
    return _first(serve(pending, value, no_own_arrays, arrays))


def _none_if_batched(is_batched: bool, x: Array) -> Array | None:
    return None if is_batched else x


def _with_axis(tree: _T) -> _T:
    """The arrays of one path as a batch of one path."""
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
    """`value` of a batch, with `call` applied for the paths that are `pending`. The loop
    takes one group of pending paths after another, until none is pending.

    The second argument of `call` consists of the `own_arrays` of a path and the
    `common_arrays`, as `where_pending` describes them."""
    size = len(pending)
    # The quotient is rounded up, so that a small batch has groups of one.
    group_size = -(-size // _MOST_GROUPS)

    def call_for_path(value: _T, own_arrays: PyTree) -> _T:
        return call(value, eqx.combine(own_arrays, common_arrays))

    def keep_value(value: _T, own_arrays: PyTree) -> _T:
        del own_arrays
        return value

    if size == 1:
        # A conditional is cheaper than a loop. It does not become a select, since there is
        # no batch.
        only_path = _first((value, own_arrays))
        return _with_axis(lax.cond(pending[0], call_for_path, keep_value, *only_path))

    def serve_group(carry):
        """Applies `call` for the next group of pending paths, which are then no longer
        pending."""
        pending, value = carry
        # The first pending paths are the largest entries of `pending` as zeros and ones.
        # (`jnp.nonzero` would find them, but compiles to a dozen kernels.)
        is_pending, first = lax.top_k(pending.astype(jnp.float32), group_size)
        # If fewer paths are pending than a group has, the others get the index `size`,
        # which is beyond the batch, so that `scatter` drops them. Unsigned indices need no
        # code for negative ones.
        indices = jnp.where(is_pending > 0, first, size).astype(jnp.uint32)
        gathered = jtu.tree_map(lambda x: x[indices], (value, own_arrays))
        values_of_group = jax.vmap(call_for_path)(*gathered)

        def scatter(x: Array, x_of_group: Any) -> Array:
            return x.at[indices].set(x_of_group, mode="drop")

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
    saves. XLA does not fuse across the boundary of a conditional. So on CPUs the result is
    `cond(True, fn, zeros)`, where a barrier hides from XLA that the condition is true.
    """

    # With `jit`, `fn` is traced once for all three uses of `once` below. (`jit(fn)` would
    # do, but JAX prints the name of what it traces, and for a bound method the whole object
    # to which the method is bound, which takes 50 ms each time.)
    @jax.jit
    def once() -> _T:
        return fn()

    def computed_in_conditional() -> _T:
        structs = jax.eval_shape(once)

        def zeros() -> _T:
            return jtu.tree_map(lambda struct: lax.full_like(struct, 0), structs)

        return lax.cond(lax.optimization_barrier(True), once, zeros)

    return lax.platform_dependent(cpu=computed_in_conditional, default=once)
