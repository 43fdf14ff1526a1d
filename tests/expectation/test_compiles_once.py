"""A second call with other numbers compiles nothing, by JAX's own count."""

import jax
import jax.numpy as jnp
import jax.random as jr
import pytest
from jax import monitoring

import diffrax_symplectic as ds
from diffrax_symplectic._expectation import finer_level
from diffrax_symplectic._expectation.fitted.noise import Noise
from diffrax_symplectic._simulation.problem import Problem

from ..drjit_here import needs_drjit
from ..picard import by_picard


COMPILED = "/jax/core/compile/backend_compile_duration"
compiled = []


@pytest.fixture(scope="module", autouse=True)
def listener():
    def listen(event, duration, **kwargs):
        if event == COMPILED:
            compiled.append(kwargs.get("fun_name", ""))

    monitoring.register_event_duration_secs_listener(listen)
    yield
    monitoring.unregister_event_duration_listener(listen)


def H0(t, p, q, args):
    return p**2 / 2 + args * q**2


def phi(t, y, args):
    return args * y[1] ** 2


# What differs from the first call.
CHANGES = {
    "numbers of Python in y0": dict(y0=(0.2, 0.7)),
    "everything": dict(
        key=jr.key(8), args=jnp.array(0.3), y0=(jnp.array(0.1), jnp.array(0.2)),
        t0=0.5, t1=1.5, dt0=0.25, friction=jnp.array(0.1), temperature=jnp.array(3.0),
    ),
}  # fmt: skip


def call(run, sampling, *, friction=None, temperature=None, **others):
    friction = jnp.array(0.3) if friction is None else friction
    temperature = jnp.array(1.0) if temperature is None else temperature
    terms = ds.langevin_terms(H0, friction, temperature, ())
    given = dict(
        t0=0.0, t1=0.5, dt0=0.125, key=jr.key(1), args=jnp.array(0.5),
        y0=(jnp.array(0.0), jnp.array(1.0)),
    ) | others  # fmt: skip
    run(terms=terms, solver=ds.BAOAB(), **sampling, **given)


def mean(**kwargs):
    return ds.expectation(phi, **kwargs)


fused = lambda *values: pytest.param(*values, "drjit", marks=needs_drjit)
RUNS = {
    "IndependentPaths": (mean, dict(sampling=ds.IndependentPaths(64)), None),
    "IndependentPaths, fused": fused(mean, dict(sampling=ds.IndependentPaths(64))),
    "ArrayRQMC": (mean, dict(sampling=ds.ArrayRQMC(64, 2)), None),
    "ValueFunctions": pytest.param(
        mean,
        dict(sampling=ds.ValueFunctions(degree=2, num_paths=64)),
        None,
        marks=pytest.mark.slow,
    ),
    "ensemble": (ds.ensemble, dict(num_paths=64), None),
    "ensemble, fused": fused(ds.ensemble, dict(num_paths=64)),
}


@pytest.mark.parametrize("run, sampling, engine", RUNS.values(), ids=RUNS)
def test_a_call_with_other_numbers_compiles_nothing(run, sampling, engine):
    sampling = sampling | {"engine": engine}
    call(run, sampling)
    anew = {}
    for name, change in CHANGES.items():
        compiled.clear()
        call(run, sampling, **change)
        if compiled:
            anew[name] = [*compiled]
    assert anew == {}


def test_another_unit_of_truncation_compiles_nothing():
    energy = lambda t, p, q, args: (p**2 + q**2) / 2
    terms = ds.hamiltonian_terms(energy, lambda t, p, q, args: q**2 / 4, ())
    y0 = jnp.array(0.0), jnp.array(1.0)
    for h in (0.125, 0.25):
        compiled.clear()
        given = terms, by_picard(ds.ImplicitMidpoint()), 0, 4 * h, h, y0
        ds.ensemble(*given, key=jr.key(0), num_paths=8)
    assert compiled == []


def test_xla_does_not_know_the_result_before_a_step_of_a_fit():
    """It would evaluate what follows from it for all states while compiling, for more than
    a second with an alarm from `slow_operation_alarm`, where there are many states."""
    H = lambda t, p, q, args: (p**2 + q**2) / 2
    terms = ds.hamiltonian_terms(H, H, ())
    y0 = jnp.array(0.0), jnp.array(1.0)
    problem = Problem.of(
        lambda t, y, args: y[1],
        terms,
        ds.ImplicitMidpoint(),
        0,
        1,
        0.5,
        y0,
        None,
        None,
        1,
    )
    noise = Noise.of(problem, problem.level(0))
    program = jax.jit(lambda y: noise.new_solver_state(0, y)).lower(y0).as_text()
    assert "optimization_barrier" in program


@pytest.mark.parametrize("sampling", [ds.ValueFunctions(2, 64), ds.ArrayRQMC(64, 8)])
def test_a_trial_with_halved_steps_compiles_nothing(monkeypatch, sampling):
    changes_of = finer_level._changes_by_same_sampling
    names = []

    def changes(*args):
        before = len(compiled)
        result = changes_of(*args)
        names.append(compiled[before:])
        return result

    monkeypatch.setattr(finer_level, "_changes_by_same_sampling", changes)
    call(mean, dict(sampling=sampling))
    (names_of_trial,) = names
    # Those of samples and of fits. Small ones, of keys, do not count.
    assert not [name for name in names_of_trial if "of_arrays" in name]
