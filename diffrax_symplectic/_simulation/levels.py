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
# With this many levels, a single step on the first one is 2^30 steps on the last one. One
# more level would have too many steps.
MOST_LEVELS = 31


class Level(eqx.Module):
    """A level is one step size for the whole solve. A `Level` holds one level, or several
    along a leading axis.

    - `index`: the number of the level, 0 for the longest step.
    - `h`: the step size.
    - `num_steps`: the number of steps.
    - `saved_steps`: for each saved time, the number of steps from `t0` to it.
    """

    index: Int[Array | np.ndarray, "*levels"]
    h: Float[Array | np.ndarray, "*levels"]
    num_steps: Int[Array | np.ndarray, "*levels"]
    saved_steps: Int[Array | np.ndarray, "*levels saves"]


def levels_of(
    dt0: float, step_numbers: Int[np.ndarray, " saves_and_1"], levels: int, dtype: Any
) -> Level:
    """A `Level` that holds all levels. The first has steps of size `dt0`, and each other
    has half the step of the one before. `step_numbers` are the numbers of steps on the
    first level: to each saved time, and last of all to the end. Raises a `ValueError` for
    too many steps."""
    # The power of two is a float, since an integer could overflow.
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
    """The same levels with half the step each."""
    return dataclasses.replace(
        levels,
        h=levels.h / 2,
        num_steps=2 * levels.num_steps,
        saved_steps=2 * levels.saved_steps,
    )


def with_next_level(levels: Level) -> Level:
    """The same levels, and one more with half the step of the last one."""
    next_levels = dataclasses.replace(halved(levels), index=levels.index + 1)

    def with_last_of_next(x: np.ndarray, next_x: np.ndarray) -> np.ndarray:
        return np.append(x, next_x[-1:], axis=0)

    return jtu.tree_map(with_last_of_next, levels, next_levels)


class Combination(enum.IntEnum):
    """The linear combinations of the means on all levels that an
    [`diffrax_symplectic.Expectation`][] holds: the rows of `level_weights`. One level has
    only `BEST`, and two levels have the first four combinations."""

    # The mean, extrapolated to step size zero.
    BEST = 0
    # The mean on the finest level minus `BEST`.
    BIAS = 1
    # `BEST` minus the extrapolation from all levels but the coarsest.
    EXTRAPOLATION = 2
    # What `EXTRAPOLATION` would be if its last step eliminated the first power of the step
    # size from the error, and not the highest. (With two levels there is only one power.)
    BY_FIRST_POWER = 3
    # The last three combinations compare the three extrapolations from `levels - 2`
    # neighbouring levels. (With three levels, these are the means on single levels.) `LAST`
    # is the change from the second extrapolation to the third, that with the finest steps.
    LAST = 4
    # The change from the first of these extrapolations to the second.
    BEFORE = 5
    # `LAST` minus the change that the order of the solver predicts from `BEFORE`.
    MISS = 6


def level_weights(
    order: int | float, levels: int
) -> Float[np.ndarray, "combinations levels"]:
    r"""The weights of the means with steps $h, h/2, h/4, \ldots$ in each `Combination` that
    $L$ levels have, for a method of weak order $p$.

    `BEST` eliminates the error terms in $h^p, \ldots, h^{p + L - 2}$, or for $p = 1/2$ the
    terms in $h^{1/2}, \ldots, h^{(L - 1)/2}$. [Talay and Tubaro
    (1990)](https://doi.org/10.1080/07362999008809220) show that the error has an expansion
    in powers of $h$.
    """
    best = _extrapolation_weights(order, levels)
    if levels == 1:
        return best[None]
    best_without_coarsest = np.append(0.0, _extrapolation_weights(order, levels - 1))
    finest = np.eye(levels)[-1]
    # The last step of an extrapolation adds `change / (2.0**power - 1)`, where the error is
    # in proportion to h^power and `change` is the change by halving the step. In `BEST`,
    # `power` is the highest one. Here it is the first one, `order`.
    change = finer_change_weights(order, levels - 1)
    by_first_power = change / (2.0**order - 1)
    rows = [best, finest - best, best - best_without_coarsest, by_first_power]
    if levels > 2:
        # The change from an extrapolation of `levels - 2` levels to the next one.
        shorter_change = finer_change_weights(order, levels - 2)
        last_change = np.append(0.0, shorter_change)
        change_before = np.append(shorter_change, 0.0)
        # An extrapolation from `levels - 2` levels eliminates `levels - 3` powers of the
        # step size from the error. Halving the step divides what remains by 2^power, with
        # the first power that is left.
        *_, power = _powers_in_error(order, levels - 2)
        miss = last_change - 2.0**-power * change_before
        rows += [last_change, change_before, miss]
    return np.stack(rows)


def finer_change_weights(
    order: int | float, levels: int
) -> Float[np.ndarray, " levels_and_one"]:
    """The weights of the means on `levels + 1` levels in the change of an extrapolation by
    half the step: the extrapolation from all levels but the coarsest, minus that from all
    levels but the finest."""
    weights = _extrapolation_weights(order, levels)
    without_coarsest = np.append(0.0, weights)
    without_finest = np.append(weights, 0.0)
    return without_coarsest - without_finest


def _extrapolation_weights(
    order: int | float, levels: int
) -> Float[np.ndarray, " levels"]:
    """The weights of the means on all levels in the extrapolation to step size zero: they
    add up to one, and cancel the first `levels - 1` terms of the error."""
    # With step h / 2^k on level k, a term in h^power is multiplied by 2^(-power k). So the
    # weights solve, with a sum over the levels k,
    #
    #     sum_k 2^(-power k) weight_k = 1 for power 0, and 0 for the powers in the error.
    powers = np.append(0.0, _powers_in_error(order, levels - 1))
    matrix = 2.0 ** -np.outer(powers, np.arange(levels))
    right_side = np.append(1.0, np.zeros(levels - 1))
    return np.linalg.solve(matrix, right_side)


def _powers_in_error(order: int | float, count: int) -> Float[np.ndarray, " count"]:
    """The first powers of the step size in the error: they begin with the order, and rise
    by 1, or for order 1/2 by 1/2."""
    return float(order) + min(order, 1) * np.arange(count)


def combinations(
    weights: Float[Array | np.ndarray, "combinations levels"],
    x: Float[Array, "levels ..."],
) -> Float[Array, "combinations ..."]:
    """The combinations of values on all levels, with the weights of `level_weights`."""
    return tensordot(weights.astype(x.dtype), x, 1)
