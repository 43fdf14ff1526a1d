"""Steps composed of cells, so that steps of different sizes follow the same path.

A cell is an interval of fixed length that starts at a multiple of this length. The path is
drawn over each cell separately. Over a step it is composed of the paths over all cells in
the step.
"""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, PyTree

from .._compat import is_traced
from .._custom_types import RealScalarLike
from .stepwise import Increment, step_size, zeros_and_unravel


# How far the ends of a step may be from multiples of the cell, as a fraction of the cell.
# Rounding moves times by less. The ends of steps that do not consist of whole cells are
# rarely so close to multiples.
_CELL_TOLERANCE = 1e-3


class Segment(eqx.Module):
    """A segment of a Brownian path of `m` noises.

    - `h`: its length.
    - `W`: the increment over it.
    - `integral`: the integral of the path relative to its start, or `None`.
    - `A`: the Lévy areas, or `None`.
    """

    h: Float[Array, ""]
    W: Float[Array, " m"]
    integral: Float[Array, " m"] | None = None
    A: Float[Array, "m m"] | None = None

    @staticmethod
    def from_increment(increment: Increment, h: Float[Array, ""]) -> "Segment":
        """The segment of length `h` with this increment of a path, as one vector for all
        noises."""
        assert isinstance(increment, diffrax.AbstractBrownianIncrement)
        W, _ = jfu.ravel_pytree(increment.W)
        h = h.astype(W.dtype)
        if not isinstance(increment, diffrax.AbstractSpaceTimeLevyArea):
            return Segment(h, W)
        H, _ = jfu.ravel_pytree(increment.H)
        # `H` is defined as `integral / h - W / 2`.
        return Segment(h, W, integral=h * (W / 2 + H))

    @property
    def H(self) -> Float[Array, " m"]:
        """The space-time Lévy area; zero for an empty segment."""
        # Segments hold the integral instead of the area, since integrals can be added.
        assert self.integral is not None
        return self.integral / positive_or_one(self.h) - self.W / 2

    def followed_by(self, other: "Segment") -> "Segment":
        """This segment followed by another, by Chen's rule."""
        integral = A = None
        if self.integral is not None and other.integral is not None:
            # The other segment starts where this one ends. So the path over the other
            # segment, relative to the start of this segment, is higher by `self.W`.
            integral = self.integral + other.integral + self.W * other.h
        if self.A is not None and other.A is not None:
            outer = jnp.outer(self.W, other.W)
            A = self.A + other.A + (outer - outer.T) / 2
        return Segment(self.h + other.h, self.W + other.W, integral, A)

    def as_increment(
        self,
        increment_type: Any,
        shape: PyTree[jax.ShapeDtypeStruct],
        h: RealScalarLike,
        use_levy: bool,
    ) -> Increment:
        """What a path returns for a step of size `h` over this segment: with `use_levy` an
        object of type `increment_type` with `W` and the areas of the segment, otherwise `W`
        alone. `W` and `H` get the structure and shapes of `shape`."""
        _, unravel = zeros_and_unravel(shape)
        if not use_levy:
            return unravel(self.W)
        variables = {"W": unravel(self.W)}
        if self.integral is not None:
            variables["H"] = unravel(self.H)
        if self.A is not None:
            variables["A"] = self.A
        return increment_type(dt=step_size(h, shape), **variables)


def positive_or_one(h: Float[Array, ""]) -> Float[Array, ""]:
    """The length `h` of a segment as a divisor: 1 in place of 0 for an empty segment. There
    are empty steps in a batch: a path that has reached its end takes them until all paths
    have reached it."""
    return jnp.where(h > 0, h, 1)


def checked_cell(cell: float | None) -> float | None:
    """The length of a cell as a Python float, or `None` for a path without cells. Raises a
    `ValueError` unless the length is positive, finite and not traced."""
    if cell is None:
        return None
    # Paths store the length as a static field, so its value must be known while tracing.
    is_known = eqx.is_array_like(cell) and not is_traced(cell)
    if not is_known or np.ndim(cell) != 0 or not 0 < float(cell) < np.inf:
        raise ValueError(
            f"`cell` must be a positive number that is not traced, or `None`; got {cell!r}."
        )
    return float(cell)


def compose(
    t0: RealScalarLike,
    t1: RealScalarLike,
    cell: float | Float[Array | np.ndarray, ""],
    sample: Callable[[Int[Array, ""]], Segment],
    path_name: str,
) -> Segment:
    """The segment from `t0` to `t1 >= t0`, joined from its cells of length `cell`.
    `sample(i)` draws cell number `i`, which starts at `i * cell`. If the segment does not
    consist of whole cells, this raises an error when run, with the name `path_name` of the
    path's class."""
    first_cell = jnp.round(t0 / cell).astype(int)
    end_cell = jnp.round(t1 / cell).astype(int)
    # Times are sums of rounded steps, so they are only close to multiples of `cell`.
    distance_at_start = jnp.abs(first_cell * cell - t0)
    distance_at_end = jnp.abs(end_cell * cell - t1)
    distance = jnp.maximum(distance_at_start, distance_at_end)
    end_cell = eqx.error_if(
        end_cell,
        (distance > _CELL_TOLERANCE * cell) | (end_cell < first_cell),
        f"Steps of a `{path_name}` with `cell` must begin and end at multiples of `cell`. "
        "If they should, their times may have been rounded too much: enable 64 bits, or "
        "step with `diffrax.StepTo`.",
    )
    # All fields of an empty segment are zero.
    empty_segment = jtu.tree_map(jnp.zeros_like, jax.eval_shape(sample, first_cell))

    def extend(i: Int[Array, ""], segment: Segment) -> Segment:
        return segment.followed_by(sample(i))

    return lax.fori_loop(first_cell, end_cell, extend, empty_segment)
