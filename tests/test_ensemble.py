"""What `ensemble` returns and refuses."""

import importlib

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._fused import kernels
from diffrax_symplectic._simulation import engines
from diffrax_symplectic._stablehlo import backend

from .drjit_here import needs_drjit
from .stablehlo.replayed import recorded_lines


KEY = jr.key(0)
ONE = jnp.array(0.0), jnp.array(1.0)
both_engines = pytest.mark.parametrize(
    "engine", ["jax", pytest.param("drjit", marks=needs_drjit)]
)


def pendulum(t, p, q, args):
    return p**2 / 2 - jnp.cos(q)


def push(t, p, q, args):
    return 0.2 * jnp.sin(q)


def terms_of(H0, noise=push, key=KEY):
    return ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), key))


TERMS = terms_of(pendulum)


def follow(terms=TERMS, solver=None, t1=1.0, dt0=0.25, y0=ONE, args=None, **kwargs):
    kwargs = dict(key=jr.key(1), num_paths=40) | kwargs
    solver = ds.StormerVerlet() if solver is None else solver
    return ds.ensemble(terms, solver, 0.0, t1, dt0, y0, args, **kwargs)


@pytest.mark.core
@both_engines
def test_states_are_those_of_diffeqsolve_at_the_saved_times(engine):
    times = [0.0, 0.5, 1.0]
    paths = follow(ts=times, engine=engine)
    np.testing.assert_allclose(paths.ts, times, rtol=1e-15)
    p, q = paths.ys
    assert type(q) is np.ndarray and q.shape == (40, 3)
    assert paths.num_failed == paths.num_stragglers == 0
    for i in (0, 7, 39):
        saveat = diffrax.SaveAt(ts=jnp.array(times))
        sol = diffrax.diffeqsolve(
            paths.terms(i), ds.StormerVerlet(), 0.0, 1.0, 0.25, ONE, saveat=saveat
        )
        np.testing.assert_allclose((p[i], q[i]), sol.ys, rtol=1e-14, atol=1e-15)
    # Times in another order, and without times the ends.
    unsorted = follow(engine=engine, ts=[1.0, 0.5, 1.0])
    np.testing.assert_array_equal(unsorted.ys[1], q[:, [2, 1, 2]])
    ends = follow(engine=engine)
    assert list(ends.ts) == [1.0]
    np.testing.assert_array_equal(ends.ys[1], q[:, 2])


def test_a_shape_becomes_a_path_with_gaussian_increments_unless_a_weak_one_is_wanted():
    def values(path, **want):
        kick = ds.hamiltonian_terms(pendulum, lambda t, p, q, args: -q, path)
        paths = follow(kick, t1=0.25, **want)
        return len(np.unique(np.round(paths.ys[0], 12)))

    assert values(()) == 40
    assert values((), want="weak") == 3
    # A path of the user's is taken as it is.
    assert values(ds.WeakBrownianPath((), jr.key(0))) == 3
    with pytest.raises(ValueError, match="`want` must be one of"):
        values((), want="sharp")
    # These have no paths with the law of the solution.
    for solver in (ds.SRKw5(), ds.NinomiyaVictoir()):
        name = type(solver).__name__
        with pytest.raises(ValueError, match=f'`{name}` is a weak.*`want="weak"`'):
            values((), solver=solver)


@both_engines
def test_a_path_does_not_depend_on_its_batch(engine):
    # The paths of a kernel end their sweeps together.
    solver = ds.ImplicitMidpoint() if engine == "drjit" else None
    whole = follow(engine=engine, solver=solver)
    parts = follow(engine=engine, num_paths=30, batch_size=7, solver=solver)
    tolerance = 0.0 if engine == "drjit" else 1e-15
    np.testing.assert_allclose(parts.ys[1], whole.ys[1][:30], rtol=tolerance, atol=0)


@needs_drjit
def test_paths_that_sweeps_do_not_solve_are_taken_by_jax():
    stiff = lambda t, p, q, args: p**2 / 2 + 20 * q**4
    terms = terms_of(stiff)
    given = dict(terms=terms, y0=(jnp.array(0.0), jnp.array(0.4)), t1=4.0, dt0=0.8)
    given["solver"] = ds.ImplicitMidpoint()
    with pytest.warns(UserWarning, match="did not solve"):
        fused = follow(**given, engine="drjit")
    assert 0 < fused.num_stragglers <= 40
    assert fused.num_failed == 0
    exact = follow(**given)
    np.testing.assert_allclose(fused.ys[1], exact.ys[1], rtol=0, atol=1e-10)


