"""Expectations with their error bars: of functions of the state, and of functions of a
random key."""

from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, PyTree

from .._arguments import check_solver, check_takes, whole_number
from .._brownian import check_key
from .._compat import ClosedJaxpr, jaxpr_as_fun, solves_without_throwing
from .._custom_types import Args, RealScalarLike, Y
from .._structure_checks import check_stratonovich
from ._batches import Plan, run
from ._choice import chosen
from ._result import Expectation, level_weights, warn_of_tol
from ._sampling import AbstractSampling, batch_size_of, check_real, IndependentPaths
from ._steps import AbstractSampler, is_finite, Level, Problem, Samples


_no_meter = diffrax.NoProgressMeter()
# The keys made from this number belong to no sample.
_NO_SAMPLE = 0xFFFFFFFF


def expectation(
    phi: Callable[[RealScalarLike, Y, Args], PyTree[ArrayLike]],
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: float,
    t1: float,
    dt0: float,
    y0: Y,
    args: Args = None,
    *,
    key: PRNGKeyArray,
    sampling: AbstractSampling | None = None,
    ts: Sequence[float] | np.ndarray | None = None,
    levels: int = 1,
    tol: float | None = None,
    start: Expectation | None = None,
    devices: Sequence[Any] | None = None,
    progress_meter: diffrax.AbstractProgressMeter = _no_meter,
) -> Expectation:
    r"""Estimates $\mathbb E[\phi(t, y_t)]$, its standard error, and the error of
    discretization.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H = lambda t, p, q, args: (p**2 + q**2) / 2
        terms = ds.hamiltonian_terms(H, H, ds.WeakBrownianPath((), jr.key(0)))
        estimate = ds.expectation(
            lambda t, y, args: y[1] ** 2,
            terms,
            ds.StrangGauss(),
            t0=0,
            t1=1,
            dt0=1 / 8,
            y0=(jnp.array(0.0), jnp.array(1.0)),
            key=jr.key(1),
            sampling=ds.ValueFunctions(degree=4),
            levels=3,
        )
        print(estimate)
        ```

    **Samples** are paths, or replicates of many paths, as `sampling` says. They are taken
    in batches, so that memory does not grow with their number. Sample number $i$ gets the
    key `fold_in(fold_in(key, i >> 32), i & 0xFFFFFFFF)`, whatever the batch size and the
    devices are.

    **Levels.** With `levels=2` (3, ...) a sample takes steps $h$ and $h/2$ (and $h/4$,
    ...). `mean` is then extrapolated to steps of size zero, by the solver's own
    `weak_order(terms)`, and order 1 for solvers that have none, as those of Diffrax. `bias`
    is the error of discretization that the finest of the levels has.

    This function is no part of a JAX program: it cannot be differentiated, `jit`ted or
    `vmap`ped. The gradient of an expectation is the expectation of the gradient, by
    [`diffrax_symplectic.monte_carlo`][].

    It compiles anew for each new `phi`, `sort_by` and function in `terms`. For many values
    of a parameter pass the same functions, and the parameter as an array in `args`.

    **Arguments:**

    - `phi`: takes time, state and `args` to a PyTree of real arrays.
    - `terms`, `solver`, `t0`, `t1`, `dt0`, `y0`, `args`: as for `diffrax.diffeqsolve`,
        with `t1` after `t0` by a whole number of steps `dt0`. The paths in `terms` say
        which random variables there are; that their keys are equal or not says which of
        them are one Brownian motion. Any solver of this package, and those of Diffrax with
        fixed steps for Stratonovich equations.
    - `key`: a JAX random key.
    - `sampling`: an [`diffrax_symplectic.IndependentPaths`][],
        [`diffrax_symplectic.ArrayRQMC`][] or [`diffrax_symplectic.ValueFunctions`][]. With
        `None` a short pilot tries those that can be used and takes the one with the least
        error for its time; `reason` of the result says which and why. (It measures times.
        So a second call may choose another.)
    - `ts`: the times at which to average, each a whole number of steps after `t0`; by
        default `t1` alone.
    - `levels`: how many step sizes, each half of the one before.
    - `tol`: no further batch begins once every standard error is at most this. The number
        of samples in `sampling` is then the most that are taken.
    - `start`: an earlier estimate to continue. It has to come from the same `key` and the
        same arguments; of these only the shapes are checked.
    - `devices`: the devices that share the work, by default all of `jax.devices()`: under
        `jax.distributed` those of every process, each of which has to make the same call
        and gets the same result.
    - `progress_meter`: one of Diffrax's.

    **Returns:** an [`diffrax_symplectic.Expectation`][]. A path that fails has no part in
    it and is counted in `num_failed`: one with a step that the solver reports as failed, or
    with a state or $\phi$ that is not finite.

    **Raises:** a `ValueError` for a solver of Itô equations (these terms are
    Stratonovich's), times between steps, a $\phi$ that is not real, sizes that are not
    positive integers, a `tol` that is not positive, a `key` that is none, a `start` from
    another key, of other shapes or with more paths, and for paths that `sampling` cannot
    use (it says which ones it can); [`diffrax_symplectic.ExpectationInterrupted`][], with
    the estimate so far, on an interrupt from the keyboard. Warns if `tol` was not reached.

    **Source:** [Chan, Golub and LeVeque
    (1983)](https://doi.org/10.1080/00031305.1983.10483115) for the formula by which means
    and variances of batches are combined; [Talay and Tubaro
    (1990)](https://doi.org/10.1080/07362999008809220) for extrapolation.
    """
    key = _checked_key(key, "expectation")
    _check_tol(tol)
    levels = whole_number("levels", levels)
    _check_solver(solver)
    problem, weights = _problem(phi, terms, solver, t0, t1, dt0, y0, args, ts, levels)
    devices = tuple(jax.devices() if devices is None else devices)
    k_pilot, why, prepared = jr.fold_in(key, _NO_SAMPLE), "", None
    if sampling is None and start is not None:
        sampling, why = start.sampling, start.reason
    elif sampling is None:
        sampling, prepared, why = chosen(problem, weights, k_pilot, tol, devices)
    if not isinstance(sampling, AbstractSampling):
        raise ValueError(
            "`sampling` must be `IndependentPaths(num_paths)`, `ArrayRQMC()`, "
            f"`ValueFunctions()` or `None`; got {sampling!r}."
        )
    if start is not None and type(start.sampling) is not type(sampling):
        raise ValueError(
            f"`start` was sampled by {start.sampling}; got sampling={sampling}. Pass the "
            "same."
        )
    if prepared is None:
        prepared = sampling.prepare(problem, weights, k_pilot, devices)
    sampler, plan, reason = prepared
    about = dict(sampling=sampling, reason=why or reason)
    estimate = run(sampler, key, plan, devices, start, tol, progress_meter, **about)
    warn_of_tol(estimate, tol)
    return estimate


