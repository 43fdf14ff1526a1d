"""When a correction is small enough."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PyTree, Scalar


class Tolerance(eqx.Module):
    """A correction is measured in units of `rtol * scale + atol`, leaf by leaf. `rtol` of
    `None` stands for two units in the last place."""

    rtol: float | None
    atol: float
    norm: Callable[[PyTree], Scalar]

    def measure(
        self, diff: PyTree[Array], scale: PyTree[Array]
    ) -> tuple[Scalar, Scalar]:
        """The size of a correction, in units of the tolerance (1 is just accepted), and
        relative to the whole iterate."""
        return self.compare(*self.norms(diff, scale))

    def compare(
        self, sizes: Float[Array, " leaves"], scales: Float[Array, " leaves"]
    ) -> tuple[Scalar, Scalar]:
        """The same from the norms of each leaf."""
        rtol = 2 * jnp.finfo(sizes.dtype).eps if self.rtol is None else self.rtol
        each = ratio(sizes, rtol * scales + self.atol)
        return jnp.max(each), ratio(jnp.max(sizes), jnp.max(scales))

    def norms(self, *trees: PyTree[Array]) -> Float[Array, "trees leaves"]:
        """The norm of each leaf of trees of one structure."""
        leaves = [x for tree in trees for x in jtu.tree_leaves(tree)]
        if len({x.shape for x in leaves}) == 1:
            norms = jax.vmap(self.norm)(jnp.stack(leaves))
        else:
            norms = jnp.stack([self.norm(x) for x in leaves])
        return norms.reshape(len(trees), -1)


def ratio(a: Array, b: Array) -> Array:
    """`a / b`, with `0 / 0 = 0`: no correction at all is no error at all."""
    return jnp.where(a == 0, 0, a / b)
