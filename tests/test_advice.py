"""Advice is measured: facts in the records, and the order of suggestions."""

import json
import re

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import drives
from diffrax_symplectic._solver import LANGEVIN, SOLVERS
from diffrax_symplectic._suggest import FOR_FRICTION, FOR_MEANS, FOR_PATHS
from examples import advice
from examples.stability import friction


# Steps of explicit solvers, and others for implicit ones.
RESOLVED, STIFF = jnp.array([0.5, 1.8]), jnp.array([1.0, 3.0, 5.0])
EXPLICIT = [kind for kind in (*SOLVERS, *LANGEVIN) if kind().stage_vectors(1) == ()]
SUGGESTED = [
    kind
    for kind in (*SOLVERS, *LANGEVIN)
    if kind in FOR_FRICTION + FOR_MEANS + FOR_PATHS
]
# The Lévy areas of `LevyAreaMidpoint` have no finite set of outcomes; without noise
# brackets it is the midpoint rule.
MEASURED = [
    kind for kind in SUGGESTED if "noise brackets" not in map(drives, kind().variables)
]


def _well(t, p, q, args):
    return (p**2 + q**2) / 2


def _maps(terms, solver, hs):
    one = lambda h: ds.second_moment_map(terms, solver, 0.0, h, advice.ONE)
    options = {"xla_backend_optimization_level": 0}
    return np.asarray(jax.jit(jax.vmap(one), compiler_options=options)(hs))


@pytest.mark.parametrize("kind", MEASURED, ids=lambda kind: kind.__name__)
def test_facts_about_noise_on_harmonic_modes_are_measured(kind):
    solver = advice.with_newton(kind())
    path = kind().path((), jr.key(0), want="weak")
    # The energy that noise gives in each unit of time to a mode without friction is 1/2.
    right_energy_unresolved = None
    if kind not in EXPLICIT:
        push = lambda t, p, q, args: -q
        terms = ds.hamiltonian_terms(_well, push, path)
        ends = np.linalg.matrix_power(_maps(terms, solver, STIFF), 200)[:, :, 0]
        rates = (ends[:, 4] + ends[:, 8]) / (200 * STIFF)
        right_energy_unresolved = bool(np.all(np.abs(rates - 1) <= 0.05))
    assert kind().record.right_energy_unresolved is right_energy_unresolved
    # Those for separable systems do not take friction in the drift.
    exact = []
    if kind in LANGEVIN or kind().structure not in ("separable",):
        hs = RESOLVED if kind in EXPLICIT else jnp.concatenate([RESOLVED, STIFF])
        maps = _maps(ds.langevin_terms(_well, 0.5, 1.0, path), solver, hs)
        found = np.array([advice.stationary(K, 1.0) for K in maps])
        for name, number, value in (("qq", 8, 1.0), ("pq", 5, 0.0), ("pp", 4, 1.0)):
            if np.max(np.abs(found[:, number] - value)) <= 1e-9:
                exact.append(name)
    assert kind().record.stationary == tuple(exact)


def _names(found) -> set[str]:
    return {advice.solver_name(suggestion.solver) for suggestion in found}


def test_friction_is_measured_for_all_solvers_suggested_for_it():
    terms = ds.langevin_terms(_well, 0.5, 1.0, ())
    measured = {advice.solver_name(solver) for solver in friction.CASES.values()}
    for want in ("weak", "strong"):
        assert _names(ds.suggest_solver(terms, 0.0, advice.ONE, want=want)) <= measured


@pytest.mark.parametrize("name", friction.CASES)
def test_reasons_name_the_friction_that_exact_second_moments_allow(name):
    solver = friction.CASES[name]
    limit = friction.limit(friction.energies(solver))
    assert solver.record.most_friction == limit
    reason = solver.record.reason
    if limit is None:
        assert "gamma h" not in reason
    else:
        assert f"only up to gamma h = {limit:g}." in reason


