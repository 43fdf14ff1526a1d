"""Gaussian increments are truncated only where an implicit step needs it: the laws are the
exact ones, and what is lost otherwise is said."""

import itertools
import re
import warnings

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import lost_variance
from diffrax_symplectic._simulation import Problem
from diffrax_symplectic._terms import brownian_paths


ONE = jnp.array(0.0), jnp.array(1.0)
# Sweeps solve all steps here.
MIDPOINT = ds.ImplicitMidpoint(root_finder=ds.PicardNewton(newton_steps=0))
WELL = lambda t, p, q, args: (p**2 + q**2) / 2
KICK = lambda t, p, q, args: -0.5 * q
SPRING = lambda t, p, q, args: 0.5 * q**2 / 2


def follow(terms, solver, h, steps, **options):
    options = dict(key=jr.key(1), num_paths=20_000) | options
    return ds.ensemble(terms, solver, 0, h * steps, h, ONE, **options)


def made_terms(terms):
    """The terms with the paths that the midpoint rule gets."""
    given = lambda t, y, args: y[1], terms, MIDPOINT, 0.0, 0.01, 0.01, ONE, None, None
    return Problem.of(*given, levels=1, want="strong").terms


def kinds(terms):
    """Which noises of these terms get truncated paths from the midpoint rule."""
    made = [made_terms(terms)]
    # In a bath the midpoint rule is not suggested first, and for noise in the forces later.
    suggested = ds.suggest_solver(terms, 0.0, ONE, want="strong")
    own = [s for s in suggested if type(s.solver) is ds.ImplicitMidpoint]
    made += [s.terms(jr.key(0)) for s in own]
    found = {
        tuple(isinstance(path, ds.TruncatedBrownianPath) for path in brownian_paths(x))
        for x in made
    }
    (same,) = found
    return same


def test_only_noise_that_depends_on_the_state_is_truncated():
    shape = ()
    additive = ds.hamiltonian_terms(WELL, KICK, shape)
    multiplicative = ds.hamiltonian_terms(WELL, SPRING, shape)
    assert kinds(additive) == (False,)
    assert kinds(multiplicative) == (True,)
    bath = ds.langevin_terms(WELL, lambda t, q, args: 0.5 + q**2, 1.0, shape)
    assert kinds(bath) == (False,)
    for noise, cut in ((KICK, False), (SPRING, True)):
        both = diffrax.MultiTerm(*bath.terms, *ds.noise_terms(noise, shape).terms)
        assert kinds(both) == (False, cut)
    # A path of the user is kept, but not in a bath.
    given = MIDPOINT.path(shape, jr.key(0))
    assert isinstance(given, ds.TruncatedBrownianPath)
    (path,) = brownian_paths(made_terms(ds.hamiltonian_terms(WELL, KICK, given)))
    assert isinstance(path, ds.TruncatedBrownianPath)
    for make in (ds.langevin_terms, ds.bath_terms):
        (path,) = brownian_paths(make(WELL, 0.5, 1.0, given))
        assert isinstance(path, ds.FixedStepBrownianPath)


def test_lost_variance_is_that_of_the_law():
    x = np.linspace(-12, 12, 400_001)
    density = np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi)
    gaussian = ds.FixedStepBrownianPath((), jr.key(0))
    for k, h in itertools.product((1, 2, 4), (0.9, 0.25, 0.01)):
        path = ds.TruncatedBrownianPath(gaussian, k=k)
        cut = np.minimum(np.abs(x), np.sqrt(2 * k * abs(np.log(h))))
        lost = 1 - np.trapezoid(cut**2 * density, x)
        assert abs(lost_variance(path, h) - lost) < 1e-9
        wrapped = ds.TruncatedBrownianPath(gaussian, k=9)
        assert lost_variance(ds.TruncatedBrownianPath(wrapped, k=k), h) >= lost - 1e-9
        assert lost_variance(gaussian, h) == 0
    # The numbers of the docstring.
    path = ds.TruncatedBrownianPath(gaussian)
    lost = [round(lost_variance(path, h), 3) for h in (1 / 20, 1 / 4, 1 / 2, 0.9, 1)]
    assert lost == [0.001, 0.033, 0.162, 0.718, 1.0]


