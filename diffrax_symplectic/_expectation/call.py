"""Arguments that `expectation` and `monte_carlo` have in common."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from .._arguments import whole_number
from .._custom_types import Devices
from .._simulation import checked_key
from .estimate import Expectation


class CheckedCall(NamedTuple):
    """Arguments that are known to be valid.

    - `key`: as a typed key.
    - `first`: the number of the first sample.
    - `devices`: all that share the work.
    """

    key: PRNGKeyArray
    first: int
    devices: Devices


def checked_call(
    user: str,
    key: Any,
    tol: Any = None,
    start: Any = None,
    first: Any = 0,
    devices: Sequence[Any] | None = None,
    others: Any = (),
) -> CheckedCall:
    """Raises a `ValueError` for invalid arguments of `user`, the function called, and for
    traced arrays in `key` and in the `others`."""
    key = checked_key(user, key, others)
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
    return CheckedCall(key, first, tuple(devices))