def monte_carlo(
    fn: Callable[..., Any],
    key: PRNGKeyArray,
    num_paths: int | np.integer,
    *,
    batch_size: int | np.integer | None = None,
    levels: int = 1,
    order: int | None = None,
    tol: float | None = None,
    start: Expectation | None = None,
    devices: Sequence[Any] | None = None,
    progress_meter: diffrax.AbstractProgressMeter = _no_meter,
) -> Expectation:
    r"""Averages a function of a random key: whatever a path of your own makes of it.

    For functions of the state at given times [`diffrax_symplectic.expectation`][] is
    simpler, and needs far fewer paths. This one is for all else: events, gradients,
    functions of whole paths.

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

        estimate = ds.monte_carlo(phi, jr.key(0), 10_000)
        print(estimate.mean, estimate.std_error, estimate.num_failed)
        ```

    `fn` is compiled anew for each new function. For many values of a parameter pass one
    function and the parameter as an array, `jax.tree_util.Partial(fn, parameter)`.
    Gradients are taken within: the mean of `jax.grad` of a path is the gradient of the
    expectation. On several devices the solve needs the adjoint `diffrax.DirectAdjoint()` or
    `diffrax_symplectic.ReversingAdjoint()`. This function itself is no part of a JAX
    program: it cannot be differentiated, `jit`ted or `vmap`ped.

    **Levels.** With `levels=2` (3, ...) and `order=p` the function is `fn(key, level)`,
    which solves with the step $h$ on level 0, $h/2$ on level 1, and so on. `mean` is
    extrapolated to steps of size zero. Let the levels follow one Brownian motion, with
    `cell=` of [`diffrax_symplectic.FixedStepBrownianPath`][]: then `bias`, the error of
    discretization of the finest level, is known much better than the mean.

    **Arguments:**

    - `fn`: takes a random key to $\phi$, a PyTree of real arrays, or to a pair of that
        and a `diffrax.RESULTS`: as above, with `throw=False`. A path fails if its result
        is neither successful nor an event, or anything in its $\phi$ is not finite.
        (Without `sol.result` a path that failed counts as a success: Diffrax returns where
        it stopped.)
    - `key`: a JAX random key. Path number $i$ gets the key
        `fold_in(fold_in(key, i >> 32), i & 0xFFFFFFFF)`.
    - `num_paths`: the number of all paths, those of `start` included.
    - `batch_size`: as for [`diffrax_symplectic.IndependentPaths`][].
    - `levels`: how many step sizes.
    - `order`: with levels, the weak order $p$ of the solver for the terms, as
        `solver.weak_order(terms)` says.
    - `tol`, `start`, `devices`, `progress_meter`: as for
        [`diffrax_symplectic.expectation`][].

    **Returns:** an [`diffrax_symplectic.Expectation`][].

    **Raises:** as [`diffrax_symplectic.expectation`][]; a `ValueError` for levels without
    `order`, or if $\phi$ holds a `diffrax.RESULTS`.
    """
    key = _checked_key(key, "monte_carlo")
    _check_tol(tol)
    levels = whole_number("levels", levels)
    if levels > 1 and order is None:
        raise ValueError(
            "`levels` need `order=`, the weak order of the solver; got "
            f"levels={levels!r} and order=None."
        )
    check_takes("fn", fn, *(["key"] if levels == 1 else ["key", "level"]))
    order = 1 if order is None else whole_number("order", order)
    devices = tuple(jax.devices() if devices is None else devices)
    size = batch_size_of(batch_size, devices)
    sampling = IndependentPaths(num_paths, size)
    # For equal weights these are equal, so that JAX compiles a function once.
    sampler = _Given(fn, tuple(map(tuple, level_weights(order, levels).tolist())))
    plan = Plan(sampling.num_paths, size)
    estimate = run(
        sampler, key, plan, devices, start, tol, progress_meter, sampling=sampling
    )
    warn_of_tol(estimate, tol)
    return estimate


