"""When a correction is small enough."""

import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Scalar


class Tolerance(eqx.Module):
    """A correction is measured in units of `rtol * scale + atol`, leaf by leaf. `rtol` of
    `None` stands for two units in the last place."""

    rtol: float | None
    atol: float
    norm: Callable[[PyTree], Scalar]

    def measure(self, diff: PyTree[Array], scale: PyTree[Array]) -> Scalar:
        """The size of a correction in units of the tolerance: 1 is just accepted."""
        sizes, scales = self._norms(diff, scale)
        rtol = 2 * jnp.finfo(sizes[0].dtype).eps if self.rtol is None else self.rtol
        pairs = zip(sizes, scales)
        return _largest([ratio(a, rtol * b + self.atol) for a, b in pairs])

    def relative(self, diff: PyTree[Array], scale: PyTree[Array]) -> Scalar:
        """The size of a correction relative to the whole iterate."""
        sizes, scales = self._norms(diff, scale)
        return ratio(_largest(sizes), _largest(scales))

    def _norms(self, diff, scale) -> tuple[list[Scalar], list[Scalar]]:
        norms = lambda tree: [self.norm(x) for x in jtu.tree_leaves(tree)]
        return norms(diff), norms(scale)


_largest = ft.partial(ft.reduce, jnp.maximum)


def ratio(a: Array, b: Array) -> Array:
    """`a / b`, with `0 / 0 = 0`: no correction at all is no error at all."""
    return jnp.where(a == 0, 0, a / b)
