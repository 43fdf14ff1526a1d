"""Friction `dp = -gamma p dt`: its rates, its exact flow, and the exact law of its noise
over a step."""

import functools as ft
import itertools as it
from collections.abc import Callable
from typing import Any, cast, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from .._batch import materialize
from .._compat import direction, nondifferentiable, ω
from .._custom_types import Args, RealScalarLike, Y
from .._terms import rate, split_terms


# The documentation of this argument in all solvers.
GAMMA = """the friction rate, in units of one over time: a number; or an array or PyTree
    like `p`, whose arrays are scalars, have one rate for each momentum, or are matrices
    (with the shape of the momenta twice, `(n, n)` for `n` momenta). A matrix must be
    symmetric positive semidefinite, or become so with the masses $M$ of $V(p) = p \\cdot
    M^{-1} p / 2$: for a friction tensor $\\Gamma$ with $\\mathrm{d}p = -\\Gamma M^{-1}
    p\\,\\mathrm{d}t$ pass `Gamma / mass`. Paths whose traced `gamma` violates this fail.
    Differentiable, with respect to matrices only once."""


class Fault(NamedTuple):
    """Why an array of `gamma` cannot serve as a matrix, or only with `masses` that make it
    symmetric."""

    reason: str
    masses: bool = False


# Of arrays that are traced or not a matrix. Their place may be taken by a matrix, as in
# `eqx.tree_at`, or if they are a batch of matrices.
UNKNOWN = Fault("it is not", masses=True)


def checked(gamma: PyTree) -> PyTree:
    """`gamma`, after a check of all values that are not traced."""
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
        if not np.all(np.isfinite(values)):
            raise ValueError(f"`gamma` must be finite; got {leaf!r}.")
        if np.all(values >= 0):
            continue
        if not is_square(values.shape):
            raise ValueError(
                "`gamma` must not be negative: it is the rate at which momentum decays; "
                f"got {leaf!r}."
            )
        fault = _matrix_fault(values)
        if fault is not None and not fault.masses:
            raise ValueError(
                "`gamma` has negative entries, which only a symmetric positive "
                f"semidefinite matrix may have, but {fault.reason}; got {leaf!r}."
            )
    return gamma


def matrix_faults(gamma: PyTree) -> tuple[Fault | None, ...]:
    """Why each array of `gamma` cannot serve as a matrix; `None` if it can. Whether it must
    is known only from the shape of the momenta."""
    return tuple(map(_matrix_fault, jtu.tree_leaves(gamma)))


def is_square(shape: tuple[int, ...]) -> bool:
    """Whether this is the shape of some momenta twice."""
    half = len(shape) // 2
    return half > 0 and shape == shape[:half] * 2


def _matrix_fault(g: ArrayLike) -> Fault | None:
    if isinstance(g, jax.core.Tracer) or not is_square(jnp.shape(g)):
        return UNKNOWN
    n = round(jnp.size(g) ** 0.5)
    matrix = np.reshape(np.asarray(g), (n, n))
    if not np.all(np.isfinite(matrix)):
        return Fault("it is not finite")
    eps = np.finfo(np.result_type(matrix, np.float32)).eps
    size = 100 * eps * np.max(np.abs(matrix), initial=0)
    symmetric = np.all(np.abs(matrix - matrix.T) <= size)
    # A matrix that some masses make symmetric has real eigenvalues, too.
    rates = np.linalg.eigvalsh(matrix) if symmetric else np.linalg.eigvals(matrix)
    bound = size * len(matrix) * (1 if symmetric else eps**-0.5)
    if not symmetric and np.any(np.abs(rates.imag) > bound):
        return Fault("it is not symmetric, and has complex eigenvalues")
    if np.any(rates.real < -bound):
        return Fault(f"it has the negative eigenvalue {np.min(rates.real):.3g}")
    return None if symmetric else Fault("it is not symmetric", masses=True)


class Modes(NamedTuple):
    r"""A friction matrix as `left @ diag(rates) @ right`, where `left` and `right` are
    inverses of each other."""

    rates: Float[Array, " n"]
    left: Float[Array, "n n"]
    right: Float[Array, "n n"]


