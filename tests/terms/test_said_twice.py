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


def test_a_bath_shares_its_key_with_no_other_term():
    suggest = TAKING["suggest_solver"]
    gaussian = ds.FixedStepBrownianPath((), jr.key(0), diffrax.SpaceTimeLevyArea)
    others = ds.WeakBrownianPath((), jr.PRNGKey(0)), gaussian
    refused = [(suggest, baths(path(0), path(0)))]
    refused += [(take, noise_beside(path(0), path(0))) for take in TAKING.values()]
    refused += [(suggest, noise_beside(path(0), other)) for other in others]
    refused += [(suggest, noise_beside(other, path(0))) for other in others]
    for take, terms in refused:
        with pytest.raises(ValueError, match="key1, key2 = jax.random.split"):
            take(terms)
    # A path may share its key with what is around it.
    plateaus = ds.PlateauVerlet().path((), jr.key(0))
    for terms in (
        noise_beside(path(0), path(1)),
        ds.langevin_terms(WELL, 1.0, 1.0, plateaus),
    ):
        suggest(terms)


def test_noises_of_one_path_are_one_noise_and_those_of_two_are_two():
    more = lambda noise, seed: ds.noise_terms(noise, path(seed)).terms
    one = ds.hamiltonian_terms(WELL, SPRING, path(0)).terms
    double = lambda t, p, q, args: 2 * SPRING(t, p, q, args)
    kick = lambda t, p, q, args: 0.3 * q
    both = lambda t, p, q, args: jnp.stack([SPRING(t, p, q, args), kick(t, p, q, args)])
    equal = [
        diffrax.MultiTerm(*one, *more(SPRING, 0)),
        ds.hamiltonian_terms(WELL, double, path(0)),
        diffrax.MultiTerm(*one, *more(kick, 1)),
        ds.hamiltonian_terms(WELL, both, ds.WeakBrownianPath((2,), jr.key(0))),
    ]
    of = lambda terms: ds.second_moment_map(terms, ds.StormerVerlet(), 0.0, 0.25, ONE)
    moments = jax.jit(lambda: [of(terms) for terms in equal])()
    for pair in (moments[:2], moments[2:]):
        np.testing.assert_allclose(*pair, rtol=1e-13, atol=1e-15)


def doubled(first=WELL, second=WELL):
    terms = ds.langevin_terms(first, 1.0, 1.0, path(0))
    more = ds.hamiltonian_terms(second, SPRING, path(1))
    return diffrax.MultiTerm(*terms.terms, *more.terms)


def test_a_hamiltonian_counts_once():
    for take in TAKING.values():
        with pytest.raises(ValueError, match=r"`noise_terms\(noise, path\)`"):
            take(doubled())
    other = lambda t, p, q, args: q**4 / 4
    for solver in (ds.BAOAB(), ds.ImplicitMidpoint()):
        with pytest.raises(ValueError, match="stands in two drift terms"):
            diffrax.diffeqsolve(doubled(), solver, 0, 1, 0.5, ONE)
        solver.init(doubled(WELL, other), 0, 0.5, ONE, None)


def test_noise_alone_is_that_of_the_whole_terms():
    drift, noise = ds.hamiltonian_terms(WELL, SPRING, path(1)).terms
    (alone,) = ds.noise_terms(SPRING, path(1)).terms
    assert type(alone) is type(noise)
    one = jnp.ones(())
    assert alone.vf_prod(0.0, ONE, None, one) == noise.vf_prod(0.0, ONE, None, one)


def test_of_several_traced_paths_it_is_not_known_whether_they_are_one():
    def mean(terms):
        return ds.step_expectation(terms, ds.BAOAB(), 0.0, 0.1, ONE, fn=POSITION)

    terms = noise_beside(path(0), path(1))
    with pytest.raises(ValueError, match="Construct the terms outside of `jax.jit`"):
        eqx.filter_jit(mean)(terms)
    np.testing.assert_allclose(jax.jit(lambda: mean(terms))(), mean(terms), rtol=1e-12)
