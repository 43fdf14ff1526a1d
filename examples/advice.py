"""Solvers by problems, at equal cost: `python -m examples.advice`.

The errors of second moments on linear systems, from `second_moment_map` and the exact
equations of the moments, without sampling; and strong errors, by `compare_solvers`. Writes
`docs/advice.md`, its picture, and `docs/advice.json`, by which `tests/test_advice.py`
judges the order of the suggestions.
"""

import dataclasses
import datetime
import json
import sys
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx
from matplotlib.lines import Line2D
from scipy.linalg import expm

import diffrax_symplectic as ds

from ._pictures import dots, WIDTH


DOCS = Path(__file__).parents[1] / "docs"
# What a stage vector costs, in evaluations of the vector field: sweeps until the stage
# equations are solved.
SWEEPS = 5
# Times for one evaluation, in units of one over the frequency of the system.
BUDGETS = (0.01, 0.03, 0.1)


class Problem(NamedTuple):
    """A linear system, by its terms for a path or its shape."""

    terms: Callable[[Any], diffrax.MultiTerm]
    y0: tuple
    # The shape of the noise.
    noises: tuple[int, ...] = ()
    # When moments are compared; `None` for their stationary values.
    time: float | None = 6.0
    # The largest frequency, by which times are measured.
    frequency: float = 1.0
    budgets: tuple[float, ...] = BUDGETS


ONE = (jnp.array(0.5), jnp.array(1.0))
ZERO = (jnp.array(0.0), jnp.array(0.0))


def hamiltonian(H0, noise):
    energy = lambda t, p, q, args: H0(p, q)
    return lambda path: ds.hamiltonian_terms(
        energy, lambda t, p, q, args: noise(p, q), path
    )


def bath(H0, friction=0.5):
    """Langevin dynamics at temperature 1."""
    energy = lambda t, p, q, args: H0(p, q)
    return lambda path: ds.langevin_terms(energy, friction, 1.0, path)


def rubbing(H0, noise, friction=0.5):
    """Friction beside other noise."""

    def terms(path):
        rest = hamiltonian(H0, noise)(path)
        energy = lambda t, p, q, args: H0(p, q)
        return diffrax.MultiTerm(*rest.terms, *ds.bath_terms(energy, friction).terms)

    return terms


def two_baths(path):
    """Two oscillators with a bond, and a bath of its own for each."""

    def energy(t, p, q, args):
        return jnp.sum(p**2 + q**2) / 2 + (q[0] - q[1]) ** 2 / 2

    return ds.langevin_terms(energy, 0.5, jnp.array([1.5, 0.5]), path)


def coloured(friction):
    """An oscillator pushed by an Ornstein-Uhlenbeck process, the second momentum."""
    energy = lambda t, p, q, args: (p[0] ** 2 + q[0] ** 2) / 2
    rates = jnp.array([friction, 0.5])

    def more(t, y, args):
        p, q = y
        return jnp.array([p[1], 0.0]) - rates * p, jnp.zeros(2)

    def terms(path):
        noise = lambda t, p, q, args: -q[1]
        base = ds.hamiltonian_terms(energy, noise, path)
        return diffrax.MultiTerm(*base.terms, diffrax.ODETerm(more))

    return terms


def free(p, q):
    return p**2 / 2


def well(p, q):
    return (p**2 + q**2) / 2


def push(p, q):
    return -q


def spring(p, q):
    return 0.4 * q**2 / 2


def kubo(p, q):
    return 0.6 * (p**2 + q**2) / 2


def turning(p, q):
    return jnp.stack([0.4 * (p**2 - q**2) / 2, 0.4 * p * q])


