import warnings

import diffrax
import jax.tree_util as jtu
import numpy as np

from .._compat import innermost_solve, innermost_times


def require_fixed_steps(path: diffrax.AbstractBrownianPath) -> None:
    """Raises a `ValueError` if the solve being traced may change its step size, as far as
    that can be known.

    Weak and truncated increments, whose law depends on the size of the step, are not the
    increments of one path. They cannot be refined. To accept or reject a step depending on
    them would change their law. Diffrax refuses its own `UnsafeBrownianPath` for this
    reason, by name, and tells a path nothing about the step size controller.

    The solvers of this package give no error estimate, and without one Diffrax refuses
    adaptive steps. For other solvers this function looks for the innermost solve on the
    Python stack. It does not find a solve if the increments were traced before, by a
    `jax.jit` of the user's around `evaluate`.
    """
    name = type(path).__name__
    solve = innermost_solve()
    if solve is None or not _holds(solve.get("terms"), type(path)):
        return
    _check_times(path)
    controller = solve.get("stepsize_controller")
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        raise ValueError(
            f"`{name}` cannot be used with the adaptive step size controller "
            f"`{type(controller).__name__}`: its increments belong to one step size and "
            "cannot be refined. Pass `stepsize_controller=diffrax.ConstantStepSize()` (or "
            "`diffrax.StepTo`), or use `diffrax.VirtualBrownianTree` as path."
        )
    if isinstance(solve.get("solver"), diffrax.HalfSolver):
        raise ValueError(
            f"`{name}` cannot be used with `diffrax.HalfSolver`: the increments of the "
            "two half steps do not add up to the one of the whole step. Pass the wrapped "
            "solver itself, or use `diffrax.VirtualBrownianTree` as path."
        )


def _check_times(path: diffrax.AbstractBrownianPath) -> None:
    """Looks at the times of the solve, where these are numbers. A `ValueError` if they are
    no multiples of the path's `cell`. Without cells, a warning if `dt0` does not divide the
    interval. (Steps of other controllers, and times that are traced, are checked when
    run.)"""
    times = innermost_times()
    if times is None:
        return
    cell, number = getattr(path, "cell", None), int | float | np.number
    if cell is not None:
        for name, time in zip(("t0", "t1", "dt0"), times):
            if isinstance(time, number) and not _divides(cell, time):
                raise ValueError(
                    f"Steps of a `{type(path).__name__}` with `cell` must begin and end at "
                    f"multiples of `cell`; got cell={cell} and {name}={time}. Pass a "
                    "`cell` that divides `t0`, `t1` and `dt0`."
                )
    elif all(isinstance(x, number) for x in times):
        t0, t1, dt0 = times
        if not _divides(dt0, t1 - t0):
            warnings.warn(
                f"`dt0={dt0}` does not divide the time from {t0} to {t1}: the last step is "
                "a shorter one. For `n` equal steps pass `dt0=(t1 - t0) / n`.",
                stacklevel=2,
            )


def _divides(part: float, whole: float) -> bool:
    with np.errstate(all="ignore"):  # What is not finite is refused elsewhere.
        count = np.divide(float(whole), float(part))
        return not np.abs(count - np.rint(count)) > 1e-3


def _holds(terms, kind: type) -> bool:
    """Whether a path of this kind drives the terms. A path may also be evaluated within a
    solve that it does not drive, whose steps it does not restrict."""
    is_path = lambda x: isinstance(x, kind)
    return any(map(is_path, jtu.tree_leaves(terms, is_leaf=is_path)))
