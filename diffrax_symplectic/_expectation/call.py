"""Arguments that `expectation`, `ensemble` and `monte_carlo` have in common."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from .._arguments import check_untraced, whole_number
from .._brownian import check_key, typed_key
from .estimate import Expectation


NO_METER = diffrax.NoProgressMeter()


class CheckedCall(NamedTuple):
    """Arguments that are known to be valid.

    - `key`: as a typed key.
    - `first`: the number of the first sample.
    - `devices`: all that share the work.
    """

    key: PRNGKeyArray
    first: int
    devices: tuple[Any, ...]


def checked_call(
    user: str,
    key: Any,
    tol: Any = None,
    start: Any = None,
    first: Any = 0,
    devices: Sequence[Any] | None = None,
    others: Any = (),
) -> CheckedCall:
    """Raises a `ValueError` for invalid arguments of `user`, the function called, and if an
    array is traced, also in the `others`."""
    # Inside `jit` a new array is traced, too. Functions that close over traced values of
    # other transformations are found once something that depends on these is needed.
    new = jnp.zeros(())
    check_untraced(f"`{user}`", (key, others, new))
    check_key(key, user)
    if start is not None and first != 0:
        raise ValueError(
            "Pass either `start`, which continues after its last sample, or `first`."
        )
    first = whole_number("first", first, 0)
    is_number = isinstance(tol, int | float | np.number)
    if tol is not None and not (is_number and 0 < tol < np.inf):
        raise ValueError(f"`tol` must be a positive number, or `None`; got {tol!r}.")
    if start is not None and not isinstance(start, Expectation):
        raise ValueError(
            f"`start` must be what `{user}` returned, or `None`; got {start!r}."
        )
    devices = jax.devices() if devices is None else devices
    is_sequence = isinstance(devices, Sequence)
    if not is_sequence or not all(isinstance(x, jax.Device) for x in devices):
        raise ValueError(
            "`devices` must be a list of devices, such as `jax.devices()[:1]`, or `None`; "
            f"got {devices!r}."
        )
    return CheckedCall(typed_key(key), first, tuple(devices))


class Meter:
    """A progress meter of Diffrax, as a context manager."""

    def __init__(self, meter: diffrax.AbstractProgressMeter):
        self._meter = meter
        self._state = meter.init()

    def step(self, progress: float) -> None:
        """Shows the progress, from 0 to 1."""
        self._state = self._meter.step(self._state, np.asarray(progress))

    def __enter__(self) -> "Meter":
        return self

    def __exit__(self, *error: Any) -> None:
        self._meter.close(self._state)