PAIR = (jnp.array([0.5, 0.0]), jnp.array([1.0, 0.0]))
# Steps that do not resolve the mode.
STIFF = (0.3, 1.0)
PROBLEMS = {
    "free particle": Problem(hamiltonian(free, push), ONE),
    "oscillator": Problem(hamiltonian(well, push), ONE),
    "stiff oscillator": Problem(hamiltonian(well, push), ONE, budgets=STIFF, time=40.0),
    "free particle in a bath": Problem(bath(free), ONE),
    "oscillator in a bath, transient": Problem(bath(well), ONE, time=3.0),
    "oscillator in a bath, stationary": Problem(bath(well), ONE, time=None),
    "stiff oscillator in a bath": Problem(bath(well), ONE, time=None, budgets=STIFF),
    "strong friction": Problem(bath(well, 20.0), ONE, time=None),
    "two baths": Problem(two_baths, PAIR, (2,), time=None),
    "noisy spring": Problem(hamiltonian(well, spring), ONE),
    "noisy spring with friction": Problem(rubbing(well, spring), ONE),
    "Kubo oscillator": Problem(hamiltonian(well, kubo), ONE, time=3.0),
    "two noises that do not commute": Problem(
        hamiltonian(well, turning), ONE, (2,), time=3.0
    ),
    "coloured forcing": Problem(coloured(0.0), PAIR),
    "coloured forcing with friction, late": Problem(coloured(0.3), PAIR, time=40.0),
}


def cost(solver, num_noises: int) -> float:
    """Evaluations of the vector field in one step."""
    vectors = sum(solver.stage_vectors(num_noises))
    share = 2 if solver.structure == "separable" else 1
    # An explicit method evaluates the force at each of its positions.
    explicit = len(solver.tableau.alpha) if isinstance(solver, ds.PlateauVerlet) else 1
    return explicit + SWEEPS * vectors / share


def generator(problem: Problem) -> np.ndarray:
    """Of the second moments of (1, y), in the order of `second_moment_map`."""
    path = ds.WeakBrownianPath(problem.noises, jr.key(0))
    terms = problem.terms(path)
    flat, unravel = jfu.ravel_pytree(problem.y0)

    def matrix(field):
        affine = lambda y: jfu.ravel_pytree(field(unravel(y)))[0]
        Z = np.zeros((flat.size + 1,) * 2)
        Z[1:, 0] = affine(jnp.zeros_like(flat))
        Z[1:, 1:] = jax.jacfwd(affine)(jnp.zeros_like(flat))
        return Z

    one = np.eye(flat.size + 1)
    both = lambda Z: np.kron(Z, one) + np.kron(one, Z)
    out = np.zeros((one.size,) * 2)
    for term in terms.terms:
        if isinstance(term, diffrax.ODETerm):
            out += both(matrix(lambda y: term.vf(0.0, y, None)))
            continue
        for unit in np.eye(max(int(np.prod(problem.noises)), 1)):
            W = jnp.asarray(unit.reshape(problem.noises))
            B = both(matrix(lambda y: term.vf_prod(0.0, y, None, W)))
            out += B @ B / 2
    return out


def stationary(matrix: np.ndarray, forever: float) -> np.ndarray:
    """The moments that `matrix`, of a step, or a generator with `forever = 0`, keeps."""
    left = np.eye(len(matrix)) * forever - matrix
    moments = np.zeros(len(matrix))
    moments[0] = 1
    rest, *_ = np.linalg.lstsq(left[1:, 1:], -left[1:, 0], rcond=None)
    moments[1:] = rest
    return moments


def with_newton(solver):
    """The solver with a root finder that is exact for linear systems, and compiled sooner.
    The results are the same."""
    if isinstance(solver, ds.BAOAB) and solver.flow is not None:
        return dataclasses.replace(solver, flow=with_newton(solver.flow))
    if hasattr(solver, "root_finder"):
        newton = optx.Newton(rtol=1e-12, atol=1e-12)
        return dataclasses.replace(solver, root_finder=newton)
    return solver


