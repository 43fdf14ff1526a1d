"""When a correction is small enough."""

import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree, Scalar


class Tolerance(eqx.Module):
    """A correction is measured in units of `rtol * scale + atol`, leaf by leaf. `rtol` of
    `None` stands for two units in the last place."""

    rtol: float | None
    atol: float
    norm: Callable[[PyTree], Scalar]

    def compare(
        self, sizes: PyTree[Array], scales: PyTree[Array]
    ) -> tuple[Scalar, Scalar]:
        """The size of a correction, in units of the tolerance (1 is just accepted), and
        relative to the whole iterate, from the norms of each leaf."""
        eps = jnp.finfo(jnp.result_type(*jtu.tree_leaves(sizes))).eps
        rtol = 2 * eps if self.rtol is None else self.rtol
        in_units = lambda a, b: ratio(a, rtol * b + self.atol)
        each = jtu.tree_map(in_units, sizes, scales)
        return largest(each), ratio(largest(sizes), largest(scales))

    def norms(self, *trees: PyTree[Array]) -> list[PyTree[Array]]:
        """For each of some trees of one structure, the norms of its leaves."""
        leaves = [jtu.tree_leaves(tree) for tree in trees]
        shapes = {x.shape for some in leaves for x in some}
        # One reduction for all leaves is a shorter program. Numbers need none.
        if len(shapes) == 1 and shapes != {()}:
            stacked = jnp.stack([jnp.stack(some) for some in leaves])
            return list(jax.vmap(jax.vmap(self.norm))(stacked))
        return [[self.norm(x) for x in some] for some in leaves]


def largest(norms: PyTree[Array]) -> Scalar:
    return ft.reduce(jnp.maximum, map(jnp.max, jtu.tree_leaves(norms)))


def all_finite(y: PyTree[Array]) -> Bool[Array, ""]:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(y)]))


def ratio(a: Array, b: Array) -> Array:
    """`a / b`, with `0 / 0 = 0`: no correction at all is no error at all."""
    return jnp.where(a == 0, 0, a / b)
