"""A second call with other numbers compiles nothing, by JAX's own count."""

import jax
import jax.numpy as jnp
import jax.random as jr
import pytest
from jax import monitoring

import diffrax_symplectic as ds
from diffrax_symplectic._expectation import finer_level
from diffrax_symplectic._expectation.fitted.noise import Noise

from ..drjit_here import needs_drjit
from ..picard import by_picard
from .steps import problem_of


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


FEW = ds.IndependentPaths(64)
RUNS = {
    "IndependentPaths": (mean, dict(sampling=FEW)),
    "IndependentPaths, fused": pytest.param(
        mean, dict(sampling=FEW, engine="drjit"), marks=needs_drjit
    ),
    "ArrayRQMC": (mean, dict(sampling=ds.ArrayRQMC(64, 8))),
    "ValueFunctions": (mean, dict(sampling=ds.ValueFunctions(2, 64))),
    "ensemble": (ds.ensemble, dict(num_paths=64)),
}


@pytest.mark.parametrize("run, sampling", RUNS.values(), ids=RUNS)
def test_a_call_with_other_numbers_compiles_nothing(monkeypatch, run, sampling):
    changes_of = finer_level._changes_by_same_sampling

    def changes_of_trial(*args):
        """A trial with halved steps compiles neither samples nor fits. Small programs, of
        keys, do not count."""
        before = len(compiled)
        changes = changes_of(*args)
        assert not [name for name in compiled[before:] if "of_arrays" in name]
        trials.append(changes)
        return changes

    trials = []
    monkeypatch.setattr(finer_level, "_changes_by_same_sampling", changes_of_trial)
    call(run, sampling)
    has_trial = not isinstance(sampling.get("sampling", FEW), ds.IndependentPaths)
    assert len(trials) == has_trial
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
    problem = problem_of(terms, ds.ImplicitMidpoint(), 0.5, y0, num_steps=2, levels=1)
    noise = Noise.of(problem, problem.level(0))
    program = jax.jit(lambda y: noise.new_solver_state(0, y)).lower(y0).as_text()
    assert "optimization_barrier" in program
