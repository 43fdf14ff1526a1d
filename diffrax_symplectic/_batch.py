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

from ._compat import captured_arrays, is_traced
from ._custom_types import IntScalarLike


_T = TypeVar("_T")

# Stragglers are gathered and served in groups of a batch's size over this number. Usually
# there are few, and each group costs its full size. When all paths computed for as long as
# any was pending, ensembles with a few hard paths took 8 to 85 times as long.
_PARTS = 256


@jax.custom_batching.custom_vmap
def most_of_batch(number: IntScalarLike) -> IntScalarLike:
    """The largest `number` over all paths of a batch, itself not batched. A loop of this
    length keeps unbatched values unbatched."""
    return number


@most_of_batch.def_vmap
def _(size, in_batched, number):
    del size
    largest = jnp.max(number, 0) if in_batched[0] else number
    # Called again, for an outer batch.
    return most_of_batch(largest), False


def batched_like(values: _T, others: PyTree) -> _T:
    """The same `values`, batched if any array in `others` is.

    JAX traces a loop again whenever one more of its values turns out to be batched, and
    nested loops again each time. Batching the initial values before the loop halves the
    time to trace `StrangGauss`.
    """
    arrays = [leaf for leaf in jtu.tree_leaves(others) if eqx.is_array(leaf)]
    # Copies, which are no operations of the program: `custom_jvp` does not convert arrays
    # of NumPy, over which a user may have batched.
    return _batched(*jtu.tree_map(jnp.array, (values, arrays)))


@jax.custom_batching.custom_vmap
def _all_or_none(values: _T, others: list[Array]) -> _T:
    del others
    return values


@_all_or_none.def_vmap
def _(size, in_batched, values, others):
    # Called only if anything is batched. Then all values are, too.
    spread = _spread(size, in_batched[0], values)
    return _all_or_none(spread, others), _all_batched(values)


def _spread(size: int, batched: PyTree[bool], values: _T) -> _T:
    """`values`, with those that are not batched repeated for each path of the batch."""

    def spread(is_batched: bool, x: Array) -> Array:
        return x if is_batched else jnp.broadcast_to(x, (size, *jnp.shape(x)))

    return jtu.tree_map(spread, batched, values)


def _all_batched(values: PyTree) -> PyTree[bool]:
    return jtu.tree_map(lambda _: True, values)


# Custom batching rules cannot be differentiated in reverse mode.
_batched = jax.custom_jvp(_all_or_none)


@_batched.defjvp
def _(primals, tangents):
    return _batched(*primals), tangents[0]


def error_if_alone(pred: Bool[Array, ""], message: str) -> Bool[Array, ""]:
    """`pred`; if it is true, an error when run. In a batch there is no error: it would stop
    the other paths."""

    @jax.custom_batching.custom_vmap
    def checked(pred):
        return eqx.error_if(pred, pred, message)

    @checked.def_vmap
    def _(size, in_batched, pred):
        del size
        return pred, in_batched[0]

    return checked(pred)


def refused_where(fault: Bool[Array, ""], advice: str) -> Bool[Array, ""]:
    """The fault, with a `ValueError` where it is known, and otherwise an error when run,
    but not in a batch."""
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
    # Trace `fn` once, here: under `vmap`, `jax.jit` would trace it again.
    call, arrays = captured_arrays(fn, value)
    # The same program for each level of nested batches.
    by_parts = jax.jit(ft.partial(_by_parts, call))

    # Each path's `own` arrays have a leading axis; `common` arrays are shared.
    @jax.custom_batching.custom_vmap
    def serve(pending, value, own, common):
        return by_parts(pending, value, own, common)

    @serve.def_vmap
    def _(size, in_batched, pending, value, own, common):
        # Nested batches are joined into one: stragglers of all of them share the groups.
        inner_size = pending.shape[1 if in_batched[0] else 0]

        def join(batched: bool, x: Array) -> Array:
            x = x if batched else jnp.broadcast_to(x, (size, *x.shape))
            return x.reshape(size * inner_size, *x.shape[2:])

        def repeat_if(batched: bool, x: Array) -> Array | None:
            return jnp.repeat(x, inner_size, axis=0) if batched else None

        def keep_unless(batched: bool, x: Array) -> Array | None:
            return None if batched else x

        def part_again(x: Array) -> Array:
            return x.reshape(size, inner_size, *x.shape[1:])

        batched_each = tuple(in_batched[:3])
        batched_common = in_batched[3]
        pending, value, own = jtu.tree_map(join, batched_each, (pending, value, own))
        # Captured arrays that the outer batch has are the inner paths' own.
        more = jtu.tree_map(repeat_if, batched_common, common)
        rest = jtu.tree_map(keep_unless, batched_common, common)
        value = serve(pending, value, eqx.combine(own, more), rest)
        return jtu.tree_map(part_again, value), _all_batched(value)

    # One path is a batch of one.
    own_arrays = jtu.tree_map(lambda _: None, arrays)
    pending, value = _with_axis((pending, value))
    return _first(serve(pending, value, own_arrays, arrays))