class _Given(AbstractSampler):
    """Samples by a function of a key."""

    fn: Callable[..., Any]
    weights: tuple[tuple[float, ...], ...] = eqx.field(static=True)

    def __call__(self, keys):
        def one(key):
            if len(self.weights) == 1:
                each = [_evaluate(self.fn, key)]
            else:
                levels = range(len(self.weights[0]))
                each = [_evaluate(lambda k, i=i: self.fn(k, i), key) for i in levels]
            values, success = zip(*each)
            wide = lambda x: x.astype(jnp.result_type(x, float))

            def combined(*xs):
                return jnp.stack(
                    [sum(w * wide(x) for w, x in zip(row, xs)) for row in self.weights]
                )

            return jtu.tree_map(combined, *values), jnp.all(jnp.stack(success))

        values, good = jax.vmap(one)(keys)
        return Samples(values, good, (~good).astype(int))


def _evaluate(fn: Callable, key) -> tuple[PyTree[Array], Array]:
    """What `fn` returns, and whether the path succeeded."""
    program, shape = jax.make_jaxpr(fn, return_shape=True)(key)
    check_failures_are_reported(program, shape)
    leaves = jaxpr_as_fun(program)(key)
    out = jtu.tree_unflatten(jtu.tree_structure(shape), leaves)
    success = jnp.array(True)
    if isinstance(out, tuple) and len(out) == 2 and _is_result(out[1]):
        out, result = out
        success = diffrax.is_okay(result)
    if any(map(_is_result, jtu.tree_leaves(out, is_leaf=_is_result))):
        raise ValueError(
            "`fn` returns a `diffrax.RESULTS` within phi, where it would be averaged. "
            "Return a pair `(phi, sol.result)`, so that paths that failed are left out."
        )
    out = jtu.tree_map(jnp.asarray, out)
    if len(jtu.tree_leaves(out)) == 0:
        raise ValueError(f"`fn` must return arrays, which are averaged; got {out!r}.")
    return out, success & is_finite(out)


