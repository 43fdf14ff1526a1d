"""Errors against the step size, exact and sampled, and the orders they show."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds

from ._gallery import briefly, claim, solve
from ._pictures import style


class Errors(NamedTuple):
    hs: np.ndarray
    # With their signs, where they have one.
    signed: np.ndarray
    # Standard errors; zero where the error is exact.
    std_errors: np.ndarray

    @property
    def errors(self) -> np.ndarray:
        return np.abs(self.signed)

    def _fit(self) -> tuple[float, float]:
        clear = (self.errors > 4 * self.std_errors) & (self.errors > 1e-13)
        last = np.flatnonzero(clear)[-5:]
        if len(last) < 2:
            return np.nan, np.nan
        x = np.log(self.hs[last])
        weights = (x - x.mean()) / np.sum((x - x.mean()) ** 2)
        relative = self.std_errors[last] / self.errors[last]
        slope = weights @ np.log(self.errors[last])
        return float(slope), float(np.linalg.norm(weights * relative))

    @property
    def slope(self) -> float:
        """The order that the errors show, by least squares over the five smallest steps
        whose error is clear of its own uncertainty and of rounding."""
        return self._fit()[0]

    @property
    def slope_std_error(self) -> float:
        return self._fit()[1]


def exact_moment_map(
    make_terms: Callable, make_path: Callable, solver: diffrax.AbstractSolver, y0
) -> Callable[[float], np.ndarray]:
    """What moves second moments by one step of size h, for a linear model."""
    terms = make_terms(make_path(jr.key(0)))
    step = briefly(lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0))
    return lambda h: np.asarray(step(h))


def second_moments(moment_map: Callable, y0, h: float, steps: int) -> np.ndarray:
    """E[y y^T] after so many steps."""
    z0 = np.array([1.0, *(float(x) for x in jax.tree.leaves(y0))])
    with np.errstate(all="ignore"):
        K = np.linalg.matrix_power(moment_map(h), steps)
        return (K @ np.kron(z0, z0)).reshape(len(z0), len(z0))[1:, 1:]


def exact_weak_error(
    moment_map: Callable,
    y0,
    quadratic: Callable,
    exact: float,
    hs: Iterable[float],
    t1: float = 1.0,
) -> Errors:
    """E[phi(y_N)] - exact for a linear model and phi(y) a quadratic form, given as
    `quadratic(E[y y^T])`, by the recursion of second moments: no sampling."""
    moments = [second_moments(moment_map, y0, h, round(t1 / h)) for h in hs]
    signed = np.array([quadratic(m) - exact for m in moments])
    return Errors(np.array([*hs]), signed, np.zeros_like(signed))


def resolved(hs: list[float], full: bool) -> list[float]:
    """The step sizes that are sampled. Only the paper's many paths resolve the errors of
    small steps, and a step that many paths fail to solve at once takes long."""
    return hs if full else hs[1:4]


def resolved_solvers(solvers: dict, full: bool) -> dict:
    """The solvers that are sampled: only the paper's many paths resolve the errors of those
    of weak order 2."""
    second_order = ("SRKw2", "SRKw4(a21=0)")
    return {name: s for name, s in solvers.items() if full or name not in second_order}


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
    """The same, by Monte Carlo, with its standard error. In single precision: its rounding
    errors, some 1e-6, are far below what sampling leaves."""
    y0 = jax.tree.map(lambda y: y.astype(jnp.float32), y0)

    def sample(h, key):
        sol = solve(make_terms(make_path(key)), solver, y0, t1, h)
        return phi(jax.tree.map(lambda y: y[-1], sol.ys)), sol.result

    signed, std_errors = [], []
    for h in hs:
        with jax.enable_x64(False):
            # The step size as an array: compiled once for all of them.
            at_h = eqx.Partial(sample, jnp.asarray(h))
            estimate = ds.monte_carlo(at_h, key=jr.key(round(t1 / h)), num_paths=paths)
        assert estimate.num_failed == 0
        signed.append(float(estimate.mean) - exact)
        std_errors.append(float(estimate.std_error))
    return Errors(np.array([*hs]), np.array(signed), np.array(std_errors))


def quasi_weak_error(
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
    """The same, by quasi-Monte Carlo, from 32 replicates of so many paths."""
    terms = make_terms(make_path(jr.key(0)))
    of_state = lambda t, y, args: phi(y)
    signed, std_errors = [], []
    for h in hs:
        estimate = ds.expectation(
            of_state, terms, solver, 0.0, t1, h, y0,
            key=jr.key(round(t1 / h)), sampling=ds.ArrayRQMC(paths, 32), levels=1,
        )  # fmt: skip
        assert estimate.num_failed == 0
        signed.append(float(estimate.mean) - exact)
        std_errors.append(float(estimate.std_error))
    return Errors(np.array([*hs]), np.array(signed), np.array(std_errors))


class FinePath(diffrax.AbstractBrownianPath):
    """A Brownian path over [0, t1] by the values of `w` and of its integral on a fine
    grid, so that every step size sees the same path, space-time areas included. As
    `ds.FixedStepBrownianPath` with `cell`, but kept in memory: a step of any size looks
    two values up, which pays if many solves follow each path."""

    w: jax.Array
    integral: jax.Array
    end: float
    t0 = 0.0
    t1 = np.inf
    levy_area = diffrax.SpaceTimeLevyArea

    @staticmethod
    def draw(key, steps: int, m: int, t1: float) -> "FinePath":
        dw, H = jr.normal(key, (2, steps, m)) * np.sqrt(t1 / steps)
        H = H / np.sqrt(12)
        from_zero = lambda x: jnp.concatenate([jnp.zeros_like(x[:1]), jnp.cumsum(x, 0)])
        w = from_zero(dw)
        integral = from_zero((w[:-1] + dw / 2 + H) * (t1 / steps))
        return FinePath(w, integral, t1)  # pyright: ignore[reportCallIssue]

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
    fine: int,
    component: Callable,
    t1: float = 1.0,
) -> Callable[..., dict[str, Errors]]:
    """What takes a number of paths, and `args` of the terms, to the root-mean-square errors
    of `component(y)` at `t1`, against `reference` with `fine` steps on the same Brownian
    paths. All calls share one program."""
    cell = t1 / fine
    steps = jnp.array([*hs])

    def end(path, solver, h, args):
        sol = solve(make_terms(path), solver, y0, t1, h, args=args)
        return component(jax.tree.map(lambda y: y[-1], sol.ys)), sol.result

    def squares(args, key):
        path = FinePath.draw(key, fine, m, t1)

        def run(solver, steps):
            x, result = jax.lax.map(lambda h: end(path, solver, h, args), steps)
            return jnp.where(result == diffrax.RESULTS.successful, x, jnp.nan)

        # The reference shares its program with the solver that it is, if it is one.
        ends = {
            name: run(s, jnp.append(steps, cell) if s is reference else steps)
            for name, s in solvers.items()
        }
        shared = [ends[name] for name, s in solvers.items() if s is reference]
        exact = (shared[0] if shared else run(reference, jnp.array([cell])))[-1]
        errors = {name: (x[: len(steps)] - exact) ** 2 for name, x in ends.items()}
        # Of a path that failed they are not finite.
        return errors, diffrax.RESULTS.successful

    def study(paths: int, args=None) -> dict[str, Errors]:
        # In small batches: every path is kept in all its fine steps.
        fn = eqx.Partial(squares, args)
        estimate = ds.monte_carlo(fn, key=jr.key(0), num_paths=paths, batch_size=250)
        assert estimate.num_failed == 0
        out = {}
        for name, mean in estimate.mean.items():
            rms = np.sqrt(mean)
            bars = estimate.std_error[name] / (2 * rms)
            out[name] = Errors(np.asarray(steps), rms, bars)
        return out

    return study


class GivenStep(diffrax.AbstractBrownianPath):
    """The same increment, and if there is one area, over every step."""

    W: jax.Array
    H: jax.Array
    t0 = 0.0
    t1 = np.inf
    levy_area = diffrax.SpaceTimeLevyArea

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        assert t1 is not None
        area = diffrax.SpaceTimeLevyArea(dt=jnp.asarray(t1 - t0), W=self.W, H=self.H)
        return area if use_levy else self.W


def one_step(make_terms: Callable, solver, y0, h, W, H=0.0):
    """The state after one step from `y0` with increment `W` and space-time area `H`."""
    terms = make_terms(GivenStep(jnp.asarray(W), jnp.asarray(H)))  # pyright: ignore
    state = solver.init(terms, 0.0, h, y0, None)
    y1, *_ = solver.step(terms, 0.0, h, y0, None, state, made_jump=False)
    return y1


def report(title: str, results: dict[str, Errors]) -> None:
    print(f"  {title}")
    for name, e in results.items():
        listed = " ".join(f"{x:8.1e}" for x in e.errors)
        print(f"    {name:22} slope {e.slope:5.2f}   errors {listed}", flush=True)


def claim_slopes(results: dict[str, Errors], expected: dict[str, float]) -> None:
    for name, order in expected.items():
        e = results[name]
        claim(f"slope of {name}", e.slope, order - 0.15, order + 0.15)
        if np.any(e.std_errors):
            claim(f"its standard error, {name}", e.slope_std_error, high=0.05)


def claim_small_first_order(name: str, e: Errors) -> None:
    """That a method of order 1 has an error c1 h + c2 h^2 in which the first term is so
    small, for little noise, that one sees order 2 down to the smallest steps."""
    h = e.hs[-1]
    twice, once = e.signed[-2:]
    c2 = (twice - 2 * once) / (2 * h**2)
    c1 = once / h - c2 * h
    print(f"  error of {name}: {c1:.2g} h + {c2:.2g} h^2")
    claim(f"h at which both are equal, {name}", abs(c1 / c2), 2.0**-12, 2.0**-5)
    slope = np.log2(e.errors[2] / e.errors[4]) / 2
    claim(f"slope of {name} from 2^-3 to 2^-5", slope, 1.85, 2.5)


def claim_samples(exact: dict[str, Errors], sampled: dict[str, Errors]) -> None:
    """That what was sampled is what is exact."""
    for name, e in sampled.items():
        at = np.searchsorted(-exact[name].hs, -e.hs)
        off = np.abs(e.signed - exact[name].signed[at]) / e.std_errors
        claim(f"sampled errors of {name}, in standard errors", off.max(), high=4)


def plot_orders(
    axes,
    title: str,
    results: dict[str, Errors],
    sampled: dict[str, Errors] | None = None,
    slopes=(1, 2),
) -> None:
    """Errors with their slopes, what was sampled of them with three standard errors, and
    reference slopes."""
    for name, e in results.items():
        look = style(name)
        if "sign=1" in name:
            # Beside the same solver with the other sign.
            look |= dict(ls=":", marker=">")
        label = name if np.isnan(e.slope) else f"{name} ({e.slope:.2f})"
        bars = 3 * e.std_errors if np.any(e.std_errors) else None
        axes.errorbar(e.hs, e.errors, bars, label=label, **look)
        if sampled is not None and name in sampled:
            e = sampled[name]
            # A point that is not clear of its own bar says nothing.
            clear = e.errors > 3 * e.std_errors
            look |= dict(ls="none", marker="s", mfc="none", ms=9, capsize=4)
            axes.errorbar(e.hs[clear], e.errors[clear], 3 * e.std_errors[clear], **look)
    if sampled is not None:
        label = "sampled, where clear of zero"
        axes.plot([], [], "ks", mfc="none", ms=9, label=label)
    all_errors = np.concatenate([e.errors for e in results.values()])
    hs = next(iter(results.values())).hs
    for slope in slopes:
        line = 2 * all_errors.max() * (hs / hs.max()) ** slope
        axes.loglog(hs, line, "k:", lw=1)
        place = dict(ha="right", va="center")
        axes.text(hs[-1] / 1.15, line[-1], f"slope {slope:g}", **place)
    axes.set(xscale="log", yscale="log", xlabel="step $h$", title=title)
    axes.set_ylim(all_errors[all_errors > 0].min() / 4, 8 * all_errors.max())
    # Room for the names of the slopes.
    axes.set_xlim(hs[-1] / 3.5, 1.3 * hs[0])
    axes.set_xticks(hs, [f"$2^{{{np.log2(h):.0f}}}$" for h in hs])
    axes.minorticks_off()
    axes.legend(loc="lower right")
