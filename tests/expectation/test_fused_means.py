"""`expectation` by fused kernels."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..drjit_here import needs_drjit
from ..test_ensemble import follow, ONE


def phi(t, y, args):
    return {"tanh": jnp.tanh(y[1]), "t": t * jnp.tanh(y[0])}


# Paths that reach zero fail.
SINGULAR = ds.hamiltonian_terms(
    lambda t, p, q, args: p**2 / 2 + jnp.sqrt(q),
    lambda t, p, q, args: 2 * q**2,
    ds.FixedStepBrownianPath((), jr.key(0)),
)


def mean(**kwargs):
    kwargs = dict(key=jr.key(1), sampling=ds.IndependentPaths(300, 128)) | kwargs
    solver = ds.StormerVerlet()
    return ds.expectation(phi, SINGULAR, solver, 0.0, 4.0, 0.25, ONE, **kwargs)


@needs_drjit
@pytest.mark.filterwarnings("ignore")
def test_means_are_those_of_the_same_paths_without_those_that_failed():
    # Later parts are not looked at.
    kwargs = dict(ts=[0.5, 4.0], levels=2, first=300)
    fused, exact = mean(engine="drjit", **kwargs), mean(**kwargs)
    assert fused.num_paths == exact.num_paths
    assert 0 < fused.num_failed == exact.num_failed < 300
    assert jax.tree.structure(fused.mean) == jax.tree.structure(exact.mean)
    for a, b in ((fused.mean, exact.mean), (fused.std_error, exact.std_error)):
        for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b)):
            np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-13)


@needs_drjit
def test_other_samplings_and_engines_are_refused():
    with pytest.raises(ValueError, match="takes independent paths"):
        mean(engine="drjit", sampling=ds.ArrayRQMC(64, 4))
    with pytest.raises(ValueError, match="`engine` must be"):
        mean(engine="numba")


@needs_drjit
@pytest.mark.parametrize("change", [dict(rtol=1e-4), dict(atol=1e-4)], ids=str)
def test_another_tolerance_than_rounding_error_is_refused(change):
    solver = ds.ImplicitMidpoint(root_finder=ds.PicardNewton(**change))
    (name,) = change
    with pytest.raises(
        ValueError, match=rf"rounding error; got `PicardNewton\({name}="
    ):
        follow(solver=solver, engine="drjit")
    # JAX takes the paths that need Newton's method.
    solver = ds.ImplicitMidpoint(root_finder=ds.PicardNewton(newton_steps=50))
    assert follow(solver=solver, engine="drjit").num_failed == 0