@needs_drjit
def test_the_same_paths_fail_and_leave_others_as_they_are():
    singular = lambda t, p, q, args: p**2 / 2 + jnp.sqrt(q)
    path = ds.FixedStepBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(singular, lambda t, p, q, args: 2 * q**2, path)
    several = dict(terms=terms, t1=4.0, num_paths=200, ts=[0.25, 4.0])
    paths = {}
    for engine in ("jax", "drjit"):
        with pytest.warns(
            UserWarning, match="of 200 paths failed. Their states are NaN"
        ):
            paths[engine] = follow(**several, engine=engine)
    failed = paths["jax"].failed
    assert 0 < np.sum(failed) < 200
    np.testing.assert_array_equal(paths["drjit"].failed, failed)
    assert paths["drjit"].num_stragglers == np.sum(failed)
    for engine in paths:
        q = paths[engine].ys[1]
        assert np.all(np.isnan(q[failed])) and np.all(np.isfinite(q[~failed]))


@needs_drjit
def test_another_step_number_of_steps_parameter_and_start_compile_nothing(monkeypatch):
    def spring(t, p, q, args):
        return p**2 / 2 + args * q**2

    terms = terms_of(spring)
    made = []
    make = engines._kernels
    monkeypatch.setattr(engines, "_kernels", lambda x: made.append(make(x)) or made[-1])
    kwargs = dict(terms=terms, engine="drjit", ts=[0.5, 1.0])
    first = follow(**kwargs, args=jnp.array(0.5))
    other = follow(**kwargs, args=jnp.array(0.7), y0=(ONE[1], ONE[0]), dt0=0.125)
    follow(**kwargs, args=jnp.array(0.7), t1=3.0, num_paths=41, key=jr.key(4))
    assert made[0] is made[1] is made[2]
    assert made[0]._take_steps.n_recordings == made[0]._make_keys.n_recordings == 1
    assert not np.allclose(first.ys[1], other.ys[1])
    kwargs["engine"] = "jax"
    exact = follow(**kwargs, args=jnp.array(0.7), y0=(ONE[1], ONE[0]), dt0=0.125)
    np.testing.assert_allclose(other.ys[1], exact.ys[1], rtol=1e-13)


@needs_drjit
def test_an_error_within_a_step_is_raised():
    def checked(t, p, q, args):
        return pendulum(t, p, eqx.error_if(q, t > args, "too late"), args)

    path = ds.FixedStepBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(checked, push, path)
    paths = follow(terms, args=jnp.array(9.0), engine="drjit")
    assert paths.num_stragglers == 0
    with pytest.raises(Exception, match="too late"):
        follow(terms, args=jnp.array(0.5), engine="drjit")


@needs_drjit
def test_a_window_of_a_table_is_moved_into_it_as_by_jax():
    def tabulated(t, p, q, table):
        place = jnp.floor(50 + 50 * q).astype(int)
        window = jax.lax.dynamic_slice(table, (place,), (3,))
        return p**2 / 2 + window @ jnp.stack([q, q**2, q**3]) / 50

    table = jnp.linspace(1.0, 2.0, 100) ** 2
    start = lambda key: (0 * ONE[0], jr.normal(key))
    given = dict(terms=terms_of(tabulated), y0=start, args=table)
    by_jax, fused = (follow(**given, engine=name).ys[1] for name in ("jax", "drjit"))
    assert np.min(by_jax) < -1 and np.max(by_jax) > 1
    np.testing.assert_allclose(fused, by_jax, rtol=1e-12)


def ordered(t, p, q, args):
    return jnp.sum(p**2) / 2 + jnp.sort(jnp.tile(q, 6))[0] ** 2


def table(t, p, q, args):
    place = jnp.clip(jnp.floor(q[0]), 0, 99).astype(int)
    return jnp.sum(p**2) / 2 + jnp.cos(q[0] * args)[place]


def several(t, p, q, args):
    return jnp.sum(p**2) / 2 + sum(jnp.abs(jnp.fft.fft(i * q))[0] for i in range(2))


def in_bits(t, p, q, args):
    high, _ = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(q[0]), jnp.int32)
    return jnp.sum(p**2) / 2 + q[0] * high


def short(t, p, q, args):
    return jnp.sum(p**2) / 2 + jnp.sum(q.astype(jnp.float16))


def first(t, p, q, args):
    return q[0]


REFUSED = [
    (several, "`stablehlo.fft`"),
    (in_bits, "`stablehlo.bitcast_convert` between numbers of different sizes"),
    (short, "numbers of type `f16`"),
    (ordered, "`stablehlo.sort` of more than 16 numbers"),
    (table, "`stablehlo.dynamic_slice` with an index per path, among 100 places"),
]


@needs_drjit
@pytest.mark.parametrize("H0, what", REFUSED, ids=[fn.__name__ for fn, _ in REFUSED])
def test_what_cannot_be_replayed_is_named_with_the_function_that_needs_it(H0, what):
    terms = terms_of(H0, first)
    y0, args = (jnp.zeros(3), jnp.arange(3.0)), jnp.ones(100)
    with recorded_lines(), pytest.raises(ValueError, match="cannot replay") as info:
        follow(terms, y0=y0, args=args, engine="drjit")
    assert what in str(info.value)
    assert f"which `{H0.__name__}` needs" in str(info.value)
    assert __file__ in str(info.value)
    assert 'Pass `engine="jax"`' in str(info.value)
    # And what comes after that is as before.
    assert follow(engine="drjit").num_failed == 0