def test_reasons_say_which_solver_is_for_functions_of_momenta_and_positions():
    kappa, h = 1.0, 0.2

    def pair(t, p, q, args):
        return jnp.sum(p**2 + q**2) / 2 + kappa * (q[0] - q[1]) ** 2 / 2

    exact = 1 / 6  # of the heat current, as in docs/solvers/langevin.md
    zero = (jnp.zeros(2), jnp.zeros(2))
    currents = {}
    for kind in (ds.BAOAB, ds.LangevinMiddle):
        path = kind().path((2,), jr.key(0), want="weak")
        terms = ds.langevin_terms(pair, 0.5, jnp.array([1.5, 0.5]), path)
        K = np.asarray(ds.second_moment_map(terms, kind(), 0.0, h, zero))
        # Of (1, p, p', q, q').
        moments = advice.stationary(K, 1.0).reshape(5, 5)
        p, q = moments[1:3], moments[3:]
        currents[kind] = kappa * np.sum(p[:, 3] - p[:, 4]) / 2
        # Its momenta are h / 2 late, times the forces of the wells.
        late = h * kappa / 4 * (q[0, 3] - q[1, 4])
    baoab, middle = currents[ds.BAOAB], currents[ds.LangevinMiddle]
    np.testing.assert_allclose(middle - baoab, late, rtol=1e-9)
    assert abs(baoab / exact - 1) < 0.004
    assert middle / exact - 1 > 0.04
    both = "functions of p and q together, such as a heat current"
    assert f"For {both}, too." in ds.BAOAB().record.reason
    assert f"not for {both}." in ds.LangevinMiddle.record.reason


# What the first suggestion says that it is not for, where it is not within twice the error
# of the best.
SAID = {
    "stiff oscillator": "Not for long steps, omega h > 1",
    "stiff oscillator in a bath": "Not for .* frequencies omega > 2 / h",
    "free particle in a bath": "Not for .* transients to more than three digits",
    "oscillator in a bath, transient": "Not for .* transients to more than three digits",
    "oscillator in a bath, stationary": "Not for functions of p alone",
    "strong friction": "Not for functions of p alone",
    "two baths": "Not for functions of p alone",
    "coloured forcing with friction, late": "Not for .* stationary laws of linear systems",
    "Kubo oscillator": "Not for long steps, omega h > 1",
}
NONLINEAR = "Not for .* `ValueFunctions` in strongly nonlinear systems"
KEPT = json.loads(advice.KEPT.read_text())


@pytest.mark.parametrize("want", ["weak", "strong"])
def test_first_suggestion_is_nearly_the_best_or_says_for_what_it_is_not(want):
    excused = set()
    assert set(KEPT["weak"]) == set(advice.PROBLEMS)
    for name, rows in KEPT[want].items():
        problem = advice.PROBLEMS[name]
        terms = problem.terms(problem.noises)
        found = ds.suggest_solver(terms, 0.0, problem.y0, want=want)
        # All of them have been measured.
        assert {advice.solver_name(s.solver) for s in found} <= set(rows)
        best = np.min(np.array(list(rows.values())), axis=0)
        first = np.array(rows[advice.solver_name(found[0].solver)])
        # Strong errors are sampled: three of their standard errors more.
        sampling = KEPT["strong_std_error"][name] if want == "strong" else 0.0
        within = 2 * (1 + 3 * sampling)
        if np.all(first <= within * np.maximum(best, advice.ROUNDING)):
            continue
        excused.add(name)
        assert re.search(SAID[name], found[0].reason), (name, found[0], first, best)
    if want == "strong":
        assert set(KEPT["strong"]) == set(advice.STRONG)
    else:
        assert excused == set(SAID)


def test_in_a_nonlinear_system_the_first_suggestion_says_for_what_it_is_not():
    for name, problem in advice.NONLINEAR.items():
        rows = KEPT["nonlinear"][name]
        first = ds.suggest_solver(
            problem.terms(problem.noises), 0.0, problem.y0, want="weak"
        )[0]
        # What is left of the error, whatever it consists of.
        whole = {solver: max(errors) for solver, errors in rows.items()}
        std_error = {solver: errors[1] for solver, errors in rows.items()}
        own = advice.solver_name(first.solver)
        good = whole[own] <= 2 * min(whole.values())
        # Unless it is the best, a fit that is too coarse has to be said.
        matters = std_error[own] > whole[own] / 10 > min(whole.values()) / 10
        if matters:
            good &= std_error[own] <= 2 * min(std_error.values())
        assert good or re.search(NONLINEAR, first.reason), (name, rows)


