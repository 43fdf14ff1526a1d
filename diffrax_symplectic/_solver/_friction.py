"""Friction `dp = -gamma p dt`: its rates, its exact flow, and the exact law of the noise
that comes with it over a step."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from .._batch import materialize
from .._compat import nondifferentiable
from .._custom_types import RealScalarLike


# What the solvers say of this argument.
GAMMA = """the friction, in units of one over time: a number; or an array or PyTree like
    `p`, each array a scalar, of the shape of its momenta, or a symmetric positive
    semidefinite matrix that acts on them, of that shape twice, `(n, n)` for `n` momenta. If
    it is traced and not so, the path fails. There are derivatives with respect to it; of
    a matrix only first ones."""


def checked(gamma: PyTree) -> PyTree:
    """`gamma`, after a check of those of its values that are not traced."""
    for leaf in jtu.tree_leaves(gamma):
        is_number = eqx.is_array_like(leaf) and not isinstance(leaf, bool)
        if not is_number or np.iscomplexobj(leaf):
            raise ValueError(
                "`gamma` must be a real number, an array or a PyTree of arrays; got "
                f"{leaf!r}."
            )
        if isinstance(leaf, jax.core.Tracer):
            continue
        values = np.asarray(leaf)
        negative = np.any(values < 0) and _matrix_fault(values) is not None
        if not np.all(np.isfinite(values)) or negative:
            raise ValueError(
                "`gamma` must be finite and not negative, or a symmetric positive "
                "semidefinite matrix: it takes momentum away at this rate; got "
                f"{leaf!r}."
            )
    return gamma


def matrix_faults(gamma: PyTree) -> tuple[str | None, ...]:
    """Why each array of `gamma` cannot serve as a matrix; `None` if it can, or if its
    values are traced. Whether it has to serve as one is seen from the momenta only."""
    known = lambda x: not isinstance(x, jax.core.Tracer)
    leaves = jtu.tree_leaves(gamma)
    return tuple(_matrix_fault(np.asarray(x)) if known(x) else None for x in leaves)


def _matrix_fault(values: np.ndarray) -> str | None:
    half = values.shape[: values.ndim // 2]
    if values.ndim == 0 or values.shape != half + half:
        return "it is no square matrix"
    matrix = values.reshape(int(np.prod(half)), -1)
    if not np.all(np.isfinite(matrix)):
        return "it is not finite"
    eps = np.finfo(np.result_type(matrix, np.float32)).eps
    size = 100 * eps * np.max(np.abs(matrix), initial=0)
    if np.any(np.abs(matrix - matrix.T) > size):
        return "it is not symmetric"
    if np.any(np.linalg.eigvalsh(matrix) < -size * len(matrix)):
        return "it has a negative eigenvalue"
    return None


class Modes(NamedTuple):
    """The eigenvalues and eigenvectors of a matrix of friction."""

    rates: Float[Array, " n"]
    axes: Float[Array, "n n"]


def friction_modes(
    gamma: PyTree[ArrayLike], faults: tuple[str | None, ...], p: PyTree[Array]
) -> list[Modes | None]:
    """The modes of `gamma` for each array of `p`; `None` where it is no matrix. They do not
    change during a solve. Raises a `ValueError` if `gamma` does not fit `p`."""
    leaves = jtu.tree_leaves(p)
    faults = faults if len(faults) == len(leaves) else faults * len(leaves)
    found = []
    for g, x, fault in zip(_for_each(gamma, p), leaves, faults):
        if jnp.shape(g) in ((), jnp.shape(x)):
            found.append(None)
            continue
        if jnp.shape(g) != jnp.shape(x) * 2:
            raise ValueError(
                "An array of `gamma` must be a scalar, or have the shape of its momenta, "
                f"{jnp.shape(x)}, or for a matrix of them {jnp.shape(x) * 2}; got shape "
                f"{jnp.shape(g)}."
            )
        if fault is not None:
            raise ValueError(
                "`gamma` must be a symmetric positive semidefinite matrix for momenta of "
                f"shape {jnp.shape(x)}, but {fault}; got {g}."
            )
        found.append(_modes(_as_matrix(jax.lax.stop_gradient(g), x)))
    return found


def friction_result(
    gamma: PyTree[ArrayLike], modes: list[Modes | None], result: diffrax.RESULTS
) -> diffrax.RESULTS:
    """`result`, or where values of `gamma` that were traced are no friction (negative, not
    finite, or as a matrix not symmetric positive semidefinite) `RESULTS.nonfinite`."""
    leaves = jtu.tree_leaves(gamma)
    leaves = leaves if len(leaves) == len(modes) else leaves * len(modes)
    bad = [
        _no_rate(g) if mode is None else jnp.any(jnp.isnan(mode.rates))
        for g, mode in zip(leaves, modes)
        if isinstance(g, jax.core.Tracer)
    ]
    if len(bad) == 0:
        return result
    R, bad = diffrax.RESULTS, ft.reduce(jnp.logical_or, bad)
    return R.where(bad, R.nonfinite, result)  # pyright: ignore


def _no_rate(g: ArrayLike) -> Bool[Array, ""]:
    g = jnp.asarray(g)
    return ~jnp.all(jnp.isfinite(g) & (g >= 0))


def _for_each(gamma: PyTree[ArrayLike], p: PyTree[Array]) -> list:
    """The array of `gamma` for each array of `p`."""
    if jtu.treedef_is_leaf(jtu.tree_structure(gamma)):
        gamma = jtu.tree_map(lambda _: gamma, p)
    if jtu.tree_structure(gamma) != jtu.tree_structure(p):
        raise ValueError(
            "`gamma` must be one number or array, or have the structure of the momenta "
            f"{eqx.tree_pformat(p)}; got {eqx.tree_pformat(gamma)}."
        )
    return jtu.tree_leaves(gamma)


def _as_matrix(g: ArrayLike, x: Array) -> Float[Array, "n n"]:
    return _like(g, x).reshape(jnp.size(x), jnp.size(x))


def _modes(matrix: Float[Array, "n n"]) -> Modes:
    rates, axes = jnp.linalg.eigh(matrix)
    size = 100 * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(matrix))
    skew = jnp.max(jnp.abs(matrix - matrix.T))
    # As below: values that are traced cannot raise an error.
    bad = ~(skew <= size) | ~jnp.all(rates >= -size * len(matrix))
    return Modes(jnp.where(bad, jnp.nan, jnp.maximum(rates, 0)), axes)


def decay(x: Array) -> Array:
    """What is left of a momentum after `x` times the time in which it falls by e."""
    return jnp.exp(-x)


def spread(x: Array) -> Array:
    r"""The standard deviation of $\int_0^t e^{-\gamma (t - s)} \mathrm{d}w_s$ in units of
    $\sqrt t$, with $x = \gamma t$: the root of $(1 - e^{-2 x}) / (2 x)$, also at $x < 0$.
    """
    near = jnp.abs(x) < 0.1
    y = jnp.where(near, x, 0) ** 2
    # sinh(x) / x, and no cancellation.
    sinhc = 1 + y / 6 * (1 + y / 20 * (1 + y / 42 * (1 + y / 72)))
    far = jnp.where(near, 1, x)
    other = -jnp.expm1(-2 * far) / (2 * far)
    return jnp.sqrt(jnp.where(near, jnp.exp(-x) * sinhc, other))


def apply_friction(
    gamma: PyTree[ArrayLike],
    modes: list[Modes | None],
    time: RealScalarLike,
    *parts: tuple[Callable[[Array], Array], PyTree[Array]],
) -> PyTree[Array]:
    """The sum of `fn(gamma time) p` over `(fn, p)` in `parts`, with functions of a matrix
    where `gamma` is one."""
    fns, ps = zip(*parts)
    leaves = list(zip(*map(jtu.tree_leaves, ps)))
    rates, times = _for_each(gamma, ps[0]), [_like(time, xs[0]) for xs in leaves]

    def factors():
        return [
            [_factor(fn, _like(g, xs[0]), t) for fn in fns] if mode is None else []
            for g, mode, t, xs in zip(rates, modes, times, leaves)
        ]

    def each(factors, g, mode, t, xs):
        if mode is None:
            return sum(factor * x for factor, x in zip(factors, xs))
        matrix = _as_matrix(g, xs[0])
        parts = zip(fns, map(jnp.ravel, xs))
        flat = sum(_of_matrix(fn, matrix, mode, t, x) for fn, x in parts)
        return jnp.reshape(flat, jnp.shape(xs[0]))

    # In a batch the factors are those of all paths. Fused into the loop over the batch,
    # they would be computed for each of them.
    fixed = materialize(factors)
    summed = map(each, fixed, rates, modes, times, leaves)
    return jtu.tree_structure(ps[0]).unflatten(summed)


def _like(x: ArrayLike, y: Array) -> Array:
    return jnp.asarray(x, jnp.result_type(y))


def _factor(fn: Callable[[Array], Array], g: Array, time: Array) -> Array:
    # Values that are traced cannot raise an error here. They make their path fail.
    return jnp.where(_no_rate(g), jnp.nan, fn(g * time))


_dot = ft.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


# The modes of equal rates are not unique and have no derivative. The function has one.
@ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _of_matrix(fn, matrix, modes: Modes, time, x) -> Array:
    rates, axes = modes
    return _dot(axes, fn(rates * time) * _dot(axes.T, x))


@_of_matrix.defjvp
def _(fn, primals, tangents):
    matrix, modes, time, x = primals
    d_matrix, _, d_time, d_x = tangents
    # The modes are constants here, so that a second derivative would be wrong.
    matrix = nondifferentiable(matrix, name="the matrix `gamma`, a second time")
    del matrix
    rates, axes = modes
    along = lambda v: _dot(axes.T, v)
    change = _dot(along(d_matrix), axes) * time + jnp.diag(rates * d_time)
    quotients = _divided_differences(fn, rates * time)
    d_out = fn(rates * time) * along(d_x) + _dot(quotients * change, along(x))
    return _of_matrix(fn, primals[0], modes, time, x), _dot(axes, d_out)


def _divided_differences(fn: Callable, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """`(fn(x_i) - fn(x_j)) / (x_i - x_j)`, and the derivative where they are equal."""
    gap = x[:, None] - x[None, :]
    near = jnp.abs(gap) < 1
    quotient = (fn(x)[:, None] - fn(x)[None, :]) / jnp.where(near, 1, gap)
    # The mean of the derivative between them, by Gauss's rule.
    points, weights = np.polynomial.legendre.leggauss(8)
    share = jnp.asarray((1 + points) / 2, x.dtype)
    between = x[None, :, None] + jnp.where(near, gap, 0)[..., None] * share
    slope = jax.jvp(fn, (between,), (jnp.ones_like(between),))[1]
    mean = jnp.sum(slope * jnp.asarray(weights / 2, x.dtype), axis=-1)
    return jnp.where(near, mean, quotient)
