"""Paths with a control variate from value functions."""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from ..._simulation import along, Level, Motion, PathStates, Problem, simulate
from ..._terms import number_of_noises
from ..sampling import Averaged, ROUNDING, Samples
from .fits import FittedFunctions
from .noise import Noise


# The most noises of which paths are pushed to all sides: each more doubles the trials.
_MOST_NOISES = 2


class Choice(NamedTuple):
    """What is used for each time at which to average and each component of `phi`.

    - `best`: the number of the candidate.
    - `used`: whether its control variate is used, or none.
    """

    best: Int[Array | np.ndarray, "S m"]
    used: Bool[Array | np.ndarray, "S m"]


class Usual(NamedTuple):
    """What ordinary paths show, beyond which deviations are in the tails.

    - `center`: the mean without control.
    - `largest`: the largest deviation from it, or with control from the promised mean.
    """

    center: Float[Array | np.ndarray, "combinations S m"]
    largest: Float[Array | np.ndarray, "combinations S m"]


class TrialLaw(NamedTuple):
    """A law of the noise.

    - `share`: as a factor of `Noise.share`.
    - `side`: as a factor of `Noise.tilt`, for each random variable of a step.
    """

    share: Float[Array | np.ndarray, ""]
    side: Float[Array | np.ndarray, " n"]


def laws_of_trials(p: Problem) -> list[TrialLaw]:
    """The noise's own law, a wider one, and for one noise or two those in which each noise
    pushes to one side."""
    m = number_of_noises(p.terms)
    n = len(Noise.of(p, p.level(0)).laws)
    not_pushed = [0] * n
    laws = [(0, not_pushed), (1, not_pushed)]
    if m <= _MOST_NOISES:
        for sides in itertools.product((-1, 1), repeat=m):
            # The increments come first, and then variables that are only in products.
            laws.append((0, [*sides, *[0] * (n - m)]))
    return [
        TrialLaw(np.array(share, p.dtype), np.array(side, p.dtype))
        for share, side in laws
    ]


class _Control(NamedTuple):
    """The control variate of a path so far.

    - `value`: the control variate.
    - `promised`: the mean of `phi` that the functions promise at the start.
    - `log_ratio`: the log likelihood ratio of the path.
    """

    value: Float[Array, "S m"]
    promised: Float[Array, "S m"]
    log_ratio: Float[Array, ""]


def controlled_paths(
    p: Problem,
    functions: FittedFunctions,
    choice: Choice,
    usual: Usual,
    law: TrialLaw,
    keys: Key[Array, " n"],
) -> Samples:
    """A sample is a path minus the control variate of `functions` (with a leading axis of
    levels). With a wider `law` deviations beyond the `usual` ones are estimated."""
    functions = functions.chosen(choice.best)
    drawn = jax.vmap(p.drawn)(keys)

    def begin(level: Level) -> Motion:
        noise = Noise.of(p, level)
        u = jtu.tree_map(lambda x: x[level.index], functions)

        def step(i, paths):
            second = jtu.tree_map(lambda x: x[i], u.second)

            def one(y, solver_state, args, key):
                share = law.share * noise.share
                tilt = law.side * noise.tilt
                x, log_ratio = noise.draw(key, i, share, tilt)
                own = noise.with_args(args)
                at_end = lambda y1: u(i, y1)
                return own.advance(i, y, solver_state, at_end, second, x), log_ratio

            states = paths.y, paths.solver_state, paths.args
            after, log_ratio = jax.vmap(one)(*states, keys)
            # A failed path has no value, but its control must be finite.
            change = jnp.where(along(after.success, after.control), after.control, 0)
            before = paths.control
            # The mean over the first step.
            promised = jnp.where(i == 0, after.value - change, before.promised)
            control = _Control(
                before.value + jnp.where(choice.used, change, 0),
                promised,
                before.log_ratio + log_ratio,
            )
            return paths.moved(p, after.y, after.solver_state, after.success, control)

        def start(y, args):
            return noise.with_args(args).fresh(0, y)

        dtype = jax.eval_shape(lambda: u(0, p.y0)).dtype
        zero = jnp.zeros((len(keys), *p.num_outputs), dtype)
        control = _Control(zero, zero, jnp.zeros(len(keys), dtype))
        solver_state = jax.vmap(start)(*drawn)
        return Motion(step, PathStates.start(p, drawn, solver_state, control))

    done = simulate(p, begin)
    plain = done.saved
    control = jnp.swapaxes(done.control.value, 1, 2).astype(plain.dtype)
    promised = jnp.swapaxes(done.control.promised, 1, 2).astype(plain.dtype)
    # At the start itself nothing is random.
    is_at_start = along(p.levels.saved_steps[0] == 0, plain[0])
    promised = jnp.where(is_at_start, plain, promised)
    by_kind = plain - control, plain, control, promised
    left, plain, control, promised = map(p.combined, by_kind)

    center, beyond = [x[:, :, None] for x in usual]
    off = jnp.abs(left - jnp.where(choice.used[:, None], promised, center))
    # Deviations must exceed rounding.
    beyond = beyond + ROUNDING * jnp.finfo(off.dtype).eps * jnp.abs(plain)
    # Cap ratios at one: paths that are likelier without wider noise are seen without it.
    log_ratio = jnp.sum(done.control.log_ratio, axis=0)
    ratio = jnp.exp(-jnp.maximum(log_ratio, 0))[:, None]
    tails = jnp.where(off > beyond, ratio * off, 0)
    good = ~jnp.any(done.failed, axis=0)
    averaged = Averaged(
        p.shaped(left),
        plain=p.shaped(plain),
        control=p.shaped(control),
        tails=p.shaped(tails),
    )
    return Samples(averaged, good, done.failed)
