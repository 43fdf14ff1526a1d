"""The step of friction and noise for more momenta than are solved for in each step."""

import os
import subprocess
import sys

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._solver import bath

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
    step = lambda: bath.after_friction(terms, 0.0, 0.1, (P, Q), args, KICK)
    return jax.jit(step)()


def _exact(friction):
    A = friction @ INVERSE_MASSES
    return P + np.linalg.solve(np.eye(N) + 0.05 * A, -0.1 * A @ P + KICK)


@pytest.mark.parametrize(
    "friction, direction", [(FULL, 1), (PAIRS, -1)], ids=["full", "pairs back"]
)
def test_friction_by_its_modes_solves_the_equation_of_the_step(friction, direction):
    (term,) = _friction_term(friction)
    # As Diffrax passes it to a solver.
    wrapped = diffrax._term.WrapTerm(term, direction)
    assert bath._matrices_if_constant((wrapped,), 0.0, (P, Q), None) is not None
    exact = _exact(direction * friction)
    np.testing.assert_allclose(_after((wrapped,)), exact, rtol=0, atol=1e-13)


def test_modes_serve_what_is_the_same_at_all_times_and_positions_and_nothing_else():
    def modes(friction, args=None):
        terms = _friction_term(friction)
        return bath._matrices_if_constant(terms, 0.0, (P, Q), args)

    assert modes(lambda t, q, args: args * FULL, jnp.array(2.0)) is not None
    assert modes(lambda t, q, args: (1 + t) * FULL) is None
    assert modes(lambda t, q, args: (1 + q[0] ** 2) * FULL) is None
    heavier = lambda t, p, q, args: (1 + q[0] ** 2) * jnp.sum(p**2)
    terms = ds.bath_terms(heavier, as_friction(FULL)).terms
    assert bath._matrices_if_constant(terms, 0.0, (P, Q), None) is None
    two = (*_friction_term(FULL), *_friction_term(PAIRS))
    assert bath._matrices_if_constant(two, 0.0, (P, Q), None) is None
    np.testing.assert_allclose(_after(two), _exact(FULL + PAIRS), rtol=0, atol=1e-13)


def test_a_matrix_of_a_function_that_is_not_semidefinite_fails():
    assert np.all(np.isnan(_after(_friction_term(lambda t, q, args: -FULL))))


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

    for derivative in (jax.grad, jax.jacfwd):
        got, exact = (jax.jit(derivative(fn)) for fn in (by_modes, by_solve))
        for friction in (FULL, jnp.eye(N)):
            np.testing.assert_allclose(
                got(1.2, friction), exact(1.2, friction), rtol=1e-12
            )


_PROGRAM = """
import jax, jax.numpy as jnp, jax.random as jr, diffrax, diffrax_symplectic as ds
import lineax as lx
jax.config.update("jax_enable_x64", True)
n = 20
H0 = lambda t, p, q, args: p @ p / 2 + jnp.sum(q**4)
solver = ds.BAOAB()
def friction(t, q, args):
    return lx.MatrixLinearOperator(args, lx.positive_semidefinite_tag)
terms = ds.langevin_terms(H0, friction, 1.0, solver.path((n,), jr.key(0)))
def solve(y0, friction):
    return diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.1, y0, friction).ys
y0 = jnp.ones(n), jnp.ones(n)
program = jax.jit(solve).lower(y0, jnp.eye(n) + 0.1).compile().as_text()
before, entry = program.split("ENTRY")
print("lapack" in entry, "lapack" in before)
"""


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="LAPACK serves CPUs")
@pytest.mark.slow
def test_a_constant_matrix_is_diagonalized_once_before_the_loop_over_steps():
    # As users compile it: the suite leaves this optimization out.
    left_out = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
    env = {name: value for name, value in os.environ.items() if name not in left_out}
    command = [sys.executable, "-c", _PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, env=env)
    assert done.stdout.split() == ["True", "False"], done.stderr