def friction_modes(
    gamma: PyTree[ArrayLike],
    faults: tuple[Fault | None, ...],
    p: PyTree[Array],
    velocity: Callable[[PyTree[Array]], PyTree[Array]],
) -> list[Modes | None]:
    """The modes of `gamma` for each array of `p`; `None` where it is not a matrix. They are
    constant during a solve. The masses come from `velocity(p)`. Raises a `ValueError` if
    `gamma` does not fit `p`."""
    found = []
    each = zip(_for_each(gamma, p), jtu.tree_leaves(p), it.cycle(faults))
    for i, (g, x, fault) in enumerate(each):
        if jnp.shape(g) in ((), jnp.shape(x)):
            found.append(None)
            continue
        if jnp.shape(g) != jnp.shape(x) * 2:
            raise ValueError(
                "An array of `gamma` must be a scalar, or have the shape of its momenta, "
                f"{jnp.shape(x)}, or as a matrix the shape {jnp.shape(x) * 2}; got shape "
                f"{jnp.shape(g)}."
            )
        matrix = _as_matrix(jax.lax.stop_gradient(g), x)
        if fault is None:
            modes, fault = _modes(matrix), UNKNOWN
        else:
            modes = _with_masses(matrix, _inverse_mass(velocity, p, i))
        known = not isinstance(modes.rates, jax.core.Tracer)
        says = (
            "`gamma` must be a symmetric positive semidefinite matrix for momenta of "
            f"shape {jnp.shape(x)}, or become one with the masses of H0, but "
            f"{fault.reason}."
        )
        if not fault.masses or known and np.any(np.isnan(modes.rates)):
            raise ValueError(says)
        if fault != UNKNOWN:
            # Only the masses are traced.
            bad = jnp.any(jnp.isnan(modes.rates))
            modes = modes._replace(rates=eqx.error_if(modes.rates, bad, says))
        found.append(modes)
    return found


def velocity_of(terms: PyTree[diffrax.AbstractTerm], t0, y0: Y, args: Args) -> Callable:
    """The velocities as a function of the momenta, at the start of a solve."""
    drift, _ = split_terms(terms)
    # In a solve backward in time they change sign.
    return lambda p: (direction(terms) * rate(drift, t0, (p, y0[1]), args)[1] ** ω).ω


def _inverse_mass(velocity: Callable, p: PyTree[Array], number: int) -> Array:
    """The derivative of the velocities with respect to one of the arrays of `p`."""
    leaves, treedef = jtu.tree_flatten(jax.lax.stop_gradient(p))
    x = leaves[number]

    def of(flat):
        changed = [*leaves]
        changed[number] = flat.reshape(jnp.shape(x))
        return jnp.ravel(jtu.tree_leaves(velocity(treedef.unflatten(changed)))[number])

    return jax.lax.stop_gradient(jax.jacfwd(of)(jnp.ravel(x)))


def friction_result(
    gamma: PyTree[ArrayLike], modes: list[Modes | None], result: diffrax.RESULTS
) -> diffrax.RESULTS:
    """`result`, or `RESULTS.nonfinite` if `gamma` turns out to be invalid (negative, not
    finite, or as a matrix not symmetric positive semidefinite)."""
    bad = [
        _no_rate(g) if mode is None else jnp.any(jnp.isnan(mode.rates))
        for g, mode in zip(it.cycle(jtu.tree_leaves(gamma)), modes)
    ]
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
    # Traced values cannot raise an error; NaN makes their path fail.
    bad = ~_is_symmetric(matrix) | ~jnp.all(rates >= -size * len(matrix))
    return Modes(jnp.where(bad, jnp.nan, jnp.maximum(rates, 0)), axes, axes.T)


def _with_masses(
    matrix: Float[Array, "n n"], inverse_mass: Float[Array, "n n"]
) -> Modes:
    r"""The modes of a symmetric matrix, or of $\gamma = \Gamma M^{-1}$ with a symmetric
    $\Gamma$. With $M^{-1} = L L^\top$, $\gamma = L^{-\top} (L^\top \Gamma L) L^\top$."""
    one = jnp.eye(len(matrix), dtype=matrix.dtype)
    root = jnp.linalg.cholesky(inverse_mass)
    up = jnp.where(_is_symmetric(matrix), one, root.T)
    down = jax.scipy.linalg.solve_triangular(up, one)
    modes = _modes(_dot(_dot(up, matrix), down))
    return Modes(modes.rates, _dot(down, modes.left), _dot(modes.right, up))