OTHER_KEY = jr.key(1, impl="rbg")
LARGE = jnp.zeros(200), jnp.ones(200)
REFUSED_ARRAYS = [
    (r"type int16, .*\.astype\(float", dict(args=jnp.ones(2, jnp.int16))),
    (r"type bfloat16, .*\.astype\(float", dict(args=jnp.ones(2, jnp.bfloat16))),
    ("threefry2x32; got a key of `rbg`", dict(key=OTHER_KEY)),
    ("threefry2x32; got a key of `rbg`", dict(terms=terms_of(pendulum, key=OTHER_KEY))),
    ("up to 256 numbers; got 400", dict(terms=terms_of(ordered, first), y0=LARGE)),
]


@needs_drjit
@pytest.mark.parametrize("message, given", REFUSED_ARRAYS)
def test_arrays_that_a_kernel_cannot_hold_are_refused(message, given):
    with pytest.raises(ValueError, match=message):
        follow(**given, engine="drjit")


@needs_drjit
def test_arrays_of_the_state_may_be_empty():
    def energy(t, p, q, args):
        return pendulum(t, p["a"], q["a"], args) + jnp.sum(q["b"] * args)

    noise = lambda t, p, q, args: push(t, p["a"], q["a"], args)
    terms = terms_of(energy, noise)
    y0 = tuple({"a": x, "b": jnp.zeros((0, 2))} for x in ONE)
    fused = follow(terms, y0=y0, args=jnp.zeros((0, 2)), engine="drjit")
    assert fused.ys[1]["b"].shape == (40, 0, 2)
    np.testing.assert_allclose(fused.ys[1]["a"], follow().ys[1], rtol=1e-13)


@needs_drjit
def test_of_kernels_that_compile_for_longer_than_jax_a_warning_comes_first(monkeypatch):
    follow(engine="drjit")
    # One of 200,000 operations would compile for minutes. This one has 1,500 to 2,000, or
    # by Dr.Jit's numbers more, if variables of other tests are still there.
    monkeypatch.setattr(kernels, "_MOST_OPERATIONS", 1_000)

    def median(t, p, q, args):
        return p**2 / 2 + jnp.median(jnp.sin(q * jnp.arange(9.0)))

    warning = r"about \d+,\d+ operations.*`engine=\"jax\"`"
    with pytest.warns(UserWarning, match=warning):
        follow(terms_of(median), engine="drjit")


@pytest.fixture
def fresh():
    """What is known of Dr.Jit is asked for again, within the test and after it."""
    caches = backend._drjit, backend.array_types
    for fn in caches:
        fn.cache_clear()
    yield
    for fn in caches:
        fn.cache_clear()


def test_without_drjit_an_error_says_how_to_install_it(monkeypatch, fresh):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(ImportError, match=r"needs Dr.Jit.*pip install '.\[fused\]'"):
        follow(engine="drjit")


@needs_drjit
@pytest.mark.skipif(jax.default_backend() != "cpu", reason="a GPU needs no LLVM")
def test_without_llvm_an_error_says_how_to_install_it(monkeypatch, fresh):
    monkeypatch.setattr(backend._drjit(), "has_backend", lambda backend: False)
    with pytest.raises(ImportError, match="libllvm19.*DRJIT_LIBLLVM_PATH"):
        follow(engine="drjit")


BAD = [
    (dict(engine="cuda"), '`engine` must be "jax", "drjit" or `None`; got \'cuda\''),
    (dict(num_paths=0), "`num_paths` must be a positive integer"),
    (dict(batch_size=0), "`batch_size` must be a positive integer"),
    (dict(dt0=0.3), "whole number of steps.* For example, `dt0=1 / 4`"),
    (dict(ts=[0.3]), "whole number of steps"),
    (dict(y0=(ONE[0], jnp.array(np.nan))), "`y0` must hold finite numbers"),
    (dict(solver=diffrax.EulerHeun), "`solver` must be a solver"),
    (dict(y0=ONE[0] + 1j), "`ensemble` needs a state.*`wave_terms.*to_pair"),
]


@pytest.mark.parametrize("kwargs, message", BAD, ids=[m[:30] for _, m in BAD])
def test_bad_arguments_are_refused(kwargs, message):
    with pytest.raises(ValueError, match=message):
        follow(**kwargs)


def test_it_is_no_part_of_a_jax_program():
    with pytest.raises(ValueError, match="^`ensemble` cannot run inside JAX"):
        eqx.filter_jit(lambda q: follow(y0=(ONE[0], q)).ys)(ONE[1])