def _with_axis(tree: _T) -> _T:
    """The arrays as those of a batch of one."""
    return jtu.tree_map(lambda x: x[None], tree)


def _first(tree: _T) -> _T:
    """The arrays of the first path of a batch."""
    return jtu.tree_map(lambda x: x[0], tree)


def _by_parts(
    call: Callable,
    pending: Bool[Array, " size"],
    value: _T,
    own: PyTree[Array | None],
    common: PyTree[Array | None],
) -> _T:
    """`value` of a batch, with `call` applied for the paths that are `pending`. Of the
    arrays that it captures, `own` have an axis for the paths."""
    size = len(pending)
    # Rounded up, so that a small batch has groups of one.
    part = -(-size // _PARTS)

    def by_call(value: _T, own: PyTree) -> _T:
        return call(value, eqx.combine(own, common))

    def unchanged(value: _T, own: PyTree) -> _T:
        del own
        return value

    if size == 1:
        # A conditional is cheaper than a loop, and stays one: there is no batch.
        alone = _first((value, own))
        return _with_axis(lax.cond(pending[0], by_call, unchanged, *alone))

    def serve_part(carry):
        """Applies `call` for the next `part` of the paths that are pending."""
        pending, value = carry
        # Like `jnp.nonzero`, which compiles to a dozen kernels. If fewer paths are pending,
        # the surplus indices lie beyond the batch and are dropped. Unsigned indices need no
        # code for negative ones.
        flag, which = lax.top_k(pending.astype(jnp.float32), part)
        which = jnp.where(flag > 0, which, size).astype(jnp.uint32)
        gathered = jtu.tree_map(lambda x: x[which], (value, own))
        new = jax.vmap(by_call)(*gathered)

        def scatter(x: Array, y: Any) -> Array:
            return x.at[which].set(y, mode="drop")

        return scatter(pending, False), jtu.tree_map(scatter, value, new)

    def some_pending(carry):
        pending, _ = carry
        return jnp.any(pending)

    _, value = lax.while_loop(some_pending, serve_part, (pending, value))
    return value


def materialize(fn: Callable[[], _T]) -> _T:
    """`fn()`, computed once and stored.

    On CPUs, XLA may fuse a computation into every kernel that reads its result, and so
    repeat it. For Gaussian numbers and transcendental functions this costs more than it
    saves. XLA does not fuse across the boundary of a conditional, so `fn` is called in one
    branch of a conditional, and a barrier hides that the condition is always true.
    """

    # Traced once, although it is called for its shapes, in a branch, and elsewhere than on
    # CPUs. (JAX names what it traces. It prints a bound method with all that it is bound
    # to, for 50 ms each time, but not a function.)
    @jax.jit
    def once() -> _T:
        return fn()

    def in_a_conditional() -> _T:
        shapes = jax.eval_shape(once)

        def zeros() -> _T:
            return jtu.tree_map(lambda leaf: lax.full_like(leaf, 0), shapes)

        return lax.cond(lax.optimization_barrier(True), once, zeros)

    return lax.platform_dependent(cpu=in_a_conditional, default=once)