def _is_symmetric(matrix: Float[Array, "n n"]) -> Bool[Array, ""]:
    size = 100 * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(matrix))
    return jnp.max(jnp.abs(matrix - matrix.T)) <= size


def decay(x: Array) -> Array:
    """The factor by which a momentum decays in `x` times its relaxation time."""
    return jnp.exp(-x)


def spread(x: Array) -> Array:
    r"""The standard deviation of $\int_0^t e^{-\gamma (t - s)} \mathrm{d}w_s$ in units of
    $\sqrt t$, with $x = \gamma t$: the root of $(1 - e^{-2 x}) / (2 x)$. $x$ may be
    negative."""
    near = jnp.abs(x) < 0.1
    y = jnp.where(near, x, 0) ** 2
    # sinh(x) / x, without cancellation.
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
    """The sum of `fn(gamma time) p` over `(fn, p)` in `parts`. Where `gamma` is a matrix,
    `fn` is a matrix function."""
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

    # All paths of a batch share these factors. Fused into the loop over the batch, they
    # would be recomputed for each path.
    fixed = materialize(factors)
    summed = map(each, fixed, rates, modes, times, leaves)
    return jtu.tree_structure(ps[0]).unflatten(summed)


def _like(x: ArrayLike, y: Array) -> Array:
    return jnp.asarray(x, jnp.result_type(y))


def _factor(fn: Callable[[Array], Array], g: Array, time: Array) -> Array:
    # Traced values cannot raise an error; NaN makes their path fail.
    return jnp.where(_no_rate(g), jnp.nan, fn(g * time))


_dot = ft.partial(jnp.matmul, precision=jax.lax.Precision.HIGHEST)


# Modes with equal rates are not unique and have no derivative, but the matrix function has.
@ft.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _of_matrix(fn, matrix, modes: Modes, time, x) -> Array:
    rates, left, right = modes
    return _dot(left, fn(rates * time) * _dot(right, x))


@_of_matrix.defjvp
def _(fn, primals, tangents):
    matrix, modes, time, x = primals
    d_matrix, _, d_time, d_x = tangents
    # The modes are treated as constants, so a second derivative would be wrong. With the
    # modes behind the guard of the matrix, JAX cannot drop it as unused.
    name = "the matrix `gamma`, a second time"
    matrix, modes = cast(Any, nondifferentiable((matrix, modes), name=name))
    rates, left, right = modes
    along = lambda v: _dot(right, v)
    change = _dot(along(d_matrix), left) * time + jnp.diag(rates * d_time)
    quotients = _divided_differences(fn, rates * time)
    d_out = fn(rates * time) * along(d_x) + _dot(quotients * change, along(x))
    return _of_matrix(fn, matrix, modes, time, x), _dot(left, d_out)


def root_of_matrix(matrix: Array) -> Array:
    """The symmetric root of a symmetric positive semidefinite matrix, in its shape."""
    flat = matrix.reshape(round(matrix.size**0.5), -1)
    modes = _modes(jax.lax.stop_gradient(flat))
    of = lambda x: _of_matrix(jnp.sqrt, flat, modes, jnp.ones((), flat.dtype), x)
    return jax.vmap(of)(jnp.eye(len(flat), dtype=flat.dtype)).reshape(matrix.shape)


def _divided_differences(fn: Callable, x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """`(fn(x_i) - fn(x_j)) / (x_i - x_j)`, and the derivative where they are equal."""
    gap = x[:, None] - x[None, :]
    near = jnp.abs(gap) < 1
    quotient = (fn(x)[:, None] - fn(x)[None, :]) / jnp.where(near, 1, gap)
    # The mean of the derivative between the two, by Gauss quadrature.
    points, weights = np.polynomial.legendre.leggauss(8)
    share = jnp.asarray((1 + points) / 2, x.dtype)
    between = x[None, :, None] + jnp.where(near, gap, 0)[..., None] * share
    slope = jax.jvp(fn, (between,), (jnp.ones_like(between),))[1]
    mean = jnp.sum(slope * jnp.asarray(weights / 2, x.dtype), axis=-1)
    return jnp.where(near, mean, quotient)