def weak_errors(problem: Problem, exact: np.ndarray, solver) -> list[float]:
    """For each budget the largest error of a second moment, relative to the largest of
    them; infinite if moments grow that should not."""
    noises = max(int(np.prod(problem.noises)), 1)
    hs = np.array(problem.budgets) * cost(solver, noises) / problem.frequency
    steps = np.zeros(len(hs), int)
    if problem.time is not None:
        steps = np.maximum(np.round(problem.time / hs), 1).astype(int)
        hs = problem.time / steps
    terms = problem.terms(solver.path(problem.noises, jr.key(0), want="weak"))
    solver = with_newton(solver)
    one = lambda h: ds.second_moment_map(terms, solver, 0.0, h, problem.y0)
    # One program for all steps, which runs once.
    options = {"xla_backend_optimization_level": 0}
    maps = jax.jit(jax.vmap(one), compiler_options=options)(jnp.asarray(hs))
    z = np.concatenate([[1.0], jfu.ravel_pytree(problem.y0)[0]])
    start, size = np.kron(z, z), len(z)
    second = [i for i in range(size**2) if i % size > 0 and i >= size]
    if problem.time is None:
        true = stationary(exact, 0.0)
    else:
        true = expm(exact * problem.time) @ start
    errors = []
    for K, n in zip(np.asarray(maps), steps):
        if problem.time is not None:
            found = np.linalg.matrix_power(K, n) @ start
        elif np.max(np.abs(np.linalg.eigvals(K[1:, 1:]))) < 1 - 1e-12:
            found = stationary(K, 1.0)
        else:
            found = np.full(len(K), np.inf)
        error = np.max(np.abs(found - true)[second]) / np.max(np.abs(true)[second])
        errors.append(float(error) if error < 10 else np.inf)
    return errors


def weak_table(name: str) -> dict[str, list[float]]:
    """The errors of all solvers suggested for a problem, best first, and with friction of
    `BAOAB` with an implicit flow, by budget."""
    problem = PROBLEMS[name]
    terms = problem.terms(problem.noises)
    suggestions = ds.suggest_solver(terms, 0.0, problem.y0, want="weak")
    found = [suggestion.solver for suggestion in suggestions]
    if any(isinstance(solver, ds.BAOAB) for solver in found):
        found.append(ds.BAOAB(ds.ImplicitMidpoint()))
    exact = generator(problem)
    rows = {}
    for solver in found:
        errors = weak_errors(problem, exact, solver)
        rows[solver_name(solver)] = errors
        shown = "".join(f"{x:10.1e}" for x in errors)
        print(f"{name:44s}{solver_name(solver):24s}{shown}", flush=True)
    return rows


def solver_name(solver) -> str:
    """Its class, and that of the solver within."""
    inner = ""
    if isinstance(solver, ds.BAOAB) and solver.flow is not None:
        inner = solver_name(solver.flow)
    return f"{type(solver).__name__}({inner})"


# Strong errors, along the same Brownian paths.
STRONG = (
    "oscillator",
    "oscillator in a bath, transient",
    "noisy spring",
    "Kubo oscillator",
    "two noises that do not commute",
)
STRONG_STEPS = (1 / 4, 1 / 8, 1 / 16, 1 / 32)


class StrongErrors(NamedTuple):
    """Strong errors of all solvers suggested for a problem.

    - `rows`: root mean square errors at t = 2 by budget, interpolated between steps.
    - `std_error`: the largest standard error of those at the steps, as a fraction.
    """

    rows: dict[str, list[float]]
    std_error: float


def strong_table(name: str) -> StrongErrors:
    """Strong errors along common Brownian paths."""
    problem = PROBLEMS[name]
    noises = max(int(np.prod(problem.noises)), 1)
    terms = problem.terms(problem.noises)
    found = ds.suggest_solver(terms, 0.0, problem.y0, want="strong")
    solvers = {repr(s.solver): s.solver for s in found}
    compared = ds.compare_solvers(
        terms, list(solvers.values()), 0.0, 2.0, STRONG_STEPS, problem.y0,
        key=jr.key(0), num_paths=200,
    )  # fmt: skip
    rows = {}
    for key, solver in solvers.items():
        errors = [step.error for step in compared.steps if step.solver == key]
        hs = np.log(np.array(BUDGETS[:2]) * cost(solver, noises))
        # In a line beyond the steps that were measured.
        slope, _ = np.polyfit(np.log(STRONG_STEPS), np.log(errors), 1)
        known = np.log(STRONG_STEPS[::-1])
        within = np.interp(hs, known, np.log(errors[::-1]))
        beyond = hs - np.clip(hs, known[0], known[-1])
        rows[solver_name(solver)] = [float(x) for x in np.exp(within + slope * beyond)]
        print(
            f"{name:44s}{solver_name(solver):24s}{rows[solver_name(solver)]}",
            flush=True,
        )
    fractions = [step.std_error / step.error for step in compared.steps]
    return StrongErrors(rows, max(fractions))


