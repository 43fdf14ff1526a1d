"""Each call computes with the user's functions as they are at that time, on every way on
which they come."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._simulation.problem import Problem
from diffrax_symplectic._terms import (
    brownian_paths,
    rate,
    replace_paths,
    shapes_as_paths,
    split_terms,
)

from .families import slow_except


ONE = jnp.array(1.0)
Y0 = (jnp.array([0.3, 0.1]), jnp.array([0.7, -0.2]))
k = 1.0


def now(args):
    """What every function below reads: `args`, or without them the global `k`."""
    return k if args is None else args


def H0(t, p, q, args):
    return jnp.sum(p**2) / 2 + now(args) * jnp.sum(q**2) / 2


def free(t, p, q, args):
    return jnp.sum(p**2) / 2


def kick(t, p, q, args):
    return -now(args) * q


def number(t, q, args):
    return now(args)


def field(t, y, args):
    p, q = y
    return -now(args) * q, p


def operator(t, y, args):
    p, q = y
    struct = jax.eval_shape(lambda: p)
    return lx.FunctionLinearOperator(lambda w: (now(args) * w, 0 * q), struct)


def of_spins(t, s, args):
    return now(args) * s[2]


def of_waves(t, psi, args):
    return now(args) * jnp.sum(jnp.real(psi * jnp.conj(psi)))


class TermOfUser(diffrax.AbstractTerm):
    """A term of a class that this package does not know."""

    def vf(self, t, y, args):
        return field(t, y, args)

    def contr(self, t0, t1, **kwargs):
        return t1 - t0

    def prod(self, vf, control):
        return jtu.tree_map(lambda x: control * x, vf)


def with_noise(drift):
    noise = ds.hamiltonian_terms(free, lambda t, p, q, args: q, (2,)).terms[1]
    return diffrax.MultiTerm(drift, noise)


PATH = ds.WeakBrownianPath((2,), jr.key(0))
ALONG = lambda t, q, args: now(args) * jnp.ones((2, 1))
# From what reads `k` to terms.
TERMS = {
    "H0": lambda: ds.hamiltonian_terms(H0, lambda t, p, q, args: q, (2,)),
    "noise": lambda: ds.hamiltonian_terms(free, kick, (2,)),
    "slow": lambda: ds.hamiltonian_terms(
        free, kick, (2,), slow=lambda t, q, args: now(args) * q[0]
    ),
    "indexed noise": lambda: ds.hamiltonian_terms(
        free, ds.IndexedNoise(lambda i, t, p, q, args: now(args) * q[i], 2), (2,)
    ),
    "friction": lambda: ds.langevin_terms(free, number, 1.0, (2,)),
    "temperature": lambda: ds.langevin_terms(free, 1.0, number, (2,)),
    "directions": lambda: ds.langevin_terms(free, ds.FrictionAlong(ALONG), 1.0, (1,)),
    "energy of a bath": lambda: ds.langevin_terms(H0, 1.0, 1.0, (2,)),
    "vector field": lambda: with_noise(diffrax.ODETerm(field)),
    "operator": lambda: diffrax.MultiTerm(
        diffrax.ODETerm(field), diffrax.ControlTerm(operator, PATH)
    ),
    "term of the user's": lambda: with_noise(TermOfUser()),
    "spins": lambda: ds.spin_terms(of_spins, of_spins, ()),
    "damped spins": lambda: ds.spin_terms(of_spins, of_spins, (), damping=0.3),
    "waves": lambda: ds.wave_terms(of_waves, of_waves, ()),
    "damped waves": lambda: ds.wave_terms(of_waves, of_waves, (), damping=0.3),
    "noise of spins, indexed": lambda: ds.spin_terms(
        of_spins, ds.IndexedNoise(lambda i, t, s, args: now(args) * s[i], 3), (3,)
    ),
    "Diffrax's Langevin terms": lambda: diffrax.MultiTerm(
        diffrax.UnderdampedLangevinDriftTerm(1.0, 1.0, lambda x, args: now(args) * x),
        diffrax.UnderdampedLangevinDiffusionTerm(1.0, 1.0, PATH),
    ),
}


def problem_of(terms, solver=None, y0=Y0, phi=None, args=None):
    phi = phi or (lambda t, y, args: y[1])
    solver = solver or ds.ImplicitMidpoint()
    return Problem.of(phi, terms, solver, 0, 1, 0.5, y0, args, None, 1)


def changes(terms, y, args):
    """The change of the state by each term."""
    drift, noise = split_terms(terms)
    unit = [jtu.tree_map(lambda x: 1 + 0 * x, term.contr(0.0, 0.1)) for term in noise]
    kicks = [term.vf_prod(0.0, y, args, w) for term, w in zip(noise, unit)]
    return jtu.tree_leaves((rate(drift, 0.0, y, args), kicks))


def as_given(terms, problem):
    """The terms that the user passed, with the paths of the problem."""
    remaining = iter(brownian_paths(problem.terms))
    return replace_paths(shapes_as_paths(terms), lambda path: next(remaining))


# One of each kind of term; the rest is for the whole suite.
QUICK = "H0", "friction", "term of the user's", "spins"


@pytest.mark.parametrize("name", slow_except(QUICK, TERMS))
def test_terms_are_those_of_now(name):
    global k
    terms = TERMS[name]()
    y0 = Y0
    if "spins" in name:
        y0 = ds.to_spinors(jnp.array([0.6, 0.0, 0.8]))
    found = []
    for k in (1.0, 5.0):
        problem = problem_of(terms, y0=y0)
        given = as_given(terms, problem)
        both = lambda y, k: (changes(problem.terms, y, None), changes(given, y, k))
        got, exact = jax.jit(both)(y0, k)
        for a, b in zip(got, exact, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-12)
        found.append(got)
    assert any(np.any(a != b) for a, b in zip(*found))


def test_everything_else_is_that_of_now():
    global k
    terms = ds.hamiltonian_terms(free, kick, ())
    y0_of = lambda key, args: (args, k * ONE)
    args_of = lambda key: k * ONE
    phi = lambda t, y, args: k * y[1]
    flow = lambda time, y, args: (y[0], y[1] + k * time * y[0])
    for k in (1.0, 5.0):
        problem = problem_of(terms, ds.BAOAB(flow), y0_of, phi, args_of)
        y0, args = problem.draw_start(jr.key(3))
        assert (*y0, args) == (k, k, k)
        assert problem.values(0.0, (ONE, 2 * ONE)) == 2 * k
        assert problem.solver.flow(1.0, (ONE, ONE), ONE)[1] == 1 + k


def spring(t, p, q, args):
    return (p**2 + k * q**2) / 2


STEPS = ds.StormerVerlet(), 0, 1, 0.25, (0 * ONE, ONE)


def mean(sampling):
    position = lambda t, y, args: y[1]
    given = position, still(()), *STEPS
    return ds.expectation(*given, key=jr.key(0), levels=1, sampling=sampling).mean


def still(path):
    return ds.hamiltonian_terms(spring, lambda t, p, q, args: 0.0 * q, path)


def of_key(key):
    return diffrax.diffeqsolve(still(ds.WeakBrownianPath((), key)), *STEPS).ys[1][-1]


def step_by_step():
    terms = still(ds.WeakBrownianPath((), jr.key(0)))
    y = STEPS[-1]
    for t in range(4):
        times = t / 4, (t + 1) / 4
        y = ds.step_expectation(terms, STEPS[0], *times, y, fn=lambda t, y, args: y)
    return y[1]


CALLS = {
    "IndependentPaths": lambda: mean(ds.IndependentPaths(2)),
    "ArrayRQMC": lambda: mean(ds.ArrayRQMC(4, 2, sort_by=lambda y: k * y[1])),
    "ensemble": lambda: ds.ensemble(still(()), *STEPS, key=jr.key(0), num_paths=2).ys[
        1
    ][0],
    "monte_carlo": lambda: ds.monte_carlo(of_key, key=jr.key(0), num_paths=2).mean,
    "step_expectation": step_by_step,
}


@pytest.mark.parametrize("name", slow_except(["IndependentPaths", "ensemble"], CALLS))
@pytest.mark.filterwarnings("ignore")
def test_calls_compute_with_the_functions_of_now(name):
    global k
    for k in (1.0, 5.0):
        p, q = 0.0, 1.0
        for _ in range(4):
            p = p - k * q / 8
            q = q + p / 4
            p = p - k * q / 8
        np.testing.assert_allclose(CALLS[name](), q, rtol=1e-6)


def test_allowed_states_are_those_of_the_constraint_of_now():
    global k
    rod = lambda q, args: jnp.stack([jnp.sum(q**2) - k])
    terms = ds.hamiltonian_terms(free, constraint=rod)
    for k in (1.0, 5.0):
        _, q = ds.constrained_state(terms, Y0)
        np.testing.assert_allclose(jnp.sum(q**2), k)


def test_functions_may_need_the_values_of_numbers_in_args():
    def well(t, p, q, args):
        return p**2 / 2 + (q**4 if args > 1 else q**2)

    terms = ds.hamiltonian_terms(well, lambda t, p, q, args: q, ())
    y0 = (0 * ONE, 2 * ONE)
    for args, force in ((0.3, -4.0), (1.7, -32.0)):
        problem = problem_of(terms, y0=y0, args=args)
        drift, _ = split_terms(problem.terms)
        assert rate(drift, 0.0, y0, problem.args)[0] == force
