"""Exact checks of one step: symplecticity, weak orders, moments."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..families import slow_except
from ..problems import Given, kubo_terms, weak_path


def test_weak_order_defect_knows_ito_from_stratonovich_and_methods_of_lower_order():
    # dy = y dw: Euler's E[y^2] = (1 + h) y^2 is Itô's to first order.
    drift = diffrax.ODETerm(lambda t, y, args: jnp.zeros_like(y))
    diffusion = diffrax.ControlTerm(lambda t, y, args: y[:, None], weak_path(1))
    at = diffrax.MultiTerm(drift, diffusion), 0.0, 0.1, jnp.array([1.0])
    square = lambda t, y, args: y[0] ** 2

    @jax.jit
    def defects():
        terms, *rest = at
        defect = lambda solver, order: ds.weak_order_defect(
            terms, solver, *rest, fn=square, order=order
        )
        return defect(diffrax.Euler(), 1), *(defect(diffrax.Heun(), n) for n in (1, 2))

    # Heun: y1 = (1 + I + I^2 / 2) y, so E[y1^2] = 1 + 2 h + 3 h^2 / 4. Stratonovich's is
    # exp(2 h).
    exact = [0, 0.75 * 0.1**2, (0.75 - 2) * 0.1**2]
    np.testing.assert_allclose(defects(), exact, atol=1e-15)


def test_expectation_needs_paths_of_known_laws():
    y0 = jnp.array(0.0), jnp.array(1.0)
    fn = lambda t, y, args: y[0]
    at = ds.ImplicitMidpoint(), 0.0, 0.1, y0
    area = diffrax.SpaceTimeLevyArea
    cut = ds.TruncatedBrownianPath(diffrax.UnsafeBrownianPath((), jr.key(0), area))
    known = kubo_terms(ds.WeakBrownianPath((), jr.key(0)))
    for terms in (
        kubo_terms(cut),
        kubo_terms(ds.PlateauBrownianPath(cut, jr.key(1))),
        diffrax.MultiTerm(known, kubo_terms(cut).terms[1]),
        diffrax.MultiTerm(known.terms[0]),
    ):
        with pytest.raises(ValueError, match="must hold Brownian paths whose laws"):
            ds.step_expectation(terms, *at, fn=fn)
    # Shapes of paths are told to be shapes.
    field = lambda t, y, args: jax.tree.map(lambda x: x[..., None], y)
    control = diffrax.ControlTerm(field, (1,))  # pyright: ignore
    drift, noise = kubo_terms(()).terms
    for term in (noise, control):
        terms = diffrax.MultiTerm(drift, term)
        for call in (ds.second_moment_map, ft.partial(ds.step_expectation, fn=fn)):
            with pytest.raises(
                ValueError, match=r"pass `path=solver.path\(shape, key\)`"
            ):
                call(terms, *at)


def test_symplecticity_defect_sees_a_method_that_is_not_symplectic_and_needs_a_pair():
    # Of an oscillator over the angle x the step of Heun's method multiplies areas by
    # (1 - x^2 / 2)^2 + x^2.
    terms = kubo_terms(Given(jnp.array(0.3)))
    defect = lambda *y: ds.symplecticity_defect(terms, diffrax.Heun(), 0.0, 0.1, *y)
    found = jax.jit(defect)((jnp.array(0.0), jnp.array(1.0)))
    np.testing.assert_allclose(found, 0.4**4 / 4, rtol=1e-13)
    with pytest.raises(ValueError, match=r"pair `\(p, q\)`"):
        defect(jnp.ones(3))


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