class NonlinearProblem(NamedTuple):
    """A system whose exact mean at a late time is known.

    - `terms`: a function of the shape of the noise.
    - `phi`, `mean`: a function of the state, and its stationary mean.
    - `time`: when it is averaged. The rest of the transient is below the errors.
    - `noises`: the shape of the noise.
    - `sampling`: of `expectation`.
    """

    terms: Callable[[Any], diffrax.MultiTerm]
    y0: tuple
    phi: Callable
    mean: float
    time: float
    noises: tuple[int, ...] = ()
    sampling: Any = ds.ValueFunctions(num_paths=1024)


# For more than two components of the state.
SAMPLED = ds.IndependentPaths(40_000)
REST = (jnp.zeros(2), jnp.zeros(2))


def van_der_pol(path):
    """dx = v dt, dv = (2 (1 - x^2) v - x) dt + sqrt(2) dW."""
    energy = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: -np.sqrt(2) * q
    swing = lambda t, y, args: (2 * (1 - y[1] ** 2) * y[0], jnp.zeros_like(y[1]))
    base = ds.hamiltonian_terms(energy, noise, path)
    return diffrax.MultiTerm(*base.terms, diffrax.ODETerm(swing))


def changing_mass(rate: float) -> Callable:
    """Two coordinates, of which the second sets the mass of the first, exp(2 q'), with this
    rate of friction, at temperature 1. The law of q' is normal, with mean 1."""

    def energy(t, p, q, args):
        return (p[0] ** 2 * jnp.exp(-2 * q[1]) + p[1] ** 2 + q[1] ** 2) / 2

    def friction(t, q, args):
        return rate * jnp.stack([jnp.exp(2 * q[1]), 1.0])

    return lambda path: ds.langevin_terms(energy, friction, 1.0, path)


def pushed(p, q):
    return p**2 / 2 - q


def double_well(p, q):
    return p**2 / 2 + q**4 / 4 - q**2 / 2


def _square_in_double_well() -> float:
    q = np.linspace(-6, 6, 4001)
    weight = np.exp(q**2 / 2 - q**4 / 4)
    return float(np.sum(q**2 * weight) / np.sum(weight))


NONLINEAR = {
    "masses that depend on positions": NonlinearProblem(
        changing_mass(1.0), REST, lambda t, y, args: y[1][1], 1.0, 15.0, (2,), SAMPLED
    ),
    "masses that depend on positions, strong friction": NonlinearProblem(
        changing_mass(10.0), REST, lambda t, y, args: y[1][1], 1.0, 60.0, (2,), SAMPLED
    ),
    "a double well at a temperature": NonlinearProblem(
        bath(double_well),
        ONE,
        lambda t, y, args: y[1] ** 2,
        _square_in_double_well(),
        20.0,
    ),
    "a current": NonlinearProblem(
        bath(pushed), ZERO, lambda t, y, args: y[0], 2.0, 20.0
    ),
    # In the stationary state the energy is constant: 2 <(1 - x^2) v^2> + 1 = 0.
    "Van der Pol with noise": NonlinearProblem(
        van_der_pol, ONE, lambda t, y, args: (y[1] ** 2 - 1) * y[0] ** 2, 0.5, 15.0
    ),
}
NONLINEAR_BUDGET = 0.01


