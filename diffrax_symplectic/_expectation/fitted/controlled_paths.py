"""Paths with a control variate from value functions."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Key

from ..._simulation import Level, mask_like, Motion, PathStates, Problem, simulate
from ..sampling import Averaged, Samples
from .fits import Choice, FittedFunctions
from .noise import Noise
from .tails import TrialLaw, Usual


class _Control(NamedTuple):
    """The control variate of a path so far.

    - `value`: the control variate.
    - `fitted_mean`: the mean of `phi` by the fitted functions, at the start.
    - `log_ratio`: the log likelihood ratio of the path.
    """

    value: Float[Array, "S m"]
    fitted_mean: Float[Array, "S m"]
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
    levels). With a wider `law` of the noise deviations beyond the `usual` ones are
    estimated."""
    functions = functions.chosen(choice.best)
    drawn = jax.vmap(p.draw_start)(keys)

    def begin(level: Level) -> Motion:
        noise = Noise.of(p, level)
        u = jtu.tree_map(lambda x: x[level.index], functions)
        own_law = TrialLaw(*[x[level.index] for x in law])

        def step(i, paths):
            second = jtu.tree_map(lambda x: x[i], u.second)

            def one(y, solver_state, args, key):
                x, log_ratio = noise.draw(key, i, own_law.share, own_law.tilts)
                of_path = noise.with_args(args)
                at_end = lambda y1: u(i, y1)
                after = of_path.advance(i, y, solver_state, at_end, second, x)
                return after, log_ratio

            states = paths.y, paths.solver_state, paths.args
            after, log_ratio = jax.vmap(one)(*states, keys)
            # A failed path has no value, but its control must be finite.
            change = jnp.where(
                mask_like(after.success, after.control), after.control, 0
            )
            before = paths.control
            # The mean over the first step.
            fitted_mean = jnp.where(i == 0, after.value - change, before.fitted_mean)
            control = _Control(
                before.value + jnp.where(choice.used, change, 0),
                fitted_mean,
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
    fitted_mean = jnp.swapaxes(done.control.fitted_mean, 1, 2).astype(plain.dtype)
    # At the start itself nothing is random.
    is_at_start = mask_like(p.levels.saved_steps[0] == 0, plain[0])
    fitted_mean = jnp.where(is_at_start, plain, fitted_mean)
    on_levels = plain - control, plain, control, fitted_mean
    value, plain, control, fitted_mean = map(p.combinations, on_levels)

    center = usual.center[:, :, None]
    deviations = jnp.abs(value - jnp.where(choice.used[:, None], fitted_mean, center))
    log_ratio = jnp.sum(done.control.log_ratio, axis=0)
    tails = usual.tails(deviations, plain, log_ratio)
    good = ~jnp.any(done.failed, axis=0)
    averaged = Averaged(
        p.shaped(value),
        plain=p.shaped(plain),
        control=p.shaped(control),
        tails=p.shaped(tails),
    )
    return Samples(averaged, good, done.failed)
