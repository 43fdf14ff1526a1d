"""The step of friction and noise for more momenta than are solved for in each step."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._solver import bath

from ..conftest import OPTIMIZED
from ..problems import as_friction


N = 20
_RNG = np.random.default_rng(0)
_ROOT = _RNG.normal(size=(N, N)) / N**0.5
FULL = _ROOT @ _ROOT.T + 0.1 * np.eye(N)
# Friction between neighbours, which conserves the total momentum.
_NEIGHBOURS = np.eye(N) - np.roll(np.eye(N), 1, axis=0)
PAIRS = _NEIGHBOURS @ _NEIGHBOURS.T
INVERSE_MASSES = np.diag(np.linspace(0.5, 3.0, N)) + 0.1
P, Q, KICK = _RNG.normal(size=(3, N))


def H0(t, p, q, args):
    return p @ INVERSE_MASSES @ p / 2 + jnp.sum(q**4)


def _friction_term(friction):
    """The term of a matrix, or of a function with matrices as values."""
    if callable(friction):
        at = lambda t, q, args: as_friction(friction(t, q, args))
    else:
        at = as_friction(friction)
    return ds.bath_terms(H0, at).terms


def _after(terms, args=None):
    return bath.after_friction(terms, 0.0, 0.1, (P, Q), args, KICK)


def _exact(friction):
    A = friction @ INVERSE_MASSES
    return P + np.linalg.solve(np.eye(N) + 0.05 * A, -0.1 * A @ P + KICK)


def _modes(terms, args=None):
    return bath._matrices_if_constant(terms, 0.0, (P, Q), args)


def test_friction_by_its_modes_or_not_solves_the_equation_of_the_step():
    two = (*_friction_term(FULL), *_friction_term(PAIRS))
    # Modes serve what is the same at all times and positions, and nothing else.
    assert _modes(_friction_term(lambda t, q, args: args * FULL), jnp.array(2.0))
    heavier = lambda t, p, q, args: (1 + q[0] ** 2) * jnp.sum(p**2)
    for terms in (
        _friction_term(lambda t, q, args: (1 + t) * FULL),
        _friction_term(lambda t, q, args: (1 + q[0] ** 2) * FULL),
        ds.bath_terms(heavier, as_friction(FULL)).terms,
        two,
    ):
        assert _modes(terms) is None
    # As Diffrax passes it to a solver.
    wrap = lambda friction, direction: tuple(
        diffrax._term.WrapTerm(term, direction) for term in _friction_term(friction)
    )
    forward, backward = wrap(FULL, 1), wrap(PAIRS, -1)
    assert _modes(forward) is not None and _modes(backward) is not None
    indefinite = _friction_term(lambda t, q, args: -FULL)
    cases = forward, backward, two, indefinite
    *got, failed = jax.jit(lambda: [_after(terms) for terms in cases])()
    for end, friction in zip(got, (FULL, -PAIRS, FULL + PAIRS)):
        np.testing.assert_allclose(end, _exact(friction), rtol=0, atol=1e-13)
    assert np.all(np.isnan(failed))


def test_derivatives_are_those_of_the_equation_also_for_equal_rates():
    # Derivatives of eigenvectors of equal eigenvalues are infinite.
    weights = np.cos(np.arange(N))

    def by_modes(scale, friction):
        terms = _friction_term(lambda t, q, args: args * friction)
        return weights @ _after(terms, scale)

    def by_solve(scale, friction):
        A = scale * friction @ INVERSE_MASSES
        right = -0.1 * A @ P + KICK
        return weights @ (P + jnp.linalg.solve(jnp.eye(N) + 0.05 * A, right))

    def derivatives(scale, friction):
        return [
            derivative(fn)(scale, friction)
            for derivative in (jax.grad, jax.jacfwd)
            for fn in (by_modes, by_solve)
        ]

    for friction in (FULL, jnp.eye(N)):
        grad, exact, jacobian, exact_too = jax.jit(derivatives)(1.2, friction)
        np.testing.assert_allclose(grad, exact, rtol=1e-12)
        np.testing.assert_allclose(jacobian, exact_too, rtol=1e-12)


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="LAPACK serves CPUs")
@pytest.mark.skipif(not OPTIMIZED, reason="The suite leaves this optimization out")
@pytest.mark.core
@pytest.mark.slow
def test_a_constant_matrix_is_diagonalized_once_before_the_loop_over_steps():
    solver = ds.BAOAB()
    friction = lambda t, q, args: as_friction(args)
    path = solver.path((N,), jax.random.key(0))
    terms = ds.langevin_terms(H0, friction, 1.0, path)

    @jax.jit
    def solve(y0, friction):
        return diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.1, y0, friction).ys

    program = solve.lower((P, Q), FULL).compile().as_text()
    before, entry = program.split("ENTRY")
    assert "lapack" in entry and "lapack" not in before
