"""What `expectation` cannot do is refused with advice that fits."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import is_random
from diffrax_symplectic._terms import brownian_paths, path_keys, with_keys

from ..drjit_here import needs_drjit
from ..solver.test_times_and_paths import RECORD
from .cells import Cell, moment
from .steps import problem_of


def H0(t, p, q, args):
    return p**2 / 2 + q**2 / 2


Y0 = jnp.zeros(()), jnp.ones(())


def _mean(path, sampling=None, **others):
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.1 * q, path)
    given = lambda t, y, args: y[1] ** 2, terms, ds.StormerVerlet(), 0.0, 1.0, 0.1, Y0
    return ds.expectation(*given, key=jr.key(0), sampling=sampling, **others)


@pytest.mark.parametrize(
    "sampling", [None, ds.IndependentPaths(100), ds.ArrayRQMC(), ds.ValueFunctions()]
)
def test_recorded_noise_has_no_mean(sampling):
    with pytest.raises(ValueError, match="has a random key.*`diffrax.diffeqsolve`"):
        _mean(RECORD, sampling)


class OwnPath(diffrax.AbstractBrownianPath):
    """A path of a user's own that draws its noise."""

    key: jax.Array
    t0 = 0.0
    t1 = jnp.inf
    levy_area = diffrax.BrownianIncrement

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        number = jnp.round(10 * t0).astype(int)
        return jnp.sqrt(t1 - t0) * jr.normal(jr.fold_in(self.key, number))


def test_random_noise_of_a_path_of_ones_own_has_one():
    estimate = _mean(OwnPath(jr.key(0)), ds.IndependentPaths(4000), levels=1)
    exact = moment(Cell("additive", 0.1, 1.0, 10), 2)[4]
    assert 0 < abs(estimate.mean - exact) <= 4 * estimate.std_error


def test_only_the_key_of_a_path_is_replaced():
    key, old, table = jr.key(0), jr.PRNGKey(0), jnp.arange(5, dtype=jnp.uint32)
    path = OwnPath((key, {"table": table, "old": old}))
    assert not is_random(OwnPath(table)) and is_random(OwnPath(old))
    new = with_keys(path, path_keys(path, jr.key(1))).key
    assert new[1]["table"] is table
    np.testing.assert_array_equal(jr.key_data(new[0]), new[1]["old"])
    assert not np.array_equal(new[1]["old"], old)


def test_times_between_steps_are_told_in_few_words_with_the_advice_first():
    path = ds.WeakBrownianPath((), jr.key(0))
    with pytest.raises(ValueError, match="^Choose a `dt0`") as info:
        _mean(path, ts=np.linspace(0, 1, 1000))
    assert len(str(info.value)) < 300
    with pytest.raises(ValueError, match="all between `t0` and `t1`") as info:
        _mean(path, ts=np.linspace(0, 2, 21))
    assert len(str(info.value)) < 200


@pytest.mark.parametrize("cell, t0, levels", [(0.2, 0, 1), (0.1, 0, 2), (0.1, 0.05, 1)])
def test_steps_of_a_path_with_cells_consist_of_whole_cells(cell, t0, levels):
    path = ds.FixedStepBrownianPath((), jr.key(0), cell=cell)
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.1 * q, path)
    given = lambda t, y, args: y[1], terms, ds.StormerVerlet(), t0, t0 + 1, 0.1, Y0
    with pytest.raises(ValueError, match="must begin and end at multiples of `cell`"):
        ds.expectation(*given, key=jr.key(0), levels=levels)


def test_a_control_term_may_have_the_shape_of_its_path():
    field = lambda t, y, args: jnp.array([[1.0, 2.0, 2.0]])
    drift = diffrax.ODETerm(lambda t, y, args: -y)
    terms_with = lambda path: diffrax.MultiTerm(drift, diffrax.ControlTerm(field, path))
    problem = problem_of(terms_with((3,)), ds.SRKw5(), 0.5, jnp.zeros(1))
    (path,) = brownian_paths(problem.terms)
    assert path.shape == jax.ShapeDtypeStruct((3,), jnp.float64)
    suggestions = ds.suggest_solver(terms_with((3,)), 0.0, jnp.zeros(1), want="weak")
    assert suggestions[0].solver == ds.AdditiveGauss()
    with pytest.raises(ValueError, match="or its shape `.m,.`; got a list"):
        problem_of(terms_with([3]), ds.SRKw5(), 0.5, jnp.zeros(1))


