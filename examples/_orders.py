"""Errors against the step size: exact where the model is linear, sampled otherwise."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds


class Errors(NamedTuple):
    hs: np.ndarray
    errors: np.ndarray
    # Standard errors; zero where the error is exact.
    std_errors: np.ndarray

    @property
    def slope(self) -> float:
        """The order that the errors show, by least squares over the steps whose error is
        clear of its own uncertainty and of rounding."""
        clear = (self.errors > 4 * self.std_errors) & (self.errors > 1e-13)
        if clear.sum() < 2:
            return np.nan
        return float(
            np.polyfit(np.log(self.hs[clear]), np.log(self.errors[clear]), 1)[0]
        )


def exact_moment_map(
    make_terms: Callable, make_path: Callable, solver: diffrax.AbstractSolver, y0
) -> Callable[[float], np.ndarray]:
    """What moves second moments by one step of size h, for a linear model."""
    terms = make_terms(make_path(jr.key(0)))
    step = jax.jit(lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0))
    return lambda h: np.asarray(step(h))


def exact_weak_error(
    moment_map: Callable,
    y0,
    quadratic: Callable,
    exact: float,
    hs: Iterable[float],
    t1: float = 1.0,
) -> Errors:
    """|E[phi(y_N)] - exact| for a linear model and phi(y) a quadratic form, given as
    `quadratic(E[y y^T])`, by the recursion of second moments: no sampling."""
    z0 = np.array([1.0, *(float(x) for x in jax.tree.leaves(y0))])
    errors = []
    for h in hs:
        K = np.linalg.matrix_power(moment_map(h), round(t1 / h))
        moments = (K @ np.kron(z0, z0)).reshape(len(z0), len(z0))
        errors.append(abs(quadratic(moments[1:, 1:]) - exact))
    return Errors(np.array([*hs]), np.array(errors), np.zeros(len(errors)))


def sampled_weak_error(
    make_terms: Callable,
    make_path: Callable,
    solver: diffrax.AbstractSolver,
    y0,
    phi: Callable,
    exact: float,
    hs: Iterable[float],
    paths: int,
    t1: float = 1.0,
) -> Errors:
    """The same, by Monte Carlo, with its standard error."""

    def sample(h, key):
        sol = diffrax.diffeqsolve(
            make_terms(make_path(key)),
            solver,
            0.0,
            t1,
            h,
            y0,
            max_steps=None,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        return phi(jax.tree.map(lambda y: y[-1], sol.ys)), sol.result

    means, errors = [], []
    for h in hs:
        # The step size as an array: compiled once for all of them.
        at_h = eqx.Partial(sample, jnp.asarray(h))
        estimate = ds.expectation(at_h, jr.key(round(t1 / h)), paths)
        assert estimate.num_failed == 0
        means.append(abs(float(estimate.mean) - exact))
        errors.append(float(estimate.std_error))
    return Errors(np.array([*hs]), np.array(means), np.array(errors))


class _FinePath(diffrax.AbstractBrownianPath):
    """A Brownian path over [0, t1] by the values of `w` and of its integral on a fine
    grid, so that every step size sees the same path, space-time areas included."""

    w: jax.Array
    integral: jax.Array
    end: float
    t0 = 0.0
    t1 = np.inf
    levy_area = diffrax.SpaceTimeLevyArea

    @staticmethod
    def draw(key, steps: int, m: int, t1: float) -> "_FinePath":
        dw, H = jr.normal(key, (2, steps, m)) * np.sqrt(t1 / steps)
        H = H / np.sqrt(12)
        from_zero = lambda x: jnp.concatenate([jnp.zeros_like(x[:1]), jnp.cumsum(x, 0)])
        w = from_zero(dw)
        integral = from_zero((w[:-1] + dw / 2 + H) * (t1 / steps))
        return _FinePath(w, integral, t1)  # pyright: ignore[reportCallIssue]

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del left
        assert t1 is not None
        at = lambda t: jnp.round(t / self.end * (len(self.w) - 1)).astype(int)
        W = self.w[at(t1)] - self.w[at(t0)]
        if not use_levy:
            return W
        h = jnp.asarray(t1 - t0)
        mean = (self.integral[at(t1)] - self.integral[at(t0)]) / h - self.w[at(t0)]
        return diffrax.SpaceTimeLevyArea(dt=h, W=W, H=mean - W / 2)


def strong_errors(
    make_terms: Callable,
    solvers: dict[str, diffrax.AbstractSolver],
    reference: diffrax.AbstractSolver,
    y0,
    hs: Iterable[float],
    m: int,
    paths: int,
    fine: int,
    component: Callable,
    t1: float = 1.0,
) -> dict[str, Errors]:
    """Root-mean-square errors of `component(y)` at `t1` against `reference` with `fine`
    steps on the same Brownian paths."""

    def end(path, solver, h):
        sol = diffrax.diffeqsolve(
            make_terms(path), solver, 0.0, t1, h, y0, max_steps=None
        )
        return component(jax.tree.map(lambda y: y[-1], sol.ys))

    steps = jnp.array([*hs])

    @jax.jit
    def one(key):
        path = _FinePath.draw(key, fine, m, t1)
        exact = end(path, reference, t1 / fine)
        run = lambda solver: jax.lax.map(lambda h: end(path, solver, h), steps)
        return {name: (run(s) - exact) ** 2 for name, s in solvers.items()}

    squares = jax.vmap(one)(jr.split(jr.key(0), paths))
    out = {}
    for name, x in squares.items():
        rms = np.sqrt(np.mean(x, axis=0))
        spread = np.std(x, axis=0) / np.sqrt(paths) / (2 * rms)
        out[name] = Errors(np.asarray(steps), rms, spread)
    return out


def report(title: str, results: dict[str, Errors]) -> None:
    print(f"\n{title}")
    for name, e in results.items():
        listed = " ".join(f"{x:8.1e}" for x in e.errors)
        print(f"{name:22} slope {e.slope:5.2f}   errors {listed}", flush=True)


def plot_orders(axes, title: str, results: dict[str, Errors], slopes=(1, 2)) -> None:
    """Errors with three standard errors, and reference slopes."""
    for i, (name, e) in enumerate(results.items()):
        dashed = "--" if name in dir(diffrax) and name != "Midpoint" else "-"
        label = name if np.isnan(e.slope) else f"{name} ({e.slope:.2f})"
        axes.errorbar(
            e.hs, np.maximum(e.errors, 1e-17), 3 * e.std_errors, label=label,
            color=f"C{i}", ls=dashed, marker="o", ms=3, lw=1, capsize=2,
        )  # fmt: skip
    first = next(iter(results.values()))
    for slope in slopes:
        line = first.errors[0] * (first.hs / first.hs[0]) ** slope
        axes.loglog(first.hs, line, "k:", lw=0.8)
        axes.annotate(f"{slope:g}", (first.hs[-1], line[-1]), fontsize=7)
    axes.set(xscale="log", yscale="log", xlabel="step size h", title=title)
    axes.set_xticks(first.hs, [f"$2^{{{np.log2(h):.0f}}}$" for h in first.hs])
    axes.minorticks_off()
    axes.legend(fontsize=7)
    axes.grid(alpha=0.3)
