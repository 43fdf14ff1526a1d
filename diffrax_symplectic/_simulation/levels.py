"""Levels, each with half the step of the one before, and the extrapolation from them to
step size zero."""

import dataclasses
import enum
from typing import Any

import equinox as eqx
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int

from .._products import tensordot


# Numbers of steps are 32-bit integers, which are less than this.
_STEPS_TOO_MANY = 2**31
# A single step on the first level is 2^30 steps on this many levels; one more level would
# have too many.
MOST_LEVELS = 31


class Level(eqx.Module):
    """A level: one step size for the whole solve. Or several levels, along a leading axis.

    - `index`: the number of the level, 0 for the longest step.
    - `h`: the step size.
    - `num_steps`: the number of steps.
    - `saved_steps`: the numbers of steps after which to average.
    """

    index: Int[Array | np.ndarray, "*levels"]
    h: Float[Array | np.ndarray, "*levels"]
    num_steps: Int[Array | np.ndarray, "*levels"]
    saved_steps: Int[Array | np.ndarray, "*levels saves"]


def levels_of(
    dt0: float, step_numbers: Int[np.ndarray, " saves_and_1"], levels: int, dtype: Any
) -> Level:
    """All levels, along a leading axis: each has half the step of the one before.
    `step_numbers` are those on the first level, to each saved time and last of all to the
    end. Raises a `ValueError` for too many steps."""
    if step_numbers[-1] * 2.0 ** (levels - 1) >= _STEPS_TOO_MANY:
        raise ValueError(
            f"`levels={levels}` halves `dt0` {levels - 1} times, which is more than "
            "2^31 steps. Pass fewer levels: two to four are enough to extrapolate."
        )
    index = np.arange(levels, dtype=np.int32)
    steps_in_dt0 = 2**index
    return Level(
        index=index,
        h=np.asarray(dt0 / steps_in_dt0, dtype),
        num_steps=steps_in_dt0 * step_numbers[-1],
        # (levels, saves)
        saved_steps=steps_in_dt0[:, None] * step_numbers[:-1],
    )


def halved(levels: Level) -> Level:
    """These levels with halved steps."""
    return dataclasses.replace(
        levels,
        h=levels.h / 2,
        num_steps=2 * levels.num_steps,
        saved_steps=2 * levels.saved_steps,
    )


def with_next_level(levels: Level) -> Level:
    """The levels, and one more."""
    next_levels = dataclasses.replace(halved(levels), index=levels.index + 1)

    def with_last(x: np.ndarray, next_x: np.ndarray) -> np.ndarray:
        return np.append(x, next_x[-1:], axis=0)

    return jtu.tree_map(with_last, levels, next_levels)


class Combination(enum.IntEnum):
    """The rows of `level_weights`."""

    # The mean, extrapolated to step size zero.
    BEST = 0
    # With two levels or more: the mean on the finest level minus `BEST`.
    BIAS = 1
    # `BEST` minus the extrapolation without the coarsest level.
    EXTRAPOLATION = 2
    # The same if the last extrapolation eliminated the first power of the step size only.
    # (With two levels it does.)
    BY_FIRST_POWER = 3
    # With three levels or more, there are three extrapolations from all but two
    # neighbouring levels. (Of three levels these are the means on each.) The change from
    # the second to the third of them, with finer steps:
    LAST = 4
    # The change from the first to the second.
    BEFORE = 5
    # `LAST` minus what it should be, by the order of the solver, for this `BEFORE`.
    MISS = 6


def level_weights(
    order: int | float, levels: int
) -> Float[np.ndarray, "combinations levels"]:
    r"""The combinations of the means with steps $h, h/2, h/4, \ldots$ that an
    [`diffrax_symplectic.Expectation`][] holds, for a method of weak order $p$: the rows of
    `Combination`, as far as $L$ levels have them. The first eliminates the error terms in
    $h^p, \ldots, h^{p + L - 2}$, or for $p = 1/2$ the terms in
    $h^{1/2}, \ldots, h^{(L - 1)/2}$.

    [Talay and Tubaro (1990)](https://doi.org/10.1080/07362999008809220) show that the error
    has an expansion in powers of $h$.
    """
    best = _extrapolation_weights(order, levels)
    if levels == 1:
        return best[None]
    # It eliminates one power of the step size less.
    best_without_coarsest = np.append(0.0, _extrapolation_weights(order, levels - 1))
    finest = np.eye(levels)[-1]
    change = finer_change_weights(order, levels - 1)
    by_first_power = change / (2.0**order - 1)
    rows = [best, finest - best, best - best_without_coarsest, by_first_power]
    if levels > 2:
        # Of the extrapolations from all but two neighbouring levels, of which there are
        # three.
        change = finer_change_weights(order, levels - 2)
        last_change = np.append(0.0, change)
        change_before = np.append(change, 0.0)
        # These extrapolations eliminate `levels - 3` powers of the step size. Halving the
        # step multiplies their error by 2^-power, with the first power that is left.
        power = order + levels - 3
        miss = last_change - 2.0**-power * change_before
        rows += [last_change, change_before, miss]
    return np.stack(rows)


def finer_change_weights(
    order: int | float, levels: int
) -> Float[np.ndarray, " levels_and_one"]:
    """The weights of the means on `levels` levels and one more: the extrapolation to step
    size zero from all but the coarsest, minus that from all but the finest."""
    weights = _extrapolation_weights(order, levels)
    without_coarsest = np.append(0.0, weights)
    without_finest = np.append(weights, 0.0)
    return without_coarsest - without_finest


def _extrapolation_weights(
    order: int | float, levels: int
) -> Float[np.ndarray, " levels"]:
    """The weights of the means on all levels that add up to one, and cancel the first
    `levels - 1` terms of the error."""
    # With step h / 2^k on level k, a term in h^power is multiplied by 2^(-power k). The
    # first equation, of power 0, is that the weights add up to one; the others make terms
    # of the error vanish.
    powers = np.append(0.0, order + min(order, 1) * np.arange(levels - 1))
    matrix = 2.0 ** -np.outer(powers, np.arange(levels))
    right_side = np.append(1.0, np.zeros(levels - 1))
    return np.linalg.solve(matrix, right_side)


def combinations(
    weights: Float[Array | np.ndarray, "combinations levels"],
    x: Float[Array, "levels ..."],
) -> Float[Array, "combinations ..."]:
    """The combinations, with these weights, of values on all levels."""
    return tensordot(weights.astype(x.dtype), x, 1)
