"""Expectations after many steps without sampling, for nonlinear models of two or three
variables and little noise."""

from collections.abc import Callable, Iterable

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds

from ._gallery import briefly
from ._orders import Errors


def _iterates(fn: Callable, x, count: int) -> np.ndarray:
    """`x`, `fn(x)`, `fn(fn(x))` and so on."""
    xs = [np.asarray(x)]
    for _ in range(count):
        xs.append(np.asarray(fn(xs[-1])))
    return np.stack(xs)


# Below it, the mean hardly leaves the straight line between the ends of a step.
_SMALL = 1 / 16


def transfer_expectations(
    make_terms: Callable,
    make_path: Callable,
    solver,
    y0,
    phi: Callable,
    hs: Iterable[float],
    widths: tuple[float, ...],
    degree: int,
    t1: float = 1.0,
) -> np.ndarray:
    r"""$\mathbb E[\phi(y_N)]$ for each step size $h = t_1 / N$.

    Backwards in time, $u_N = \phi$ and $u_n(y) = \mathbb E[u_{n+1}(y_1(y))]$, a sum over
    the outcomes of one step. Each $u_n$ is a polynomial of `degree` in each variable, by
    its values at Chebyshev points of a box. The boxes follow the path of the means and
    have the half widths `widths * sqrt(t + h)`: take several standard deviations of what
    the noise adds in a unit of time. Small steps use the path of the means of a larger
    one, which is close enough for a box.
    """
    terms = make_terms(make_path(jr.key(0)))
    flat, unravel = jfu.ravel_pytree(y0)
    # Of a type that does not depend on what it came from: else `back` is compiled anew.
    ravel = lambda y: jfu.ravel_pytree(y)[0].astype(flat.dtype)
    flat, n = ravel(y0), flat.size
    grid, fit = _interpolation(degree, n)

    @jax.jit
    def back(u, h, box0, box1):
        """The polynomial on `box0` of that on `box1`, and the mean from the centre."""

        def fn(t, y, args):
            return _chebyshev_series(u, (ravel(y) - box1[0]) / box1[1]), ravel(y)

        def expected(x):
            y = unravel(box0[0] + box0[1] * x)
            return ds.step_expectation(terms, solver, 0.0, h, y, fn=fn)

        values, means = jax.vmap(expected)(np.concatenate([grid, np.zeros((1, n))]))
        return fit(values[:-1]).astype(flat.dtype), means[-1]

    @briefly
    def at_end(box):
        values = jax.vmap(lambda x: phi(unravel(box[0] + box[1] * x)))(grid)
        return fit(values).astype(flat.dtype)

    at_start = briefly(lambda u: _chebyshev_series(u, jnp.zeros(n)))
    zero = jnp.zeros((degree + 1,) * n)
    out, path = [], None
    for h in hs:
        steps = round(t1 / h)
        ts = h * np.arange(steps + 1)
        if path is None or h >= _SMALL:
            size = np.asarray(widths)
            follow = lambda mean: back(zero, h, (mean, size), (mean, size))[1]
            path = ts, _iterates(follow, flat, steps)
        centres = [np.interp(ts, path[0], x) for x in path[1].T]
        sizes = np.asarray(widths) * np.sqrt(ts + h)[:, None]
        boxes = [*zip(np.stack(centres, axis=1).astype(flat.dtype), sizes)]
        u = at_end(boxes[-1])
        for i in reversed(range(steps)):
            u, _ = back(u, h, boxes[i], boxes[i + 1])
        out.append(float(at_start(u)))
    return np.array(out)


def _interpolation(degree: int, n: int) -> tuple[np.ndarray, Callable]:
    """The Chebyshev points of the cube [-1, 1]^n, and what takes values at these to the
    coefficients of the polynomial through them."""
    points = np.cos(np.pi * (np.arange(degree + 1) + 0.5) / (degree + 1))
    to_coefficients = np.linalg.inv(np.polynomial.chebyshev.chebvander(points, degree))
    grid = np.stack(np.meshgrid(*[points] * n, indexing="ij"), axis=-1).reshape(-1, n)

    def fit(values):
        u = values.reshape((degree + 1,) * n)
        for axis in range(n):
            u = jnp.moveaxis(jnp.tensordot(to_coefficients, u, (1, axis)), 0, axis)
        return u

    return grid, fit


def _chebyshev_series(coefficients, x):
    """The polynomial with a coefficient for each product of Chebyshev polynomials, one
    in each variable, at the point `x`."""
    T = [jnp.ones_like(x), x]
    for _ in range(len(coefficients) - 2):
        T.append(2 * x * T[-1] - T[-2])
    for axis in range(len(x)):
        coefficients = jnp.tensordot(jnp.stack(T)[:, axis], coefficients, 1)
    return coefficients


def transfer_weak_errors(
    make_terms: Callable,
    solvers: dict,
    y0,
    phi: Callable,
    hs: Iterable[float],
    widths: tuple[float, ...],
    degree: int,
    *,
    exact: float | None = None,
    reference: str | None = None,
) -> tuple[dict[str, Errors], float]:
    """The errors of all `solvers`, each a pair of a solver and a path, and the exact
    expectation. Where that is not known, it is Richardson's extrapolation of `reference`,
    one of them, which is of weak order 2."""
    hs = np.array([*hs])
    expectations = {}
    for name, (solver, path) in solvers.items():
        steps = [*hs, hs[-1] / 2] if name == reference else hs
        expectations[name] = transfer_expectations(
            make_terms, path, solver, y0, phi, steps, widths, degree
        )
    if exact is None:
        coarse, fine = expectations[reference][-2:]
        exact = float(fine + (fine - coarse) / 3)
    signed = {name: values[: len(hs)] - exact for name, values in expectations.items()}
    return {name: Errors(hs, s, np.zeros_like(hs)) for name, s in signed.items()}, exact


def enumerated_expectation(terms, solver, y0, phi: Callable, h, steps: int):
    r"""The same by all paths there are: $3^N$ for one noise and $N$ steps."""
    if steps == 0:
        return phi(y0)
    then = lambda t, y, args: enumerated_expectation(
        terms, solver, y, phi, h, steps - 1
    )
    return ds.step_expectation(terms, solver, 0.0, h, y0, fn=then)