def nonlinear_table(name: str) -> dict[str, list[float]]:
    """By solver, the error of the mean at equal cost, and the standard error."""
    problem = NONLINEAR[name]
    terms = problem.terms(problem.noises)
    noises = max(int(np.prod(problem.noises)), 1)
    rows = {}
    for suggestion in ds.suggest_solver(terms, 0.0, problem.y0, want="weak"):
        solver = suggestion.solver
        steps = round(problem.time / (NONLINEAR_BUDGET * cost(solver, noises)))
        of_values = isinstance(problem.sampling, ds.ValueFunctions)
        if of_values and "H" in solver.variables:
            # Of these there are no value functions.
            continue
        found = ds.expectation(
            problem.phi, terms, solver, 0.0, problem.time, problem.time / steps,
            problem.y0, key=jr.key(1), sampling=problem.sampling, levels=1,
        )  # fmt: skip
        off = abs(float(found.mean) - problem.mean)
        rows[solver_name(solver)] = [off, float(found.std_error)]
        print(f"{name:44s}{solver_name(solver):24s}{off:.4f} {found}", flush=True)
    return rows


KEPT = DOCS / "advice.json"


def measure(names) -> None:
    """Measures these problems anew, and keeps the others."""
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    table = {"weak": {}, "strong": {}, "strong_std_error": {}, "nonlinear": {}} | kept
    table["day"] = str(datetime.date.today())
    for name in names:
        if name in NONLINEAR:
            table["nonlinear"][name] = nonlinear_table(name)
            KEPT.write_text(json.dumps(table, indent=1) + "\n")
            continue
        table["weak"][name] = weak_table(name)
        if name in STRONG:
            strong = strong_table(name)
            table["strong"][name] = strong.rows
            table["strong_std_error"][name] = strong.std_error
        KEPT.write_text(json.dumps(table, indent=1) + "\n")


# The tables of means, in the order of the page. The budgets in one table are the same.
TABLES = {
    "Additive noise": ("free particle", "oscillator", "coloured forcing"),
    "Friction": (
        "free particle in a bath",
        "oscillator in a bath, transient",
        "oscillator in a bath, stationary",
        "strong friction",
        "two baths",
        "coloured forcing with friction, late",
    ),
    "Steps that do not resolve the mode": (
        "stiff oscillator",
        "stiff oscillator in a bath",
    ),
    "Multiplicative noise": (
        "noisy spring",
        "noisy spring with friction",
        "Kubo oscillator",
        "two noises that do not commute",
    ),
}
# Single paths are compared at so many of the budgets.
STRONG_BUDGETS = 2


def page(kept: dict) -> str:
    """The page of these errors, with solvers in the order of the suggestions."""
    weak = [
        _folded(title, _table("weak", names, kept)) for title, names in TABLES.items()
    ]
    text = Path(__file__).with_suffix(".md").read_text()
    return text.format(
        summary=_summary(kept),
        weak="\n\n".join(weak),
        strong=_folded("Single paths", _table("strong", kept["strong"], kept)),
        strong_std_error=max(kept["strong_std_error"].values()),
        nonlinear=_folded("Nonlinear systems", _nonlinear_table(kept["nonlinear"])),
        day=kept["day"],
        nonlinear_budget=NONLINEAR_BUDGET,
    )


def _folded(title: str, table: str) -> str:
    return f'??? note "{title}"\n\n' + textwrap.indent(table, "    ")


def _summary(kept: dict) -> str:
    """The solvers within twice the smallest error, with the budgets at which they are, if
    not at all of them."""
    lines = ["| system | means | single paths |", "|---|---|---|"]
    for name in (name for names in TABLES.values() for name in names):
        means = _best("weak", name, kept)
        paths = _best("strong", name, kept) if name in kept["strong"] else ""
        lines.append(f"| {name} | {means} | {paths} |".replace("|  |", "| |"))
    return "\n".join(lines)


def _best(want: str, name: str, kept: dict) -> str:
    budgets = _budgets(want, name)
    rows = _in_order(PROBLEMS[name], want, kept[want][name])
    parts = []
    for solver, good in _good(rows).items():
        at = [f"{budget:g}" for budget, is_good in zip(budgets, good) if is_good]
        if len(at) == len(budgets):
            parts.append(f"`{solver}`")
        elif at:
            parts.append(f"`{solver}` ({', '.join(at)})")
    return ", ".join(parts)


