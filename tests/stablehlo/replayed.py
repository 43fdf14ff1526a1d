"""Programs of JAX, replayed for many lanes by the entrance of `_stablehlo`."""

import contextlib
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from diffrax_symplectic._stablehlo import (
    array_in_memory,
    array_types,
    dr,
    Replay,
    Tensor,
)


def text_of(fn: Callable, *structs: jax.ShapeDtypeStruct) -> str:
    """The program of a function in StableHLO, with the lines that it comes from."""
    # For CPUs on every device: for others JAX emits calls of libraries.
    with jax.default_device(jax.devices("cpu")[0]):
        lowered = jax.jit(fn, keep_unused=True).lower(*structs)
    return lowered.as_text(debug_info=True)


@contextlib.contextmanager
def recorded_lines():
    """Programs that are made within say which lines they come from."""
    limit = jax.config.jax_traceback_in_locations_limit  # pyright: ignore
    jax.config.update("jax_traceback_in_locations_limit", 10)
    try:
        yield
    finally:
        jax.config.update("jax_traceback_in_locations_limit", limit)


def replayed(program: Callable | str, *args: np.ndarray) -> list[np.ndarray]:
    """What Dr.Jit makes of a function, or of the text of a program, for each of the lanes,
    along the first axis of each argument."""
    results, lost = replayed_lanes(program, *args)
    assert not np.any(lost)
    return results


def replayed_and_by_jax(functions: dict[str, Callable], *args: np.ndarray):
    """The name of each of these functions, what is replayed, and what JAX gives: all in one
    program, since most of the time is compiling."""
    every = lambda *args: [fn(*args) for fn in functions.values()]
    exact = map(np.asarray, jax.jit(jax.vmap(every))(*args))
    for name, x, y in zip(functions, replayed(every, *args), exact, strict=True):
        assert x.dtype == y.dtype and x.shape == y.shape, name
        yield name, x, y


def replayed_lanes(
    program: Callable | str, *args: np.ndarray
) -> tuple[list[np.ndarray], np.ndarray]:
    """As `replayed`, and which lanes fail."""
    if not isinstance(program, str):
        structs = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in args]
        program = text_of(program, *structs)
    replay = Replay(program)
    tensors = [tensor(x, of.kind) for x, of in zip(args, replay.arguments)]
    results, errors = replay(*tensors, constants=replay.constants())
    dr.eval(errors, *[result.entries for result in results])
    number = len(args[0])
    arrays = [
        stacked(x, of.kind, number).reshape(number, *x.shape)
        for x, of in zip(results, replay.results, strict=True)
    ]
    lost = [lanes(error, number) for error in errors]
    return arrays, np.any([np.zeros(number, bool), *lost], axis=0)


def stacked(x: Tensor, kind: str, number: int) -> np.ndarray:
    """The values of all entries in each lane, along the last axis."""
    if not x.entries:
        return np.zeros((number, 0), lanes(array_types()[kind](0), 1).dtype)
    return np.stack([lanes(entry, number) for entry in x.entries], -1)


def tensor(x: np.ndarray, kind: str) -> Tensor:
    """An array with an axis of lanes as a tensor."""
    columns = x.reshape(len(x), -1).T
    return Tensor([array_in_memory(kind, column) for column in columns], x.shape[1:])


def lanes(entry: Any, number: int) -> np.ndarray:
    """The values of an entry in each lane."""
    if not dr.is_complex_v(entry):
        return np.broadcast_to(np.asarray(entry), number)
    unit = np.array(1j, f"c{2 * dr.itemsize_v(entry)}")
    return lanes(entry.real, number) + unit * lanes(entry.imag, number)