def check_failures_are_reported(program: ClosedJaxpr, out: PyTree) -> None:
    """Raises a `ValueError` if a function solves with `throw=False`, as its program says,
    but what it returns holds no `diffrax.RESULTS`."""
    reported = any(map(_is_result, jtu.tree_leaves(out, is_leaf=_is_result)))
    if not reported and solves_without_throwing(program.jaxpr):
        raise ValueError(
            "`fn` solves with `throw=False` but does not return `sol.result`, so that "
            "paths that failed would be averaged as if they had not. Return the pair "
            "`(phi, sol.result)`: then they are left out and counted. Or pass `throw=True` "
            "to `diffeqsolve`, which raises an error if a path fails. If `fn` sees to "
            "failures itself, return `(phi, diffrax.RESULTS.successful)`."
        )


def _is_result(x) -> bool:
    return isinstance(x, type(diffrax.RESULTS.successful))


def _problem(
    phi, terms, solver, t0, t1, dt0, y0, args, ts, levels: int
) -> tuple[Problem, Float[np.ndarray, "combinations levels"]]:
    num_steps, saved_steps = _steps(t0, t1, dt0, ts)
    y0 = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x, float)), y0)
    start = jnp.asarray(t0, jnp.result_type(*jtu.tree_leaves(y0)))
    check_stratonovich(terms, solver, start, y0, args)
    check_takes("phi", phi, "t", "y", "args")
    check_real("phi", jtu.tree_leaves(eqx.filter_eval_shape(phi, start, y0, args)))
    finer = 2 ** np.arange(levels, dtype=np.int32)
    grid = Level(
        jnp.arange(levels, dtype=jnp.int32),
        jnp.asarray(float(dt0) / finer, start.dtype),
        jnp.asarray(finer * num_steps),
        jnp.asarray(finer[:, None] * saved_steps),
    )
    most = int(finer[-1] * num_steps)
    at_end = ts is None
    problem = Problem(_Arrays(phi), terms, solver, start, y0, args, grid, at_end, most)
    order = getattr(solver, "weak_order", lambda terms: 1)(terms) or 1
    return problem, level_weights(order, levels)


class _Arrays(eqx.Module):
    """`phi`, with arrays for its numbers."""

    phi: Callable

    def __call__(self, t, y, args):
        return jtu.tree_map(jnp.asarray, self.phi(t, y, args))


def _steps(t0, t1, dt0, ts) -> tuple[np.integer, np.ndarray]:
    """How many steps there are, and after how many of them to average."""
    if dt0 is None:
        raise ValueError("`dt0` must be a number: steps are fixed; got None.")
    t0, t1, dt0 = float(t0), float(t1), float(dt0)
    if not (dt0 > 0 and t1 > t0):
        raise ValueError(
            f"`dt0` must be positive, and `t1` after `t0`; got dt0={dt0}, t0={t0}, "
            f"t1={t1}."
        )
    times = np.array([t1] if ts is None else ts, float).reshape(-1)
    counts = (np.append(times, t1) - t0) / dt0
    whole = np.round(counts)
    if not np.all(np.abs(counts - whole) <= 1e-6 * np.maximum(whole, 1)):
        raise ValueError(
            "`t1` and each of `ts` must be a whole number of steps after `t0`; got "
            f"steps of {dt0} from {t0} on, t1={t1} and ts={ts}. Choose a `dt0` that "
            "divides the times between them."
        )
    if len(times) == 0 or np.any(whole < 0) or np.any(whole > whole[-1]):
        raise ValueError(
            f"`ts` must lie between `t0` and `t1`, and hold one time at least; got {ts}."
        )
    steps = whole.astype(np.int32)
    return steps[-1], steps[:-1]


def _checked_key(key, user: str) -> PRNGKeyArray:
    check_key(key, user)
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    return key if typed else jr.wrap_key_data(key)


def _check_tol(tol: float | None) -> None:
    if tol is not None and not 0 < tol < np.inf:
        raise ValueError(f"`tol` must be a positive number, or `None`; got {tol!r}.")


def _check_solver(solver) -> None:
    check_solver("solver", solver)
    if isinstance(solver, diffrax.HalfSolver):
        raise ValueError("`solver` must take fixed steps; got a `diffrax.HalfSolver`.")
