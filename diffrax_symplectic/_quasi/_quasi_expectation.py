"""Expectations by quasi-Monte Carlo, one randomization after another."""

import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import ArrayLike, PRNGKeyArray, PyTree

from .._arguments import check_solver, check_takes, whole_number
from .._brownian import check_key
from .._custom_types import Args, RealScalarLike, Y
from .._structure_checks import check_stratonovich
from ._chain import coordinates, Problem, replicate
from ._estimate import estimate, QuasiExpectation
from ._given_words import layout
from ._point_set import MAX_DIMENSION, sobol_points


_no_meter = diffrax.NoProgressMeter()
# Fewer replicates say too little about their spread to stop because of it.
_BEFORE_STOPPING = 8


def quasi_expectation(
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
    num_paths: int = 2**14,
    replicates: int = 16,
    ts: Sequence[float] | np.ndarray | None = None,
    levels: int = 1,
    tol: float | None = None,
    sort_by: Callable[[Y], PyTree[ArrayLike]] | None = None,
    devices: Sequence[Any] | None = None,
    progress_meter: diffrax.AbstractProgressMeter = _no_meter,
) -> QuasiExpectation:
    r"""Estimates $\mathbb E[\phi(t, y_t)]$ by quasi-Monte Carlo, with its standard error
    and that of discretization.

    All paths take a step together. Before it they are sorted, so that neighbours in the
    state space are neighbours along Hilbert's curve. Path number $j$ in this order takes
    the $j$-th of a scrambled set of Sobol' points, the coordinates of which become the
    random variables of the step, one each. So neighbours take values that balance each
    other, and what the paths have in common cancels. Each path by itself has its law
    exactly, and the estimate has no bias but that of the solver.

    The error falls faster than one over the root of the number of paths, in few dimensions
    much faster: for up to four numbers in the state (or in `sort_by`) and $\phi$ smooth,
    one replicate is worth hundreds to thousands of times as many independent paths. For
    large systems that the noise moves far it is worth tens of times as many, in chaos
    after long times no less than as many, and what is spent on sorting is lost: take
    [`diffrax_symplectic.expectation`][].

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H = lambda t, p, q, args: (p**2 + q**2) / 2
        terms = ds.hamiltonian_terms(H, H, ds.WeakBrownianPath((), jr.key(0)))
        estimate = ds.quasi_expectation(
            lambda t, y, args: y[1] ** 2,
            terms,
            ds.StrangGauss(),
            t0=0,
            t1=1,
            dt0=1 / 8,
            y0=(jnp.array(0.0), jnp.array(1.0)),
            key=jr.key(1),
            num_paths=2**10,
            levels=2,
        )
        print(estimate.mean, estimate.interval(0.95), estimate.bias)
        ```

    With `levels=2` (3, ...) it solves with steps $h$ and $h/2$ (and $h/4$, ...) and
    extrapolates. For that the solver's own `weak_order(terms)` is used, and order 1 for
    solvers that have none, as those of Diffrax.

    Like [`diffrax_symplectic.expectation`][] this is no part of a JAX program: it cannot be
    differentiated, `jit`ted or `vmap`ped.

    **Arguments:**

    - `phi`: takes time, state and `args` to a PyTree of real arrays.
    - `terms`, `solver`, `t0`, `t1`, `dt0`, `y0`, `args`: as for `diffrax.diffeqsolve`,
        with `t1` after `t0` by a whole number of steps `dt0`. The paths in `terms` say
        which random variables there are; their keys are not used. Any solver of this
        package or of Diffrax with fixed steps. (Plain terms mean what the solver makes of
        them: in the sense of Ito for `diffrax.Euler`, else of Stratonovich.)
    - `key`: a JAX random key. Replicate number $r$ is a function of `fold_in(key, r)`,
        however many there are and on whichever device it is made.
    - `num_paths`: of each replicate; a power of two.
    - `replicates`: independent randomizations, at most if there is a `tol`. Each device
        takes one at a time: memory does not grow with their number.
    - `ts`: the times at which to average, each a whole number of steps after `t0`; by
        default `t1` alone.
    - `levels`: how many step sizes, each half of the one before.
    - `tol`: stop when each standard error is at most this, after 8 replicates or more.
    - `sort_by`: takes the state to a PyTree of those real numbers that paths are sorted
        by, as few of them as tell states apart that matter; by default the state itself.
    - `devices`: by default all of `jax.local_devices()`.
    - `progress_meter`: one of Diffrax's.

    **Returns:** a [`diffrax_symplectic.QuasiExpectation`][].

    **Raises:** a `ValueError` for a number of paths that is no power of two, fewer than two
    replicates, an Ito solver for terms made from Hamiltonians (unless their noise is
    additive), times between steps, a $\phi$ that is not real, a path whose random
    variables cannot be chosen (Diffrax's own; use a
    [`diffrax_symplectic.FixedStepBrownianPath`][]), or more in a step than there are
    coordinates of Sobol' points (21,201). Warns if there are so many coordinates to sort by
    that sorting does not bring neighbours together.
    """
    num_paths = _power_of_two("num_paths", num_paths)
    replicates = whole_number("replicates", replicates, 2)
    levels = whole_number("levels", levels, 1)
    check_key(key, "quasi_expectation")
    check_solver("solver", solver)
    if tol is not None and not tol > 0:
        raise ValueError(f"`tol` must be positive, or `None`; got {tol!r}.")
    num_steps, saved_steps = _steps(t0, t1, dt0, ts)
    problem = _problem(phi, sort_by, terms, solver, t0, y0, args, num_paths)
    dtype = problem.t0.dtype
    order = getattr(solver, "weak_order", lambda terms: 1)(terms) or 1
    devices = tuple(jax.local_devices() if devices is None else devices)
    mesh = Mesh(np.array(devices), ("replicates",))

    def level(begin: int, k: int):
        h, finer = np.asarray(dt0 / 2**k, dtype), np.int32(2**k)
        numbers = np.arange(begin, begin + mesh.size, dtype=np.uint32)
        steps = finer * num_steps, finer * saved_steps
        return _replicates(problem, key, numbers, np.uint32(k), h, *steps, mesh)

    values, num_failed = [], 0
    meter = progress_meter.init()
    try:
        for begin in range(0, replicates, mesh.size):
            done = jax.device_get([level(begin, k) for k in range(levels)])
            for i in range(min(mesh.size, replicates - begin)):
                one = [jtu.tree_map(lambda x: x[i], means) for means, _ in done]
                if ts is None:
                    one = [jtu.tree_map(lambda x: x[0], means) for means in one]
                values.append(one)
                num_failed += sum(int(failed[i]) for _, failed in done)
                # The same replicates decide, however many are made at once.
                if tol is not None and len(values) >= _BEFORE_STOPPING:
                    result = estimate(values, num_failed, order, tol)
                    if result.tol_reached:
                        return result
            meter = progress_meter.step(meter, np.asarray(len(values) / replicates))
    finally:
        progress_meter.close(meter)
    return estimate(values, num_failed, order, tol)


