"""Arguments that `expectation` and `monte_carlo` have in common."""

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import PRNGKeyArray

from .._arguments import is_real_number, whole_number
from .._custom_types import Devices
from .._simulation import checked_key
from .estimate import Expectation
from .sampling import MOST_SAMPLES


def checked_call(
    function_name: str,
    key: Any,
    tol: Any = None,
    start: Any = None,
    first: Any = 0,
    devices: Sequence[Any] | None = None,
    other_arguments: Any = (),
) -> tuple[PRNGKeyArray, int, Devices]:
    """Checks the arguments of a call of `function_name`. Raises a `ValueError` for an
    invalid argument, and for traced arrays in `key` and in `other_arguments`. Returns

    - the key as a typed key;
    - the number of the first sample;
    - the devices: for `None`, all that there are."""
    key = checked_key(function_name, key, other_arguments)
    if start is not None and first != 0:
        raise ValueError(
            "Pass either `start`, which continues after its last sample, or `first`."
        )
    first = whole_number("first", first, 0, MOST_SAMPLES - 1)
    is_number = is_real_number(tol) and np.ndim(tol) == 0
    # Positive numbers below `tiny` have fewer digits, and some processors take them for
    # zero.
    if tol is not None and not (is_number and np.finfo(float).tiny <= tol < np.inf):
        raise ValueError(f"`tol` must be a positive number, or `None`; got {tol!r}.")
    if start is not None and not isinstance(start, Expectation):
        raise ValueError(
            f"`start` must be what `{function_name}` returned, or `None`; got {start!r}."
        )
    devices = jax.devices() if devices is None else devices
    is_sequence = isinstance(devices, Sequence) and len(devices) > 0
    if not is_sequence or not all(isinstance(x, jax.Device) for x in devices):
        raise ValueError(
            "`devices` must be a list of one or more devices, such as `jax.devices()[:1]`, "
            f"or `None`; got {devices!r}."
        )
    if len(set(devices)) < len(devices):
        raise ValueError(f"`devices` must differ; got {devices!r}.")
    return key, first, tuple(devices)
