"""Steps composed of cells, so that steps of different sizes follow the same path."""

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


# The ends of a step may be this fraction of a cell away from multiples of the cell. Rounded
# times are nearer, and steps that are no multiples rarely so near.
_CELL_TOLERANCE = 1e-3


class Piece(eqx.Module):
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
    def from_increment(increment: Increment, h: Float[Array, ""]) -> "Piece":
        """The segment of length `h` with this increment."""
        assert isinstance(increment, diffrax.AbstractBrownianIncrement)
        W, _ = jfu.ravel_pytree(increment.W)
        h = h.astype(W.dtype)
        if not isinstance(increment, diffrax.AbstractSpaceTimeLevyArea):
            return Piece(h, W)
        H, _ = jfu.ravel_pytree(increment.H)
        return Piece(h, W, h * (W / 2 + H))

    @property
    def H(self) -> Float[Array, " m"]:
        """The space-time Lévy area; zero for an empty segment."""
        # A segment holds the integral, which composes by addition, and not the area.
        assert self.integral is not None
        return self.integral / positive_or_one(self.h) - self.W / 2

    def followed_by(self, other: "Piece") -> "Piece":
        """This segment followed by another, by Chen's rule."""
        integral = A = None
        if self.integral is not None and other.integral is not None:
            # Over the other segment the path is above its start there by `self.W`.
            integral = self.integral + other.integral + self.W * other.h
        if self.A is not None and other.A is not None:
            outer = jnp.outer(self.W, other.W)
            A = self.A + other.A + (outer - outer.T) / 2
        return Piece(self.h + other.h, self.W + other.W, integral, A)

    def as_increment(
        self,
        increment_type: Any,
        shape: PyTree[jax.ShapeDtypeStruct],
        h: RealScalarLike,
        use_levy: bool,
    ) -> Increment:
        """The increment over a step of size `h` for a path of this shape. With `use_levy`
        it is of type `increment_type`, with the areas of this segment."""
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
    """`h`, or 1 for an empty segment, as a divisor. In a batch, paths that have reached
    their end take empty steps until all paths have."""
    return jnp.where(h > 0, h, 1)


def checked_cell(cell: float | None) -> float | None:
    """The length of a cell as a number of Python, or `None`. Raises a `ValueError` unless
    it is positive, finite and not traced."""
    if cell is None:
        return None
    # The cell is a static field of a path, so it must be known while tracing.
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
    sample: Callable[[Int[Array, ""]], Piece],
    path_name: str,
) -> Piece:
    """The segment from `t0` to `t1 >= t0`, composed of its cells: `sample(i)` is the one
    that starts at `i * cell`. It is an error when run if the segment does not consist of
    whole cells."""
    first_cell = jnp.round(t0 / cell).astype(int)
    end_cell = jnp.round(t1 / cell).astype(int)
    distance_at_start = jnp.abs(first_cell * cell - t0)
    distance_at_end = jnp.abs(end_cell * cell - t1)
    distance = jnp.maximum(distance_at_start, distance_at_end)
    # Times are sums of rounded steps, so they meet multiples of `cell` only nearly.
    end_cell = eqx.error_if(
        end_cell,
        (distance > _CELL_TOLERANCE * cell) | (end_cell < first_cell),
        f"Steps of a `{path_name}` with `cell` must begin and end at multiples of `cell`. "
        "If they should, their times may have been rounded too much: enable 64 bits, or "
        "step with `diffrax.StepTo`.",
    )
    struct = jax.eval_shape(sample, first_cell)
    empty_piece = jtu.tree_map(lambda leaf: lax.full_like(leaf, 0), struct)

    def extend(i: Int[Array, ""], piece: Piece) -> Piece:
        return piece.followed_by(sample(i))

    return lax.fori_loop(first_cell, end_cell, extend, empty_piece)
