"""Checks of the arguments of `expectation` and `ensemble`, before anything is solved, and
the arguments in the form in which a `Problem` holds them."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from .._arguments import (
    brief,
    check_args,
    check_numbers,
    check_real,
    check_takes,
    check_untraced,
    takes_args,
)
from .._brownian import (
    check_key,
    Discrete,
    is_random,
    laws_of,
    lost_variance,
    STEP_BEYOND_UNIT,
    TRUNCATE_LESS,
    typed_key,
)
from .._custom_types import Args, RealScalarLike, Y
from .._programs import once_for_each_signature, traced
from .._solver import own_path
from .._terms import (
    brownian_paths,
    call_user_function,
    check_baths_have_own_noise,
    check_terms_fit_state,
    has_lifted,
)


# Times are given in decimals, so a quotient of times counts as a whole number of steps if
# it differs from one by at most this fraction of it.
_TIME_ROUNDING = 1e-6
# Some Brownian paths are sampled over cells: intervals of the length `cell`, of which every
# step must be a multiple. A time counts as a multiple of `cell` if their quotient differs
# from a whole number by at most this. (With a larger difference a step would take the
# increment of another cell.)
_CELL_ROUNDING = 1e-3
# Users are warned if truncation takes more than this fraction of the variance of
# increments. In a heat bath the temperature falls by the same fraction.
_MOST_LOST_VARIANCE = 1e-3


def checked_key(caller: str, key: Any, others: Any) -> PRNGKeyArray:
    """The random key that the user passed to the function `caller`, as a typed key. Raises
    a `ValueError` unless it is a single key, and if `caller` was called inside a
    transformation of JAX. `others` are the other arguments of `caller`."""
    # Inside `vmap` or `grad` an argument is traced. Inside `jit` perhaps none is, but any
    # new array is.
    new_array = jnp.zeros(())
    check_untraced(f"`{caller}`", (key, others, new_array))
    check_key(key, caller)
    key = typed_key(key)
    if key.shape != ():
        raise ValueError(
            f"`{caller}` needs one random key, from which all paths get theirs; got keys "
            f"of shape {key.shape}."
        )
    return key


def step_numbers(
    t0: Any, t1: Any, dt0: Any, ts: Sequence[Any] | np.ndarray | Array | None
) -> Int[np.ndarray, " times_and_1"]:
    """The numbers of steps from `t0` to each of `ts`, and last of all to `t1`. (If `ts` is
    `None`, the number to `t1` comes twice.) Raises a `ValueError` unless all times are
    numbers, a whole number of steps after `t0` and none after `t1`."""
    if dt0 is None:
        raise ValueError("`dt0` must be a number: steps are fixed; got None.")
    arguments = f"dt0={dt0!r}, t0={t0!r}, t1={t1!r}"
    if not all(eqx.is_array_like(x) and np.ndim(x) == 0 for x in (t0, t1, dt0)):
        raise ValueError(f"`t0`, `t1` and `dt0` must be numbers; got {arguments}.")
    begin = float(t0)
    end = float(t1)
    step = float(dt0)
    if not (0 < step < np.inf and begin < end < np.inf):
        raise ValueError(
            f"`dt0` must be positive, and `t1` after `t0`; got {arguments}."
        )
    times = np.array([end] if ts is None else ts, float).reshape(-1)
    quotients = (np.append(times, end) - begin) / step
    counts = np.round(quotients)
    roundings = _TIME_ROUNDING * np.maximum(counts, 1)
    # `not np.all(... <= ...)` also finds times that are NaN, for which comparisons are
    # false.
    if not np.all(np.abs(quotients - counts) <= roundings):
        example = ""
        # There is no example with times before the end: one step size may not divide all
        # intervals.
        if np.all(times == end):
            num_steps = max(1, np.ceil(quotients[-1]))
            example = f" For example, `dt0={end - begin:g} / {num_steps:.0f}`."
        raise ValueError(
            "Choose a `dt0` that divides the intervals between `t0`, `t1` and `ts`: `t1` "
            "and each of `ts` must be a whole number of steps after `t0`. Got "
            f"dt0={step}, t0={begin}, t1={end} and ts={brief(times)}.{example}"
        )
    if len(times) == 0 or np.any(counts < 0) or np.any(counts > counts[-1]):
        raise ValueError(
            "`ts` must hold at least one time, all between `t0` and `t1`; got "
            f"{brief(times)}."
        )
    return counts.astype(np.int32)


def given_state(y0: Y) -> Y:
    """The initial state `y0`, with integers as floating-point numbers. Raises a
    `ValueError` if `y0` holds anything else than numbers and arrays of numbers."""
    check_numbers("y0", y0)
    return jtu.tree_map(lambda x: jnp.asarray(x, jnp.result_type(x, float)), y0)


def drawn_state(y0_of: Callable, key: PRNGKeyArray, args: Args) -> Y:
    """The initial state that the user's function `y0_of` draws for one path. Raises a
    `ValueError` unless the function takes `key`, or `key` and `args`."""
    if takes_args(y0_of):
        check_takes("y0", y0_of, "key", "args")
        return given_state(y0_of(key, args))
    check_takes("y0", y0_of, "key")
    return given_state(y0_of(key))


def drawn_args(args_of: Callable, key: PRNGKeyArray) -> Args:
    """The `args` that the user's function `args_of` draws for one path. Raises a
    `ValueError` unless the function takes `key`."""
    check_takes("args", args_of, "key")
    try:
        args = args_of(key)
    except TypeError as error:
        error.add_note(
            "`args` is called with a random key, to draw the `args` of each path. If your "
            "Hamiltonians take a function in `args`, pass it in a tuple or a dictionary."
        )
        raise

    check_args(args)
    # Leaves that are no arrays are not drawn: all paths share them.
    arrays, others = eqx.partition(args, eqx.is_array)
    return eqx.combine(jtu.tree_map(jnp.asarray, arrays), others)


def check_noise(terms: PyTree) -> None:
    """Raises a `ValueError` if nothing in the terms is random, or if a heat bath shares its
    noise with another term."""
    check_baths_have_own_noise(terms)
    paths = brownian_paths(terms)
    if len(paths) == 0:
        raise ValueError(
            "`terms` have no Brownian path, so nothing is random. Solve them once, with "
            "`diffrax.diffeqsolve`; for random `y0` or `args` average such solves by "
            "`monte_carlo`."
        )
    if not any(map(is_random, paths)):
        raise ValueError(
            "No Brownian path in `terms` has a random key, so all samples would have the "
            "same noise. Solve once, with `diffrax.diffeqsolve`. If your path draws its "
            "own noise, give it a field that holds a JAX random key. To average over many "
            "records, pass `monte_carlo` a function that draws one of them."
        )


def check_truncation(terms: PyTree, h: float) -> None:
    """Raises a `ValueError` if truncated increments over steps of size `h` are all zero."""
    if any(lost_variance(path, h) == 1 for path in brownian_paths(terms)):
        raise ValueError(f"{STEP_BEYOND_UNIT} Got dt0={h}.")


def warn_of_truncation(terms: PyTree, h: float, stacklevel: int) -> None:
    """Warns if truncated increments lose much of their variance in steps of size `h`."""
    lost = max(lost_variance(path, h) for path in brownian_paths(terms))
    if lost > _MOST_LOST_VARIANCE:
        warnings.warn(
            f"The increments of a `TruncatedBrownianPath` lose {lost:.1%} of their "
            f"variance in steps of {h:g}. {TRUNCATE_LESS}",
            stacklevel=stacklevel + 1,
        )


@once_for_each_signature
def has_discrete_increments(solver: diffrax.AbstractSolver) -> bool:
    """Whether a solver takes discrete increments only, as weak methods do. Such a solver
    makes a path with discrete increments even for `want="strong"`."""
    path = own_path(solver, "strong", shape=(), key=jr.key(0))
    # The laws of the random variables of a step, of which `W` is the increment. The laws
    # are unknown (`None`) if the class of the path is the user's.
    laws = laws_of(path) or {}
    return isinstance(laws.get("W"), Discrete)


def check_gaussian(solver: diffrax.AbstractSolver) -> None:
    """Raises a `ValueError` unless a solver takes Gaussian increments."""
    if has_discrete_increments(solver):
        raise ValueError(
            f"`{type(solver).__name__}` is a weak method, whose increments take a few "
            "values, so that paths do not have the law of the solution. Pass "
            '`want="weak"` for the right means of smooth functions, or a solver of '
            '`suggest_solver(terms, t0, y0, args, want="strong")`.'
        )


def check_cells(terms: PyTree, t0: float, h: float) -> None:
    """Raises a `ValueError` unless `t0` and the step size `h` are multiples of the `cell`
    of each path. A path with `cell` is sampled over intervals of this length."""
    for path in brownian_paths(terms):
        # Many classes of paths have no `cell`, and in others it may be `None`.
        cell = getattr(path, "cell", None)
        if cell is None:
            continue
        if not (is_multiple(t0, cell) and is_multiple(h, cell)):
            raise ValueError(
                f"Steps of a `{type(path).__name__}` with `cell` must begin and end at "
                f"multiples of `cell`; got cell={cell}, t0={t0} and the smallest step {h}. "
                "Pass a `cell` that divides `t0` and the steps of all `levels`."
            )


def is_multiple(time: float, cell: float) -> bool:
    """Whether a time is a whole multiple of `cell`, up to rounding."""
    quotient = time / cell
    return abs(quotient - round(quotient)) <= _CELL_ROUNDING


# Raises an error unless the terms fit the state. Equal terms and shapes are checked once.
check_fit = once_for_each_signature(check_terms_fit_state)


def state_itself(t, y, args):
    """The `phi` of a problem that asks for the states of paths, and not for a mean."""
    del t, args
    return y


def traced_phi(
    phi: Callable, terms: PyTree, t0: Float[np.ndarray, ""], y0: Y, args: Args
) -> Callable[[RealScalarLike, Y, Args], PyTree]:
    """The user's `phi` as a program (see `_programs`). Raises an error unless `phi` takes
    this state and returns real arrays. For spins and complex amplitudes, errors explain
    which state `phi` gets."""
    if phi is state_itself:
        return phi
    check_takes("phi", phi, "t", "y", "args")
    try:
        return traced(jtu.Partial(_real_phi, phi), t0, y0, args, identity=phi)
    except (TypeError, AttributeError, IndexError) as error:
        # A user may take the pair `y` for the spin `s` itself, and write `s.x`, `s[2]` or
        # `-s`, which raise these errors.
        if has_lifted(terms):
            error.add_note(
                "For spins and complex amplitudes `phi(t, y, args)` gets the pair "
                "`(p, q)`: call `from_spinors(y)` or `from_pair(y)` in it."
            )
        raise


def _real_phi(phi: Callable, t: RealScalarLike, y: Y, args: Args) -> PyTree[Array]:
    """The values of the user's `phi`. Raises an error unless they are real arrays."""
    values = call_user_function("phi", phi, t, y, args=args)
    check_real("phi", jtu.tree_leaves(values))
    return values
