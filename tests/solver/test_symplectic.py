"""Every step is symplectic to rounding error, whatever the Hamiltonians."""

import dataclasses

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_symplectic as ds

from ..families import slow_except
from ..picard import Picard
from ..problems import GENERAL, Given, H0, noise, random_problem


def _weak(m, key, dtype=jnp.float64):
    return ds.WeakBrownianPath(jax.ShapeDtypeStruct((m,), dtype), key)


def test_defect_sees_a_method_that_is_not_symplectic():
    y0, args = random_problem(jr.key(0), 1, 1)
    terms = ds.hamiltonian_terms(H0, noise, _weak(1, jr.key(1)))
    defect = lambda *y: ds.symplecticity_defect(terms, diffrax.Heun(), 0.0, 0.1, *y)
    assert jax.jit(defect)(y0, args) > 1e-6


@pytest.mark.parametrize(
    "name, dtype",
    [
        ("ImplicitMidpoint", jnp.float64),
        ("ImplicitMidpoint", jnp.float32),
        ("SRKw2", jnp.float64),
    ],
)
@pytest.mark.slow
def test_stage_equations_are_solved_to_rounding_error(name, dtype):
    solver = GENERAL[name]
    # Derivatives are implicit, and those of steps would be symplectic at any approximate
    # solution. So the end of the step is compared to a solve that goes on and on.
    stubborn = Picard(atol=-1.0)
    exact = dataclasses.replace(solver, root_finder=stubborn, root_find_max_steps=250)

    ravel = jnp.concatenate

    def ends(key):
        y0, args = random_problem(key, 2, 2, dtype)
        terms = ds.hamiltonian_terms(H0, noise, _weak(2, key, dtype))
        step = lambda s, y: s.step(terms, dtype(0.0), dtype(0.1), y, args, None, False)
        y1, *_, result = step(solver, y0)
        success = result == diffrax.RESULTS.successful
        # What becomes of a small change of the start, one of its entries at a time.
        size = jnp.sqrt(jnp.finfo(dtype).eps)
        starts = ravel(y0) + size * jnp.eye(5, 4, k=-1, dtype=dtype)
        end = lambda y: ravel(step(exact, tuple(jnp.split(y, 2)))[0])
        y1_exact, *moved = jax.vmap(end)(starts)
        gain = jnp.max(jnp.abs(jnp.stack(moved) - y1_exact)) / size
        return ravel(y1), y1_exact, gain, success

    y1, y1_exact, gain, success = jax.jit(jax.vmap(ends))(jr.split(jr.key(1), 300))
    assert jnp.all(success)
    error = jnp.max(jnp.abs(y1 - y1_exact) / (1 + jnp.abs(y1_exact)), axis=1)
    assert jnp.max(error / gain) <= 4 * jnp.finfo(dtype).eps


def test_defect_needs_a_pair():
    terms = diffrax.ODETerm(lambda t, y, args: -y)
    with pytest.raises(ValueError, match=r"pair `\(p, q\)`"):
        ds.symplecticity_defect(terms, ds.ImplicitMidpoint(), 0.0, 0.1, jnp.ones(3))


@pytest.mark.parametrize(
    "solver", slow_except([ds.SRKs2()], [ds.ImplicitMidpoint(), ds.SRKs2()]), ids=repr
)
@pytest.mark.core
def test_steps_of_any_length_that_succeed_solve_their_equations(solver):
    # Fixed-point iterations on stiff springs that are not linear leave by powers of three.
    # What Newton's method makes of that depends on the rounding errors of the program, and
    # in batches of this size on CPUs the maximum of NaNs is -inf.
    def step(key):
        k_w, k_c, k_y, k_h = jr.split(key, 4)
        w = 100 * jnp.exp(jr.uniform(k_w, (2,), minval=-2, maxval=6))
        c = 1e4 * jnp.exp(jr.uniform(k_c, minval=-5, maxval=5))

        def H0(t, p, q, args):
            return jnp.sum(p**2 + w**2 * q**2) / 2 + c * (q[1] - q[0]) ** 4 / 4

        nothing = lambda t, p, q, args: 0.0 * jnp.sum(q)
        terms = ds.hamiltonian_terms(H0, nothing, Given(jnp.zeros(())))
        h = jnp.exp(jr.uniform(k_h, minval=-5, maxval=3)) / 100
        y0 = tuple(jr.normal(k_y, (2, 2)))
        y1, *_, result = solver.step(terms, 0.0, h, y0, None, None, False)
        # Without noise both solvers are the midpoint rule.
        y0, y1 = jnp.stack(y0), jnp.stack(y1)
        rate = jnp.stack(terms.terms[0].vf(0.0, tuple((y0 + y1) / 2), None))
        error = jnp.max(jnp.abs(y1 - y0 - h * rate)) / jnp.max(jnp.abs(y1))
        return result == diffrax.RESULTS.successful, error

    success, error = jax.jit(jax.vmap(step))(jr.split(jr.key(0), 2100))
    assert jnp.mean(success) >= 0.99
    assert jnp.max(error[success]) <= 1e-6