LIMITED = [kind for kind in SUGGESTED if kind().record.most_frequency is not None]


@pytest.mark.parametrize("kind", LIMITED, ids=lambda kind: kind.__name__)
def test_two_levels_hold_up_to_the_frequency_of_the_record(kind):
    """Of the means of a Kubo oscillator for all phases and times up to 30, few are off by
    more than two error bars with steps of this length, and many with twice as long ones."""
    most = kind().record.most_frequency
    path = kind().path((), jr.key(0), want="weak")
    kubo = lambda t, p, q, args: 0.27 * (p**2 + q**2) / 2
    terms = ds.hamiltonian_terms(_well, kubo, path)
    hs = most * np.array([0.5, 1.0, 2.0])
    maps = _maps(terms, advice.with_newton(kind()), jnp.asarray(hs))
    # Of q + i p, which each step multiplies by a number in the mean: q is the third of the
    # moments of (1, p, q), and becomes the real part, p the imaginary part.
    half, one, two = maps[:, 2, 2] + 1j * maps[:, 1, 2]
    starts = np.exp(1j * np.linspace(0, np.pi, 16, endpoint=False))

    def share(h, factor, factor_of_half):
        number = np.arange(1, round(30 / h) + 1)[:, None]
        exact = np.real(starts * np.exp(number * h * (-1j - 0.27**2 / 2)))
        long = np.real(starts * factor**number)
        short = np.real(starts * factor_of_half ** (2 * number))
        change = (short - long) / (2 ** kind().record.order("weak", True) - 1)
        return np.mean(np.abs(short + change - exact) > 2 * np.abs(change))

    assert share(hs[1], one, half) <= 0.05
    assert share(hs[2], two, one) >= 0.15


@pytest.mark.parametrize("h", [*RESOLVED, *STIFF])
def test_without_brackets_levy_areas_change_nothing(h):
    """So the facts about noise on harmonic modes are those of the midpoint rule."""
    push = lambda t, p, q, args: jnp.stack([-q, -2 * q])
    path = ds.LevyAreaMidpoint().path((2,), jr.key(0), want="strong")
    terms = ds.hamiltonian_terms(_well, push, path)
    ends = []
    for solver in (ds.LevyAreaMidpoint(), ds.ImplicitMidpoint()):
        solver = advice.with_newton(solver)
        state = solver.init(terms, 0.0, h, advice.ONE, None)
        y1, *_ = solver.step(terms, 0.0, h, advice.ONE, None, state, made_jump=False)
        ends.append(jnp.stack(y1))
    np.testing.assert_allclose(*ends, rtol=0, atol=1e-13)
    of_levy, of_midpoint = ds.LevyAreaMidpoint.record, ds.ImplicitMidpoint.record
    assert of_levy.right_energy_unresolved is of_midpoint.right_energy_unresolved
    assert of_levy.stationary == of_midpoint.stationary


def test_errors_of_the_page_are_those_measured_now():
    name = "noisy spring"
    problem = advice.PROBLEMS[name]
    exact = advice.generator(problem)
    for solver in (ds.StormerVerlet(), ds.SRKw4()):
        errors = advice.weak_errors(problem, exact, solver)
        kept = KEPT["weak"][name][advice.solver_name(solver)]
        np.testing.assert_allclose(errors, kept, rtol=1e-6)
    page = (advice.DOCS / "advice.md").read_text()
    assert page == advice.page(KEPT), "run `python -m examples.advice`"


def test_each_system_is_in_one_table_with_others_of_equal_budgets():
    names = [name for table in advice.TABLES.values() for name in table]
    assert sorted(names) == sorted(advice.PROBLEMS)
    for table in advice.TABLES.values():
        assert len({advice.PROBLEMS[name].budgets for name in table}) == 1