def _budgets(want: str, name: str) -> tuple[float, ...]:
    budgets = PROBLEMS[name].budgets
    return budgets[:STRONG_BUDGETS] if want == "strong" else budgets


def _good(rows: dict[str, list[float]]) -> dict[str, np.ndarray]:
    """For each solver and budget, whether the error is within twice the smallest."""
    best = np.nanmin(np.array(list(rows.values())), axis=0)
    limit = 2 * np.maximum(best, ROUNDING)
    return {solver: np.array(errors) <= limit for solver, errors in rows.items()}


def _table(want: str, names: Iterable[str], kept: dict) -> str:
    """A table of several systems, each below a row with its name."""
    lines = []
    for name in names:
        budgets = _budgets(want, name)
        empty = " |" * len(budgets)
        if not lines:
            lines.append(f"| time per evaluation | {' | '.join(map(str, budgets))} |")
            lines.append("|---" * (1 + len(budgets)) + "|")
        lines.append(f"| **{name}** |{empty}")
        rows = _in_order(PROBLEMS[name], want, kept[want][name])
        good = _good(rows)
        for solver, errors in rows.items():
            cells = [
                f"**{_shown(error)}**" if is_good else _shown(error)
                for error, is_good in zip(errors, good[solver])
            ]
            lines.append(f"| `{solver}` | {' | '.join(cells)} |")
    return "\n".join(lines)


def _shown(error: float) -> str:
    return f"{error:.1e}" if np.isfinite(error) else "grows"


def _nonlinear_table(found: dict[str, dict[str, list[float]]]) -> str:
    lines = ["| | error | standard error |", "|---|---|---|"]
    for name in NONLINEAR:
        lines.append(f"| **{name}** | | |")
        for solver, (error, std_error) in found[name].items():
            lines.append(f"| `{solver}` | {error:.1e} | {std_error:.1e} |")
    return "\n".join(lines)


def _in_order(problem: Problem, want, rows: dict) -> dict:
    terms = problem.terms(problem.noises)
    found = ds.suggest_solver(terms, 0.0, problem.y0, want=want)
    names = [solver_name(suggestion.solver) for suggestion in found]
    others = [name for name in rows if name not in names]
    return {name: rows[name] for name in [*names, *others]}


# The ends of the axis of errors in the picture.
SMALLEST = 1e-10
GROWS = 100.0


def draw(kept: dict) -> None:
    """The picture of the errors of means: a row for each system, with the smallest error on
    the left, at the second of its budgets for systems with three, else at the first."""
    figure, ax = plt.subplots(figsize=(WIDTH, 7.5))
    every = sorted({solver for rows in kept["weak"].values() for solver in rows})
    for row, name in enumerate(PROBLEMS):
        shown = len(PROBLEMS[name].budgets) - 2
        for solver, errors in kept["weak"][name].items():
            # Those that grow stand beside the largest.
            error = np.clip(errors[shown], SMALLEST, GROWS)
            ax.plot(error, row, **dots(solver), alpha=0.8)
    ax.set_yticks(range(len(PROBLEMS)), [textwrap.fill(name, 22) for name in PROBLEMS])
    ax.set(xscale="log", ylim=(len(PROBLEMS) - 0.5, -0.5), xlabel="relative error")
    powers = (-8, -6, -4, -2, 0)
    labels = ["≤ 1e-10", *(f"1e{power}" for power in powers), "grows"]
    ax.set_xticks([SMALLEST, *(10.0**power for power in powers), GROWS], labels)
    ax.minorticks_off()
    lines = [Line2D([], [], label=solver, **dots(solver)) for solver in every]
    figure.legend(handles=lines, loc="outside lower center", ncols=2)
    figure.savefig(DOCS / "img" / "advice.png")
    plt.close(figure)


# Errors below this are as good as none.
ROUNDING = 1e-12


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    measure(sys.argv[1:] or [*PROBLEMS, *NONLINEAR])
    measured = json.loads(KEPT.read_text())
    draw(measured)
    (DOCS / "advice.md").write_text(page(measured))
