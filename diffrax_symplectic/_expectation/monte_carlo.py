"""Crude Monte Carlo: averages over independent paths, or of a function of a random key."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree

from .._arguments import check_real, check_takes, whole_number
from .._root_finder import all_finite
from .._terms import path_keys, with_keys
from ._problem import Problem
from ._run import checked_call, Meter, NO_METER, run
from ._steps import independent_steps, simulate
from .estimate import Expectation
from .moments import level_weights
from .polynomials import tensordot
from .sampling import AbstractSampling, Plan, real, Samples


class IndependentPaths(AbstractSampling):
    """Independent paths (crude Monte Carlo). For any system the error is proportional to
    one over the square root of their number.

    With several levels, each path uses the same Brownian motion on all of them if `terms`
    have a [`diffrax_symplectic.FixedStepBrownianPath`][] with `cell=`. Then the `bias` is
    estimated much more accurately than the mean.

    **Arguments:**

    - `num_paths`: the number of paths, at least two; with `tol` an upper limit.
    - `batch_size`: the number of paths that each device solves at once. By default 32,768
        on CPUs (for a state of a few components this keeps all cores busy and fits their
        caches) and 262,144 elsewhere. Choose less for large states, or to share few paths
        among several devices: the size of a batch does not depend on their number.
    """

    num_paths: int = eqx.field(converter=lambda x: whole_number("num_paths", x, 2))
    batch_size: int | np.integer | None = None

    def prepare(self, problem, key, devices):
        return self.plan(jtu.Partial(_paths, problem), devices)

    def plan(self, sampler: Callable, devices: tuple) -> Plan:
        if self.batch_size is None:
            size = 32768 if devices[0].platform == "cpu" else 262144
        else:
            size = whole_number("batch_size", self.batch_size)
        return Plan(sampler, self.num_paths, size)


def _paths(p: Problem, keys: PRNGKeyArray) -> Samples:
    """A sample is a path, with the same random key on all levels."""
    own = jax.vmap(lambda key: path_keys(p.terms, key))(keys)
    drawn = jax.vmap(p.drawn)(keys)
    terms_of = lambda keys: with_keys(p.terms, keys)
    begin = lambda level: independent_steps(p, level, drawn, terms_of, lambda i: own)
    saved, failed, _ = simulate(p, begin)
    # A path that fails on several levels counts once.
    lost = jnp.any(failed, axis=0)
    return Samples(p.averaged([p.combined(saved)]), ~lost, lost)


def monte_carlo(
    fn: Callable[..., Any],
    *,
    key: PRNGKeyArray,
    num_paths: int | np.integer,
    batch_size: int | np.integer | None = None,
    levels: int = 1,
    order: float | None = None,
    tol: float | None = None,
    start: Expectation | None = None,
    first: int = 0,
    devices: Sequence[Any] | None = None,
    progress_meter: diffrax.AbstractProgressMeter = NO_METER,
) -> Expectation:
    r"""Averages any function of a random key, typically one that solves for a path.

    For functions of the state at given times, [`diffrax_symplectic.expectation`][] is
    simpler and needs far fewer paths. Use `monte_carlo` for everything else: events,
    gradients, functions of whole paths.

    !!! example

        ```python
        import diffrax
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H = lambda t, p, q, args: (p**2 + q**2) / 2
        y0 = (jnp.array(0.0), jnp.array(1.0))

        def phi(key):
            terms = ds.hamiltonian_terms(H, H, ds.WeakBrownianPath((), key))
            sol = diffrax.diffeqsolve(
                terms, ds.SRKw1(), t0=0, t1=1, dt0=0.1, y0=y0, throw=False
            )
            p, q = sol.ys
            return q[-1] ** 2, sol.result

        estimate = ds.monte_carlo(phi, key=jr.key(0), num_paths=10_000)
        print(estimate.mean, estimate.std_error, estimate.num_failed)
        ```

    Each new `fn` is compiled anew. For many values of a parameter, pass one function with
    the parameter as an array: `jax.tree_util.Partial(fn, parameter)`. To differentiate an
    expectation, call `jax.grad` inside `fn`: the mean of the gradients is the gradient of
    the mean. On several devices the solve then needs the adjoint `diffrax.DirectAdjoint()`
    or `diffrax_symplectic.ReversingAdjoint()`. `monte_carlo` itself runs outside JAX
    transformations: it cannot be differentiated, `jit`ted or `vmap`ped.

    **Levels.** With `levels=2` (3, ...) and `order=p` the function is `fn(key, level)`,
    which solves with step $h$ on level 0, $h/2$ on level 1, and so on. `mean` is
    extrapolated to step size zero. If all levels use the same Brownian motion, by `cell=`
    of [`diffrax_symplectic.FixedStepBrownianPath`][], then `bias` (the discretization error
    of the finest level) is estimated much more accurately than the mean.

    **Arguments:**

    - `fn`: maps a random key to $\phi$, a PyTree of real arrays, or to a pair of $\phi$
        and a `diffrax.RESULTS`, as above with `throw=False`. A path fails if its result is
        neither successful nor an event, or if anything in its $\phi$ is not finite. With
        `throw=False` always return `sol.result`: otherwise a failed path counts as a
        success, with the state at which it stopped.
    - `num_paths`: the total number of paths, including the paths of `start`.
    - `batch_size`: as for [`diffrax_symplectic.IndependentPaths`][].
    - `levels`: the number of step sizes.
    - `order`: with several levels, the weak order $p$ of the solver for these terms, as
        returned by `solver.weak_order(terms)`; or 1/2 for first-passage times.
    - `key`, `tol`, `start`, `first`, `devices`, `progress_meter`: as for
        [`diffrax_symplectic.expectation`][].

    **Returns:** an [`diffrax_symplectic.Expectation`][].

    **Raises:** as [`diffrax_symplectic.expectation`][]; a `ValueError` for several levels
    without `order`, or if $\phi$ contains a `diffrax.RESULTS`. Warns if all samples are
    equal, as they are if `fn` does not use its key.
    """
    key, first, devices = checked_call("monte_carlo", key, tol, start, first, devices)
    levels = whole_number("levels", levels)
    if levels > 1 and order is None:
        raise ValueError(
            "Several `levels` need `order=`, the weak order of the solver; got "
            f"levels={levels!r} and order=None."
        )
    check_takes("fn", fn, *(["key"] if levels == 1 else ["key", "level"]))
    # Of events that are checked at the end of a step.
    is_half = isinstance(order, float) and order == 0.5
    is_whole = isinstance(order, int | np.integer) and order >= 1
    if order is not None and not (is_half or is_whole):
        raise ValueError(f"`order` must be a positive integer, or 1/2; got {order!r}.")
    sampling = IndependentPaths(num_paths, batch_size)
    sampler = jtu.Partial(_of_function, fn, level_weights(float(order or 1), levels))
    plan = sampling.plan(sampler, devices)
    with Meter(progress_meter) as meter:
        return run(plan, key, devices, sampling, start, first, tol, meter)


def _of_function(fn: Callable, weights: np.ndarray, keys: PRNGKeyArray) -> Samples:
    at = lambda level: lambda key: fn(key, level)
    levels = weights.shape[1]
    fns = [fn] if levels == 1 else [at(level) for level in range(levels)]
    each = [jax.vmap(lambda key: _evaluate(fn, key))(keys) for fn in fns]
    values, good = jtu.tree_map(lambda *xs: jnp.stack(xs), *each)
    combined = lambda x: tensordot(weights.astype(x.dtype), x, 1)[None]
    lost = ~jnp.all(good, axis=0)
    return Samples(jtu.tree_map(combined, values), ~lost, lost)


def _evaluate(fn: Callable, key) -> tuple[PyTree[Array], Array]:
    """The $\\phi$ that `fn` returns, and whether the path succeeded."""
    out, success = fn(key), jnp.array(True)
    is_pair = isinstance(out, tuple) and len(out) == 2
    if is_pair and isinstance(out[1], diffrax.RESULTS):
        out, result = out
        success = diffrax.is_okay(result)
    # The type of the results of all packages.
    is_result = lambda x: isinstance(x, type(diffrax.RESULTS.successful))
    if any(map(is_result, jtu.tree_leaves(out, is_leaf=is_result))):
        raise ValueError(
            "`fn` returns a result of a solve within phi, where it would be averaged. "
            "Return a pair `(phi, sol.result)`, so that failed paths are excluded."
        )
    check_real("fn", jtu.tree_leaves(out))
    out = jtu.tree_map(lambda x: jnp.asarray(x, real(jnp.result_type(x))), out)
    return out, success & all_finite(out)