def moments(terms, h, steps):
    """The second moments of `(p, q)`, by a linear map."""
    of_step = lambda h: ds.second_moment_map(terms, MIDPOINT, 0.0, h, ONE)
    start = np.array([1.0, *map(float, ONE)])
    whole = np.linalg.matrix_power(np.asarray(jax.jit(of_step)(h)), steps)
    return (whole @ np.kron(start, start)).reshape(3, 3)[1:, 1:]


def assert_moments(y, exact):
    """Second moments of paths, within five standard errors."""
    for i in range(2):
        for j in range(2):
            x = y[i] * y[j]
            bound = 5 * x.std() / len(x) ** 0.5
            # Some moments have no spread.
            assert abs(x.mean() - exact[i, j]) < bound + 1e-12


def test_the_law_with_additive_noise_is_exact_at_every_step():
    # A linear system, kicked and in a bath: the law is Gaussian, with these moments.
    h = 2.0
    steps = 10
    bath = ds.langevin_terms(WELL, 0.5, 1.0, ())
    shaped = diffrax.MultiTerm(*bath.terms, *ds.noise_terms(KICK, ()).terms)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = follow(shaped, MIDPOINT, h, steps)
    assert paths.num_failed == 0
    assert_moments(paths.ys, moments(paths.terms(0), h, steps))
    # All of a Gaussian law, by its tails.
    x = paths.ys[1]
    x = (x - x.mean()) / x.std()
    assert abs((x**4).mean() - 3) < 5 * (96 / len(x)) ** 0.5


def test_with_multiplicative_noise_made_paths_lose_little():
    # One step over the whole interval is the longest of all.
    h = 0.5
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        paths = follow(ds.hamiltonian_terms(WELL, SPRING, ()), MIDPOINT, h, 1)
    (path,) = brownian_paths(paths.terms(0))
    assert isinstance(path, ds.TruncatedBrownianPath)
    assert path.unit == 32 * h and lost_variance(path, h) < 4e-4
    # Those of Gaussian increments: what is lost is far below what is sampled.
    gaussian = ds.FixedStepBrownianPath((), jr.key(0))
    exact = moments(ds.hamiltonian_terms(WELL, SPRING, gaussian), h, 1)
    assert_moments(paths.ys, exact)


def test_what_paths_of_the_user_lose_with_multiplicative_noise_is_said():
    path = MIDPOINT.path((), jr.key(0), want="strong")
    run = lambda path, h: follow(
        ds.hamiltonian_terms(WELL, SPRING, path), ds.StormerVerlet(), h, 1, num_paths=10
    )
    with pytest.raises(ValueError, match="as long as its `unit`.*unit=32"):
        run(path, 1.0)
    with pytest.warns(UserWarning, match="of their variance in steps") as told:
        run(path, 0.5)
    percent = re.findall(r"lose ([\d.]+)%", str(told[0].message))
    assert len(told) == 1 and percent == [f"{100 * lost_variance(path, 0.5):.1f}"]
    # Little loss is not said. The second path is the advice of the message.
    wide = ds.TruncatedBrownianPath(path.path, unit=32 * 3.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for given, h in ((path, 0.04), (wide, 3.0)):
            run(given, h)


def test_all_levels_truncate_in_the_same_unit():
    problem = Problem.of(
        lambda t, y, args: y[1], ds.hamiltonian_terms(WELL, SPRING, ()), MIDPOINT,
        1.0, 3.0, 0.5, ONE, None, None, levels=3, want="strong",
    )  # fmt: skip
    (path,) = brownian_paths(problem.terms)
    assert isinstance(path, ds.TruncatedBrownianPath)
    assert path.unit == 64.0