def _problem(phi, sort_by, terms, solver, t0, y0, args, num_paths: int) -> Problem:
    """What all replicates share. Raises for what they cannot do."""
    y0 = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x, float)), y0)
    t0 = jnp.asarray(t0, jnp.result_type(*jtu.tree_leaves(y0)))
    check_stratonovich(terms, solver, t0, y0, args)
    words = layout(terms)
    if not 0 < words.num_words <= MAX_DIMENSION:
        raise ValueError(
            f"`terms` need {words.num_words:,} random variables in each step. There have "
            f"to be some, and at most {MAX_DIMENSION:,}, as Sobol' points have. "
            "Use `expectation`."
        )
    sort_by = _state if sort_by is None else sort_by
    _check_functions(phi, sort_by, t0, y0, args, num_paths)
    points = jnp.asarray(sobol_points(num_paths, words.num_words))
    return Problem(phi, sort_by, terms, solver, t0, y0, args, points, words)


@eqx.filter_jit
def _replicates(
    problem: Problem, key, numbers, level, h, num_steps, saved_steps, mesh: Mesh
):
    """One replicate on each device. The programs of the devices are the same, and know
    nothing of each other: so are the results, to the last bit."""
    dynamic, static = eqx.partition(problem, eqx.is_array)

    def local(dynamic, key, number, level, h, num_steps, saved_steps):
        one = eqx.combine(dynamic, static)
        key = jr.fold_in(jr.fold_in(key, number[0]), level)
        out = replicate(one, key, h, num_steps, saved_steps)
        return jtu.tree_map(lambda x: x[None], out)

    shared, own = PartitionSpec(), PartitionSpec("replicates")
    sharded = jax.shard_map(
        local,
        mesh=mesh,
        in_specs=(shared, shared, own, shared, shared, shared, shared),
        out_specs=own,
        check_vma=False,
    )
    return sharded(dynamic, key, numbers, level, h, num_steps, saved_steps)


def _state(y: Y) -> Y:
    return y


def _power_of_two(name: str, value) -> int:
    whole = whole_number(name, value, 2)
    if whole & (whole - 1):
        raise ValueError(
            f"`{name}` must be a power of two, of which Sobol' points are balanced; got "
            f"{whole}. Pass {2 ** (whole.bit_length() - 1)} or {2 ** whole.bit_length()}."
        )
    return whole


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


def _check_functions(phi, sort_by, t0, y0, args, num_paths: int) -> None:
    check_takes("phi", phi, "t", "y", "args")
    check_takes("sort_by", sort_by, "y")
    out = jtu.tree_leaves(eqx.filter_eval_shape(phi, t0, y0, args))
    batch = jtu.tree_map(lambda x: x[None], y0)
    by = eqx.filter_eval_shape(lambda y: jtu.tree_leaves(jax.vmap(sort_by)(y)), batch)
    for name, leaves in (("phi", out), ("sort_by", by)):
        kinds = jnp.floating, jnp.integer, jnp.bool_
        real = lambda s: any(jnp.issubdtype(jnp.result_type(s), k) for k in kinds)
        if len(leaves) == 0 or not all(map(real, leaves)):
            raise ValueError(
                f"`{name}` must return real arrays; got dtypes "
                f"{[str(jnp.result_type(s)) for s in leaves]}. Return real and imaginary "
                "parts."
            )
    dimension = jax.eval_shape(lambda y: coordinates(sort_by, y), batch).shape[1]
    # How many of the paths, sorted, there are along each coordinate.
    along = num_paths ** (1 / dimension)
    if along < 3:
        warnings.warn(
            f"{num_paths:,} paths are sorted by {dimension} coordinates, so that there are "
            f"{along:.1f} along each of them: neighbours are far apart, and "
            "`quasi_expectation` gains little over `expectation`. Pass `sort_by` with the "
            f"few coordinates that matter most, {int(math.log(num_paths, 3))} at most.",
            stacklevel=4,
        )
