"""Paths that each start at a state of their own, and have `args` of their own."""

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..drjit_here import needs_drjit
from ..families import slow_except
from ..picard import by_picard
from .steps import problem_of


def oscillator(t, p, q, args):
    return (p**2 + q**2) / 2


def push(t, p, q, args):
    # A force of this variance per unit of time.
    return -jnp.sqrt(args["strength"]) * q


TERMS = ds.hamiltonian_terms(oscillator, push, ())
END, WIDTH = 1.0, 0.5
ENGINES = ["jax", pytest.param("drjit", marks=needs_drjit)]


def cloud(key):
    """Positions around one, at rest."""
    return jnp.zeros(()), 1 + WIDTH * jr.normal(key)


def strengths(key):
    return {"strength": jr.uniform(key, minval=1.0, maxval=3.0)}


def square(t, y, args):
    return y[1] ** 2, args["strength"]


def exact(strength):
    """The mean square of the position at the end."""
    noise = strength * (END / 2 - np.sin(2 * END) / 4)
    return (1 + WIDTH**2) * np.cos(END) ** 2 + noise


ACCURATE = by_picard(ds.AdditiveGauss())


def mean(sampling, y0=cloud, args=strengths, solver=ACCURATE, **options):
    given = square, TERMS, solver, 0.0, END, 0.25, y0, args
    return ds.expectation(*given, key=jr.key(1), sampling=sampling, **options)


SAMPLINGS = [
    ds.IndependentPaths(4000),
    ds.ArrayRQMC(2**9, 16),
    ds.ValueFunctions(degree=2, num_paths=4000),
]


@pytest.mark.parametrize("sampling", slow_except(SAMPLINGS[1:2], SAMPLINGS))
def test_means_over_drawn_starts_and_args_are_right(sampling):
    estimate = mean(sampling, levels=1)
    off = np.abs(np.subtract(estimate.mean, (exact(2.0), 2.0)))
    np.testing.assert_array_less(off, 4 * np.array(estimate.std_error))
    assert estimate.num_failed == 0


@pytest.mark.slow
def test_value_functions_leave_the_variance_of_the_start():
    fixed = {"strength": jnp.array(0.01)}
    estimate = mean(ds.ValueFunctions(degree=2, num_paths=4000), args=fixed)
    spread = np.sqrt(4 * WIDTH**2 + 2 * WIDTH**4) * np.cos(END) ** 2
    # The paths are weighted, and no weight is above 2: its mean square is 2 at most.
    assert 0.9 < estimate.std_error[0] * np.sqrt(4000) / spread < np.sqrt(2)
    assert abs(estimate.mean[0] - exact(0.01)) < 4 * estimate.std_error[0]


ONE = jnp.zeros(()), jnp.ones(())


@pytest.mark.slow
def test_the_default_does_not_rely_on_few_paths():
    # An explicit solver: 5.6 in place of 10 s of processor time, nearly all to compile.
    given = dict(args={"strength": 1.0}, solver=ds.StormerVerlet())
    assert isinstance(mean(None, y0=ONE, **given).sampling, ds.ValueFunctions)
    assert isinstance(mean(None, **given).sampling, ds.ArrayRQMC)


def several_paths(engine):
    # The start of a path may depend on its own `args`, and not be finite.
    start = lambda key, args: (jr.normal(key), jnp.sqrt(args["strength"] - 1.5))
    given = TERMS, ds.StormerVerlet(), 0.0, END, 0.25, start, strengths
    how = dict(key=jr.key(1), num_paths=20, batch_size=8, engine=engine)
    with pytest.warns(UserWarning, match="of 20 paths failed"):
        return ds.ensemble(*given, **how, ts=[0.0, END])


@pytest.fixture(scope="module")
def solved_again():
    """The starts, ends and strengths of these paths."""
    paths = several_paths("jax")

    def again(number):
        y0, args = paths.start(number)
        given = paths.terms(number), ds.StormerVerlet(), 0.0, END, 0.25, y0, args
        solution = diffrax.diffeqsolve(*given, throw=False)
        return *y0, solution.ys[1][0], args["strength"]

    return [*map(np.asarray, jax.jit(jax.vmap(again))(jnp.arange(20)))]


@pytest.mark.parametrize("engine", ENGINES)
def test_paths_of_an_ensemble_start_where_they_say_and_may_be_solved_again(
    engine, solved_again
):
    paths, (p, q, ends, strength) = several_paths(engine), solved_again
    good = strength >= 1.5
    np.testing.assert_array_equal(paths.failed, ~good)
    assert 0 < np.sum(paths.failed) < 20 and np.all(np.isfinite(paths.ys[1][good]))
    np.testing.assert_allclose(q[good], np.sqrt(strength[good] - 1.5), rtol=1e-14)
    np.testing.assert_allclose(paths.ys[0][good, 0], p[good], rtol=1e-14)
    expected = np.stack([q, ends], axis=1)[good]
    np.testing.assert_allclose(paths.ys[1][good], expected, rtol=1e-13)
    assert len(np.unique(p)) == len(np.unique(strength)) == 20


def test_starts_and_terms_are_told_by_the_number_of_a_path():
    given = TERMS, ds.StormerVerlet(), 0.0, END, 0.25, cloud, {"strength": 1.0}
    paths = ds.ensemble(*given, key=jr.key(1), num_paths=2)
    # Beyond 32 bits, and in the types of 32 bits and fewer.
    far = 2**40 + 5
    starts = jax.jit(jax.vmap(lambda i: paths.start(i)[0][1]))
    for numbers in (jnp.array([5, far]), np.arange(5, 6, dtype=np.uint8)):
        one_by_one = [paths.start(int(i))[0][1] for i in numbers]
        np.testing.assert_array_equal(starts(numbers), one_by_one)
    for bad in (1.5, -1, numbers, "one", True):
        with pytest.raises(ValueError, match="`number` must be .*integer, 0 or larger"):
            paths.start(bad)
    with pytest.raises(ValueError, match="`number` must be one integer"):
        jax.vmap(paths.terms)(jnp.array([0.5]))


def test_a_function_in_args_is_told_from_a_function_of_the_key():
    drive = lambda t: jnp.sin(t)
    terms = ds.hamiltonian_terms(oscillator, lambda t, p, q, args: -args(t) * q, ())
    with pytest.raises(TypeError) as info:
        given = terms, ds.StormerVerlet(), 0.0, 1.0, 0.5, ONE, drive
        ds.ensemble(*given, key=jr.key(1), num_paths=2)
    assert "pass it in a tuple" in str(info.value.__notes__)
    with pytest.raises(ValueError, match=r"`y0` is called as `y0\(key, args\)`"):
        mean(SAMPLINGS[0], y0=lambda key, args, width: ONE)
    with pytest.raises(ValueError, match=r"`y0` is called as `y0\(key\)`"):
        mean(SAMPLINGS[0], y0=lambda: ONE)


def test_starts_take_args_by_any_name_and_options_by_their_defaults():
    def of_key(key, width=WIDTH):
        return jnp.zeros(()), width * jr.normal(key)

    def of_both(key, k):
        return jnp.zeros(()), WIDTH * jnp.sqrt(k["strength"]) * jr.normal(key)

    args = {"strength": jnp.array(4.0)}
    q_of_key, q_of_both = (
        problem_of(TERMS, ds.StormerVerlet(), 0.5, y0, args).draw_start(jr.key(1))[0][1]
        for y0 in (of_key, of_both)
    )
    np.testing.assert_allclose(q_of_both, 2 * q_of_key, rtol=1e-12)
