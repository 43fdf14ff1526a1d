"""Terms that count something twice are refused, and noise is had alone."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds


ONE = jnp.array(0.0), jnp.array(1.0)
WELL = lambda t, p, q, args: (p**2 + q**2) / 2
SPRING = lambda t, p, q, args: -0.6 * q**2 / 2
POSITION = lambda t, y, args: y[1] ** 2


def path(seed):
    return ds.WeakBrownianPath((), jr.key(seed))


def baths(first, second):
    terms = ds.langevin_terms(WELL, 1.0, 1.0, first)
    return diffrax.MultiTerm(*terms.terms, *ds.bath_terms(WELL, 1.0, 1.0, second).terms)


def noise_beside(first, second):
    terms = ds.langevin_terms(WELL, 1.0, 1.0, first)
    return diffrax.MultiTerm(*terms.terms, *ds.noise_terms(SPRING, second).terms)


# What takes terms with concrete keys.
TAKING = {
    "expectation": lambda terms: ds.expectation(
        POSITION, terms, ds.BAOAB(), 0, 1, 0.5, ONE, key=jr.key(0),
        sampling=ds.IndependentPaths(2),
    ),
    "ensemble": lambda terms: ds.ensemble(
        terms, ds.BAOAB(), 0, 1, 0.5, ONE, key=jr.key(0), num_paths=2
    ),
    "suggest_solver": lambda terms: ds.suggest_solver(terms, 0.0, ONE, want="weak"),
    "step_expectation": lambda terms: ds.step_expectation(
        terms, ds.BAOAB(), 0.0, 0.1, ONE, fn=POSITION
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", TAKING)
@pytest.mark.parametrize("make", [baths, noise_beside])
def test_a_bath_shares_its_key_with_no_other_term(name, make):
    area = diffrax.SpaceTimeLevyArea
    gaussian = ds.FixedStepBrownianPath((), jr.key(0), levy_area=area)
    same = [path(0), ds.WeakBrownianPath((), jr.PRNGKey(0)), gaussian]
    for other in same if name == "suggest_solver" else same[:1]:
        for terms in (make(path(0), other), make(other, path(0))):
            with pytest.raises(ValueError, match="key1, key2 = jax.random.split"):
                TAKING[name](terms)
    TAKING[name](make(path(0), path(1)))


def test_other_terms_may_share_a_path_and_a_path_its_own_key():
    plateaus = ds.PlateauVerlet().path((), jr.key(0))
    TAKING["suggest_solver"](ds.langevin_terms(WELL, 1.0, 1.0, plateaus))
    one = ds.hamiltonian_terms(WELL, SPRING, path(0))
    twice = diffrax.MultiTerm(*one.terms, *ds.noise_terms(SPRING, path(0)).terms)
    double = lambda t, p, q, args: 2 * SPRING(t, p, q, args)
    expected = ds.hamiltonian_terms(WELL, double, path(0))
    np.testing.assert_allclose(
        *[
            ds.second_moment_map(terms, ds.StormerVerlet(), 0.0, 0.1, ONE)
            for terms in (twice, expected)
        ],
        rtol=1e-13,
        atol=1e-15,
    )


def doubled(first=WELL, second=WELL):
    terms = ds.langevin_terms(first, 1.0, 1.0, path(0))
    more = ds.hamiltonian_terms(second, SPRING, path(1))
    return diffrax.MultiTerm(*terms.terms, *more.terms)


@pytest.mark.parametrize("name", TAKING)
def test_a_hamiltonian_counts_once(name):
    with pytest.raises(ValueError, match=r"`noise_terms\(noise, path\)`"):
        TAKING[name](doubled())


@pytest.mark.parametrize("solver", [ds.BAOAB(), ds.ImplicitMidpoint()])
def test_a_hamiltonian_counts_once_in_a_solve(solver):
    with pytest.raises(ValueError, match="stands in two drift terms"):
        diffrax.diffeqsolve(doubled(), solver, 0, 1, 0.5, ONE)
    other = lambda t, p, q, args: q**4 / 4
    diffrax.diffeqsolve(doubled(WELL, other), solver, 0, 1, 0.5, ONE)


def test_noise_alone_is_that_of_the_whole_terms():
    drift, noise = ds.hamiltonian_terms(WELL, SPRING, path(1)).terms
    (alone,) = ds.noise_terms(SPRING, path(1)).terms
    assert type(alone) is type(noise)
    one = jnp.ones(())
    assert alone.vf_prod(0.0, ONE, None, one) == noise.vf_prod(0.0, ONE, None, one)
    with pytest.raises(ValueError, match="`structure` must be one of"):
        ds.noise_terms(SPRING, path(1), structure="any")  # pyright: ignore
    with pytest.raises(ValueError, match="`noise` must be a function"):
        ds.noise_terms(None, path(1))  # pyright: ignore
    with pytest.raises(ValueError, match="`path` must be a Brownian path"):
        ds.noise_terms(SPRING, None)


@pytest.mark.slow
def test_two_paths_are_one_of_two_noises():
    both = lambda t, p, q, args: jnp.stack([SPRING(t, p, q, args), 0.3 * q])
    together = ds.hamiltonian_terms(WELL, both, ds.WeakBrownianPath((2,), jr.key(0)))
    apart = diffrax.MultiTerm(
        *ds.hamiltonian_terms(WELL, SPRING, path(0)).terms,
        *ds.noise_terms(lambda t, p, q, args: 0.3 * q, path(1)).terms,
    )
    solver, h = ds.StormerVerlet(), 0.25
    K = [
        ds.second_moment_map(terms, solver, 0.0, h, ONE) for terms in (together, apart)
    ]
    np.testing.assert_allclose(K[1], K[0], rtol=1e-13, atol=1e-15)
    z = np.array([1.0, 0.0, 1.0])
    moments = np.linalg.matrix_power(K[0], 4) @ np.kron(z, z)
    options = dict(key=jr.key(2), sampling=ds.ValueFunctions(2, 64), levels=1)
    for terms in (together, apart):
        mean = ds.expectation(POSITION, terms, solver, 0, 1, h, ONE, **options).mean
        np.testing.assert_allclose(mean, moments[-1], rtol=1e-9)


def test_of_several_traced_paths_it_is_not_known_whether_they_are_one():
    def mean(terms):
        return ds.step_expectation(terms, ds.BAOAB(), 0.0, 0.1, ONE, fn=POSITION)

    terms = noise_beside(path(0), path(1))
    with pytest.raises(ValueError, match="Construct the terms outside of `jax.jit`"):
        eqx.filter_jit(mean)(terms)
    np.testing.assert_allclose(jax.jit(lambda: mean(terms))(), mean(terms), rtol=1e-12)


@pytest.mark.slow
def test_a_noisy_spring_beside_a_bath_is_as_hot_as_the_exact_moments_say():
    # 2 g <p^2> = 2 g T + s^2 <q^2> and <p^2> = <q^2>.
    estimate = ds.expectation(
        POSITION, noise_beside((), ()), ds.BAOAB(), 0, 20, 0.1, ONE,
        key=jr.key(3), sampling=ds.ValueFunctions(2, 256),
    )  # fmt: skip
    assert abs(estimate.mean - 1 / (1 - 0.6**2 / 2)) < 2e-3
