"""Averages of any function of a random key."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PRNGKeyArray, PyTree

from .._arguments import (
    check_real,
    check_takes,
    check_untraced,
    shapes,
    ShortTraceback,
    whole_number,
)
from .._compat import is_result
from .._programs import current_traces, digest, Traced, traced
from .._root_finder import all_finite
from .._simulation import (
    advice_on_failures,
    Layout,
    level_weights,
    MOST_LEVELS,
    real_vector,
)
from .call import checked_call
from .estimate import cautions, Expectation
from .independent import IndependentPaths, samples_of_paths
from .progress import NO_METER, Progress
from .run import Kept, run
from .sampling import Outputs, Samples


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
    r"""Averages any function of a random key, typically of one path, with an error bar.

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

    `fn` is traced in each call, so what it reads is read anew. Another parameter in
    `jax.tree_util.Partial(fn, parameter)` compiles nothing. To differentiate, call
    `jax.grad` inside `fn` (on several devices with [these
    adjoints](adjoints.md#several-devices)). `monte_carlo` itself runs outside JAX
    transformations: it cannot be differentiated, `jit`ted or `vmap`ped.

    **Levels.** With `levels=2` and `order=p`, `fn(key, level)` solves with step
    $h / 2^{\mathrm{level}}$, and the mean is extrapolated. Use one Brownian motion for all
    levels (`cell=` of [`diffrax_symplectic.FixedStepBrownianPath`][]): then `bias`, the
    discretization error of the finest level, is far more accurate than the mean.

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
    levels = whole_number("levels", levels, 1, MOST_LEVELS)
    if levels > 1 and order is None:
        raise ValueError(
            "Several `levels` need `order=`, the weak order of the solver; got "
            f"levels={levels!r} and order=None."
        )
    names_of_arguments = ["key"] if levels == 1 else ["key", "level"]
    check_takes("fn", fn, *names_of_arguments)
    # First-passage times have the order 1/2, if events are checked at the end of each step.
    is_half = isinstance(order, float) and order == 0.5
    is_whole = isinstance(order, int | np.integer) and order >= 1
    if order is not None and not (is_half or is_whole):
        raise ValueError(f"`order` must be a positive integer, or 1/2; got {order!r}.")
    sampling = IndependentPaths(num_paths, batch_size)
    weights = level_weights(float(order or 1), levels)
    progress = Progress("monte_carlo", progress_meter, "a small `num_paths`")
    with ShortTraceback(), Kept() as kept, progress:
        # Each level is a program of its own: `fn` takes the level as a Python integer, by
        # which it may choose its step. With one level, `fn` takes the key alone.
        arguments_after_key = [()] if levels == 1 else [(k,) for k in range(levels)]
        with current_traces(fn):
            programs = [
                traced(jtu.Partial(_value_and_success, fn, given), key, identity=fn)
                for given in arguments_after_key
            ]
        check_untraced("`monte_carlo`", programs)
        sampler = jtu.Partial(_samples_of_programs, programs, weights)
        # On each level a path has at least one number, of four bytes.
        plan = sampling.plan(sampler, _outputs(programs, key), devices, 4 * levels)
        progress.stage("compiling and sampling")
        estimate = run(
            plan, key, devices, start, first, tol, progress, kept,
            sampling=sampling,
            digests=dict(fn=digest(programs), order=digest(order)),
        )  # fmt: skip
        for message in cautions(estimate, tol, advice=advice_on_failures(None)):
            warnings.warn(message, stacklevel=2)
    return estimate


def _outputs(programs: list[Traced], key: PRNGKeyArray) -> Outputs:
    """The layout, the levels and the dtype of the numbers of phi, which the program of each
    level returns. Raises a `ValueError` unless the layout is the same on all levels."""
    structs = [jax.eval_shape(program, key)[0] for program in programs]
    layout, *other_layouts = map(Layout.of, structs)
    if any(other != layout for other in other_layouts):
        raise ValueError(
            "`fn` must return a phi of the same structure and shapes on all levels; got "
            f"{', '.join(map(shapes, structs))}."
        )
    # The least precise dtype in phi decides on rounding errors.
    dtypes = {leaf.dtype for leaf in jtu.tree_leaves(structs)}
    dtype = min(dtypes, key=lambda dtype: jnp.finfo(dtype).bits)
    return Outputs(layout, len(programs), str(dtype))


def _samples_of_programs(
    programs: list[Traced],
    weights: Float[Array | np.ndarray, "combinations levels"],
    keys: Key[Array, " n"],
) -> Samples:
    """The samples of the user's function, with one program for each level. A sample has the
    same random key on all levels."""
    phi_and_success = [jax.vmap(program)(keys) for program in programs]
    # (levels, n, numbers) and (levels, n)
    values = jnp.stack([jax.vmap(real_vector)(phi) for phi, _ in phi_and_success])
    success = jnp.stack([success for _, success in phi_and_success])
    return samples_of_paths(weights, values, ~success)


def _value_and_success(
    fn: Callable, arguments: tuple[int, ...], key: PRNGKeyArray
) -> tuple[PyTree[Array], Bool[Array, ""]]:
    """The $\\phi$ that `fn(key, *arguments)` returns, in floating-point numbers, and
    whether the path succeeded. `arguments` is the level, or empty with one level."""
    phi = fn(key, *arguments)
    success = jnp.array(True)
    is_pair = isinstance(phi, tuple) and len(phi) == 2
    if is_pair and isinstance(phi[1], diffrax.RESULTS):
        phi, result = phi
        success = diffrax.is_okay(result)
    if any(map(is_result, jtu.tree_leaves(phi, is_leaf=is_result))):
        raise ValueError(
            "`fn` returns a result of a solve within phi, where it would be averaged. "
            "Return a pair `(phi, sol.result)`, so that failed paths are excluded."
        )
    check_real("fn", jtu.tree_leaves(phi))
    phi = jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x, float)), phi)
    return phi, success & all_finite(phi)
