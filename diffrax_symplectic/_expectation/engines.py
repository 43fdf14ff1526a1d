"""Simulates the paths of a batch with either engine. Both take a problem, the random key
that all samples share, and consecutive sample numbers."""

import functools as ft
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Bool, PRNGKeyArray, PyTree

from .._fused import Kernels, sample_key, split
from .._lapack import lapack_in_turn
from .._stablehlo import NotReplayed
from .._terms import path_keys, with_keys
from ._problem import Problem
from ._steps import independent_steps, simulate


# Beyond this share, stragglers take most of the time.
_MANY = 0.05


def warn_of_stragglers(stragglers: int, lost: int, count: int, stacklevel: int) -> None:
    """Warns if JAX simulated many of `count` paths again, of which `lost` failed."""
    if stragglers - lost > _MANY * count:
        warnings.warn(
            f"{stragglers:,} of {count:,} paths had steps that the fused kernel did not "
            "solve, and were simulated again by JAX. Take smaller steps, or "
            '`engine="jax"`.',
            stacklevel=stacklevel + 1,
        )


class Batch(NamedTuple):
    """Paths along the first axis of each array, saved times along the second.

    - `y`: the states.
    - `failed`: which paths failed. Their states are meaningless.
    - `stragglers`: how many paths the fused kernel handed back to JAX.
    """

    y: PyTree[np.ndarray]
    failed: Bool[np.ndarray, " n"]
    stragglers: int = 0


def state_itself(t, y, args):
    """The function to average if the states themselves are wanted."""
    del t, args
    return y


def by_jax(p: Problem, key: PRNGKeyArray, numbers: np.ndarray, level: int = 0) -> Batch:
    """With the loop of `expectation`."""
    y, failed = jax.device_get(_paths(p, key, *_halves(numbers)))
    return Batch(jtu.tree_map(lambda x: x[level], y), failed[level])


def _halves(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The high and the low 32 bits."""
    high = (numbers >> np.uint64(32)).astype(np.uint32)
    return high, (numbers & np.uint64(0xFFFFFFFF)).astype(np.uint32)


@eqx.filter_jit
def _drawn(p: Problem, key: PRNGKeyArray, hi, lo) -> tuple[PyTree, PyTree]:
    """`Problem.drawn` for the paths of a batch."""
    return jax.vmap(p.drawn)(jax.vmap(ft.partial(sample_key, key))(hi, lo))


@eqx.filter_jit
@lapack_in_turn
def _paths(p: Problem, key: PRNGKeyArray, hi, lo):
    keys = jax.vmap(ft.partial(sample_key, key))(hi, lo)
    own = jax.vmap(lambda key: path_keys(p.terms, key))(keys)
    terms_of = lambda keys: with_keys(p.terms, keys)
    drawn = jax.vmap(p.drawn)(keys)
    begin = lambda level: independent_steps(p, level, drawn, terms_of, lambda i: own)
    states, failed, _ = simulate(p, begin)
    return p.unravel(jnp.swapaxes(states, 1, 2)), failed


def by_drjit(
    p: Problem, key: PRNGKeyArray, numbers: np.ndarray, level: int = 0
) -> Batch:
    """With a fused kernel. JAX simulates again the paths that the kernel could not finish.

    Raises an `ImportError` without Dr.Jit, and a `ValueError` if the system cannot be
    replayed."""
    layout, arrays = split(p, key)
    grid, n = p.level(level), len(numbers)
    try:
        kernels = _kernels(layout)
        drawn = p.y0, None
        if p.paths_differ:
            drawn = _drawn(p, key, *_halves(numbers))
        first = int(numbers[0])
        paths, parameters = kernels.begin(arrays, key, grid.h, first, n, *drawn)
        saves = np.asarray(grid.saved_steps)
        kept, done = {}, 0
        for step in np.unique(saves):
            if step > done:
                paths = kernels.advance(paths, parameters, done, int(step))
            kept[step], done = [*map(np.asarray, paths.y)], step
        stopped = np.asarray(paths.stopped)
    except (NotReplayed, RuntimeError) as error:
        if (refused := _refused(error)) is not None:
            raise refused from None
        raise
    at_times = [
        np.stack([kept[s][k] for s in saves], axis=1) for k in range(len(paths.y))
    ]
    y = _unraveled(p.y0, at_times)
    (which,) = np.nonzero(stopped)
    if len(which) == 0:
        return Batch(y, stopped)
    # Rounded up to a power of four, so that JAX compiles few programs.
    size = min(n, 4 ** int(np.ceil(np.log(len(which)) / np.log(4))))
    rest = by_jax(p, key, numbers[np.resize(which, size)], level)
    y = jtu.tree_map(np.array, y)
    for x, own in zip(jtu.tree_leaves(y), jtu.tree_leaves(rest.y)):
        x[which] = own[: len(which)]
    failed = np.zeros(n, bool)
    failed[which] = rest.failed[: len(which)]
    return Batch(y, failed, len(which))


# A kernel keeps what the user's functions capture.
@ft.lru_cache(maxsize=8)
def _kernels(layout: Any) -> Kernels:
    return Kernels(layout)


def _unraveled(y0: PyTree, numbers: list[np.ndarray]) -> PyTree[np.ndarray]:
    """The state, from its entries, each with axes for paths and times."""
    leaves, treedef = jtu.tree_flatten(y0)
    ends = np.cumsum([0, *[x.size for x in leaves]])
    stack = lambda x, i: np.stack(numbers[i : i + x.size], axis=-1)
    each = [
        stack(x, i).reshape(*numbers[0].shape, *x.shape) for x, i in zip(leaves, ends)
    ]
    return treedef.unflatten(each)


def _refused(error: BaseException | None) -> ValueError | None:
    """The error for the user if an operation cannot be replayed. Dr.Jit wraps errors of the
    functions with which it records a loop."""
    while error is not None and not isinstance(error, NotReplayed):
        error = error.__cause__ or error.__context__
    if error is None:
        return None
    return ValueError(
        f'`engine="drjit"` cannot replay {error}{_origin(error.location)}. Pass '
        '`engine="jax"`, or write the function without it.'
    )


def _origin(location: str) -> str:
    """The function of the user's code that an operation comes from, if JAX recorded it: the
    first one outside of installed packages."""
    frames = re.findall(r'"([^"]*)"\("([^"]+)":(\d+)', location)
    own = str(Path(__file__).parents[1])
    for name, file, line in frames:
        if "site-packages" not in file and not file.startswith(own):
            return f", which `{name.split('.')[-1]}` needs ({file}, line {line})"
    return ""


ENGINES: dict[str, Callable[..., Batch]] = {
    "jax": by_jax,
    "drjit": by_drjit,
}
