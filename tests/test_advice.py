"""Facts in the records, by which solvers are suggested and warned of, are measured."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import drives
from diffrax_symplectic._solver import LANGEVIN, SOLVERS
from diffrax_symplectic._suggest import FOR_FRICTION, FOR_MEANS, FOR_PATHS
from examples.stability import friction
from examples.stability._models import stationary, with_newton

from .families import slow_except
from .picard import by_picard


ONE = jnp.array(0.5), jnp.array(1.0)
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


def _maps(terms, solver, hs, y0=ONE):
    one = lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0)
    options = {"xla_backend_optimization_level": 0}
    return np.asarray(jax.jit(jax.vmap(one), compiler_options=options)(hs))


# An explicit, an implicit and a splitting one; the rest is for the whole suite.
QUICK = ds.StormerVerlet, ds.ImplicitMidpoint, ds.BAOAB


@pytest.mark.parametrize(
    "kind", slow_except(QUICK, MEASURED), ids=lambda kind: kind.__name__
)
def test_facts_about_noise_on_harmonic_modes_are_measured(kind):
    solver = with_newton(kind())
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
        found = np.array([stationary(K, 1.0) for K in maps])
        for name, number, value in (("qq", 8, 1.0), ("pq", 5, 0.0), ("pp", 4, 1.0)):
            if np.max(np.abs(found[:, number] - value)) <= 1e-9:
                exact.append(name)
    assert kind().record.stationary == tuple(exact)


def test_friction_is_measured_for_all_solvers_suggested_for_it():
    # Its class, and that of the solver within.
    name = lambda solver: (type(solver), type(getattr(solver, "flow", None)))
    terms = ds.langevin_terms(_well, 0.5, 1.0, ())
    measured = {name(solver) for solver in friction.CASES.values()}
    for want in ("weak", "strong"):
        found = ds.suggest_solver(terms, 0.0, ONE, want=want)
        assert {name(suggestion.solver) for suggestion in found} <= measured


FIRST = list(friction.CASES)[:2]


@pytest.mark.parametrize("name", slow_except(FIRST, friction.CASES))
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
        (K,) = _maps(terms, kind(), jnp.array([h]), zero)
        # Of (1, p, p', q, q').
        moments = stationary(K, 1.0).reshape(5, 5)
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
    maps = _maps(terms, by_picard(kind()), jnp.asarray(hs))
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


def test_without_brackets_levy_areas_change_nothing():
    """So the facts about noise on harmonic modes are those of the midpoint rule."""
    push = lambda t, p, q, args: jnp.stack([-q, -2 * q])
    path = ds.LevyAreaMidpoint().path((2,), jr.key(0), want="strong")
    terms = ds.hamiltonian_terms(_well, push, path)
    solvers = ds.LevyAreaMidpoint(), ds.ImplicitMidpoint()

    @jax.jit
    def ends(h):
        given = terms, 0.0, h, ONE, None, None, False
        return [jnp.stack(by_picard(solver).step(*given)[0]) for solver in solvers]

    np.testing.assert_allclose(*ends(0.5), rtol=0, atol=1e-13)
    of_levy, of_midpoint = (solver.record for solver in solvers)
    assert of_levy.right_energy_unresolved is of_midpoint.right_energy_unresolved
    assert of_levy.stationary == of_midpoint.stationary