def _spring(size):
    """Terms that close over `size`."""
    energy = lambda t, p, q, args: p**2 / 2 + size * q**2
    return ds.hamiltonian_terms(energy, lambda t, p, q, args: -q, ())


def _of_system(call, **others):
    y0 = jnp.array(0.0), jnp.array(1.0)
    fixed = dict(key=jr.key(0), **others)
    return lambda size: call(
        _spring(size), ds.StormerVerlet(), 0, 0.2, 0.1, y0, **fixed
    )


def _compared(terms, solver, t0, t1, dt0, y0, **others):
    found = ds.compare_solvers(terms, [solver], t0, t1, [dt0], y0, **others)
    return found.steps[0].error


_mean_of_q = ft.partial(ds.expectation, lambda t, y, args: y[1])
_fits = ds.ValueFunctions(degree=2, num_paths=8)
CLOSURES = {
    "monte_carlo": lambda size: ds.monte_carlo(
        lambda key: size * jr.normal(key), key=jr.key(0), num_paths=2
    ),
    "IndependentPaths": _of_system(_mean_of_q, sampling=ds.IndependentPaths(8)),
    "ValueFunctions": pytest.param(
        _of_system(_mean_of_q, sampling=_fits), marks=pytest.mark.slow
    ),
    "ensemble": _of_system(ds.ensemble, num_paths=8),
    "ensemble, fused": pytest.param(
        _of_system(ds.ensemble, num_paths=8, engine="drjit"), marks=needs_drjit
    ),
    "compare_solvers": pytest.param(
        _of_system(_compared, num_paths=8), marks=pytest.mark.slow
    ),
}


@pytest.mark.parametrize("call", CLOSURES.values(), ids=CLOSURES)
def test_functions_that_close_over_traced_values_have_no_estimate(call):
    on_batch = lambda call: lambda size: jax.vmap(call)(jnp.full(2, size))
    for transform in (jax.grad, jax.jit, on_batch):
        with pytest.raises(ValueError, match="cannot run inside JAX.*`monte_carlo`"):
            transform(call)(1.0)


def test_steps_that_single_precision_does_not_resolve_are_refused_at_once():
    single = jax.ShapeDtypeStruct((), jnp.float32)
    path = ds.WeakBrownianPath(single, jr.key(0))
    y0 = jnp.zeros((), jnp.float32), jnp.ones((), jnp.float32)
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.1 * q, path)
    given = terms, ds.StormerVerlet(), 0.1, y0
    with pytest.raises(ValueError, match="100 times the rounding.*float32"):
        problem_of(*given, t0=1e6)
    problem_of(*given, t0=100.0)


def test_a_function_of_spins_is_told_that_it_gets_a_pair():
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.spin_terms(lambda t, s, args: s[2], lambda t, s, args: 0.1 * s[0], path)
    y0 = ds.to_spinors(jnp.array([0.6, 0.0, 0.8]))
    mean = lambda phi: ds.expectation(
        phi, terms, ds.ImplicitMidpoint(), 0.0, 0.2, 0.1, y0, key=jr.key(0),
        sampling=ds.IndependentPaths(10),
    )  # fmt: skip
    for phi in (lambda s: s[2], lambda s: s[..., 2], lambda s: s.sum()):
        with pytest.raises(Exception, match=r"from_spinors\(y\)") as info:
            mean(lambda t, s, args: phi(s))
        assert not any("left out" in note for note in info.value.__notes__)
    # What was left out is still told.
    with pytest.raises(TypeError, match="Was it left out"):
        mean(lambda t, y, args: args["size"] * ds.from_spinors(y)[2])
