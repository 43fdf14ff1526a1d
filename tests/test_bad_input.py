"""Terms and states that do not fit get an error that says what to pass instead."""

import dataclasses
import functools as ft
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._terms import check_stratonovich

from .problems import weak_path


def _solve(terms, y0, solver=None):
    solver = ds.ImplicitMidpoint() if solver is None else solver
    return diffrax.diffeqsolve(terms, solver, 0.0, 0.2, 0.1, y0)


def _total(t, p, q, args):
    return jnp.sum(p**2 + q**2) / 2


def _of_q(t, p, q, args):
    return q[:1]


DECAY = diffrax.ODETerm(lambda t, y, args: y)


def _pairs(*noises, H0=_total, solver=None, y0=None, m=1):
    """Solves of a pair of arrays of three numbers with these noises."""
    y0 = (jnp.ones(3), jnp.ones(3)) if y0 is None else y0
    return [
        lambda noise=noise: _solve(
            ds.hamiltonian_terms(H0, noise, weak_path(m)), y0, solver
        )
        for noise in noises
    ]


def _from(y0, solver=None):
    return _pairs(_of_q, y0=y0, solver=solver)[0]


def _made(*given):
    return [lambda: ds.hamiltonian_terms(*given)]


class Pair(NamedTuple):
    p: jax.Array
    q: jax.Array


class Mine(ds.AbstractSymplecticRungeKutta):
    tableau = ds.ImplicitMidpoint().tableau

    def order(self, terms):
        return 2


def _with_matrices():
    matrices = lambda t, y, args: (jnp.ones((3, 2)), jnp.zeros((3, 2)))
    noise = diffrax.ControlTerm(matrices, weak_path(2))
    _solve(diffrax.MultiTerm(DECAY, noise), (jnp.zeros(3), jnp.ones(3)))


def _solve_in(dtype):
    """With a path in double precision."""
    noise = diffrax.ControlTerm(lambda t, y, args: jnp.ones((2, 1)), weak_path(1))
    t0, t1, h = np.array([0, 0.2, 0.1], dtype)
    terms = diffrax.MultiTerm(DECAY, noise)
    y0 = jnp.ones(2, dtype)
    return [lambda: diffrax.diffeqsolve(terms, ds.ImplicitMidpoint(), t0, t1, h, y0)]


PATH = ds.WeakBrownianPath((), jr.key(0))
ONES = jnp.ones(2)
IMAGINARY = 1j * ONES
SINGLE = jax.ShapeDtypeStruct((2,), jnp.float32)
# From a message to what is answered by it.
OF_TERMS = {
    r"pass `y0=\(p0, q0\)`": [
        _from(y0, solver)
        for solver in (None, diffrax.Heun())
        for y0 in (
            ONES,
            [ONES, ONES],
            (ONES,) * 3,
            (ONES, jnp.ones(3)),
            (ONES, {"q": ONES}),
            {"p": ONES, "q": ONES},
        )
    ],
    "one Hamiltonian for each noise of the path": _pairs(
        lambda t, p, q, args: q,
        lambda t, p, q, args: jnp.sum(q),
        lambda t, p, q, args: (jnp.sum(q),) * 2,
        m=2,
    ),
    # Shapes are written as shapes.
    r"which has shape \(2,\); got shape \(3,\)": _pairs(lambda t, p, q, args: q, m=2),
    r"must return a scalar.*got shape \(3,\)": _pairs(
        _of_q, H0=lambda t, p, q, args: p
    ),
    r"got \[f32\[2\], 3\]\.": [lambda: ds.WeakBrownianPath([SINGLE, 3], jr.key(0))],
    r"a tuple of integers, `\(m,\)` for": [
        lambda: ds.WeakBrownianPath((-1,), jr.key(0))
    ],
    "`path` must be a Brownian path": _made(_total, _total, lambda t0, t1: 0.0),
    "`H0` must be a function": _made(1.0, _total, PATH),
    "got the class WeakBrownianPath": _made(_total, _total, ds.WeakBrownianPath),
    "got a NoneType.*pass neither": _made(_total, _total),
    "`noise` must be a function": _made(_total, None, PATH),
    r"called as `H0\(t, p, q, args\)`; got a fun": _made(lambda p, q: 0, _total, PATH),
    r"`noise` is called as .*another order, `\(t, [qx]": [
        *_made(_total, lambda t, q, p, args: q, PATH),
        *_made(_total, lambda t, x, v, args: x, PATH),
    ],
    "Both are real; got.*`wave_terms`": [
        _from(y0, solver)
        for solver in (None, diffrax.Heun())
        for y0 in ((IMAGINARY, IMAGINARY), (IMAGINARY, ONES), IMAGINARY)
    ],
    "real floating-point arrays; got.*complex": [lambda: _solve(DECAY, IMAGINARY)],
    "real floating-point arrays; got.*int": [
        lambda: ds.ImplicitMidpoint().init(DECAY, 0.0, 0.1, jnp.ones(2, int), None)
    ],
    "at least one array": [lambda: _solve(DECAY, ())],
    "the same dtype": _solve_in(np.float32),
    r"is a pair `\(p, q\)`": [_from(Pair(ONES, ONES))],
    "float32 or float64": _solve_in(np.float16),
    "also inherit from `.*AbstractImplicitStages`": [_from((ONES, ONES), Mine())],
    "must be a Lineax operator": [_with_matrices],
}
CALLS_OF_TERMS = [(message, x) for message, calls in OF_TERMS.items() for x in calls]


@pytest.mark.filterwarnings("ignore:Complex")
@pytest.mark.parametrize("message, call", CALLS_OF_TERMS)
def test_terms_and_states_that_do_not_fit_are_told_what_to_pass(message, call):
    with pytest.raises(ValueError, match=message):
        call()


def test_other_names_and_integers_will_do():
    for other in (lambda t, mom, pos, args: pos, lambda *args: args[2]):
        ds.hamiltonian_terms(_total, other, PATH)
    # Diffrax itself turns an integer state into a floating-point one.
    end = jax.eval_shape(lambda y: _solve(DECAY, y).ys, jnp.ones(2, int))
    assert jnp.issubdtype(end.dtype, jnp.floating)


@pytest.mark.parametrize("solver", [diffrax.Euler(), diffrax.ItoMilstein()])
def test_ito_solvers_are_refused_where_the_sense_makes_a_difference(solver):
    H = lambda t, p, q, args: (p**2 + q**2) / 2
    linear = lambda t, p, q, args: p + q
    kick = lambda t, p, q, args: q**2
    y0 = (jnp.array(0.0), jnp.array(1.0))

    def solve(*terms, noise):
        path = diffrax.VirtualBrownianTree(0.0, 1.0, 0.1, (), jr.key(0))
        drift, diffusion = ds.hamiltonian_terms(H, noise, path).terms
        all_terms = diffrax.MultiTerm(drift, *terms, diffusion)
        check_stratonovich(all_terms, solver, 0.0, y0, None)

    with pytest.raises(
        ValueError, match="in the sense of Ito.*add its drift correction"
    ):
        solve(noise=H)
    # They are right for additive noise, for noise that kicks where the position says how
    # hard, and with a drift that corrects the sense.
    correction = lambda t, y, args: jax.tree.map(lambda x: -x / 2, y)
    solve(diffrax.ODETerm(correction), noise=H)
    solve(noise=linear)
    solve(noise=kick)


def test_noise_that_does_not_depend_on_the_state_is_refused():
    m, y0 = 3, (jnp.ones(2), jnp.ones(2))
    zero_gradient = r"does not depend on the state.*-sigma \* q"

    def solve(noise, args, solver):
        terms = ds.hamiltonian_terms(_total, noise, weak_path(m, two_point=True))
        diffrax.diffeqsolve(terms, solver, 0.0, 0.2, 0.1, y0, args)

    # An amplitude in place of a Hamiltonian, of which the gradient is zero.
    for amplitude in (
        lambda t, p, q, args: args * jnp.cos(t) * jnp.ones(m),
        ds.IndexedNoise(lambda k, t, p, q, args: 0.05, m),
    ):
        for solver in (ds.StormerVerlet(), ds.NinomiyaVictoir(), diffrax.Heun()):
            with pytest.raises(ValueError, match=zero_gradient):
                solve(amplitude, jnp.array(0.05), solver)
        terms = ds.hamiltonian_terms(_total, amplitude, weak_path(m))
        with pytest.raises(ValueError, match=zero_gradient):
            ds.suggest_solver(terms, 0.0, y0, jnp.array(0.05), want="weak")
    # What is zero for these values alone is not refused.
    kick = lambda t, p, q, args: -args * q[:1] * jnp.ones(m)
    for zero in (0.0, jnp.array(0.0)):
        for solver in (ds.StormerVerlet(), diffrax.Heun()):
            jax.eval_shape(lambda: solve(kick, zero, solver))


ASKING = {
    "branches": lambda t, p, q, args: jnp.sum(p**2) if p[0] > 0 else jnp.sum(q**2),
    "selects": lambda t, p, q, args: jnp.sum(q[p > 0]),
    "takes numpy": lambda t, p, q, args: np.sum(np.sin(q)),
    "takes float": lambda t, p, q, args: float(q[0]),
    "counts": lambda t, p, q, args: jnp.sum(jnp.ones(int(q[0])) * q),
}


@pytest.mark.parametrize("asks", ASKING.values(), ids=ASKING)
def test_a_hamiltonian_that_asks_for_values_is_named(asks):
    for name, functions in (("H0", (asks, _total)), ("noise", (_total, asks))):
        terms = ds.hamiltonian_terms(*functions, weak_path(1))
        with pytest.raises(ValueError, match=f"`{name}` needs concrete.*jnp.where"):
            _solve(terms, (jnp.ones(2), jnp.ones(2)))


def test_a_forgotten_args_is_asked_about():
    H = lambda t, p, q, args: jnp.sum(p**2) + args["k"] * jnp.sum(q**2)
    one = ds.IndexedNoise(lambda k, t, p, q, args: args["k"] * q[k], 1)
    y0 = (jnp.ones(2), jnp.ones(2))

    def calls(phi, *functions):
        terms = ds.hamiltonian_terms(*functions, weak_path(1))
        yield lambda: ds.expectation(
            phi, terms, ds.ImplicitMidpoint(), 0, 1, 0.1, y0, key=jr.key(0)
        )
        if phi is first:
            yield lambda: _solve(terms, y0)
            yield lambda: ds.suggest_solver(terms, 0, y0, want="strong")

    first = lambda t, y, args: y[0]
    for name, kind, *functions in (
        ("H0", TypeError, first, H, _total),
        ("noise", TypeError, first, _total, H),
        ("H", TypeError, first, _total, one),
        ("phi", AttributeError, lambda t, y, args: args.k, _total, _total),
    ):
        for call in calls(*functions):
            with pytest.raises(kind) as info:
                call()
            notes = [note for note in info.value.__notes__ if "left out" in note]
            assert notes == [f"`{name}` was called with `args=None`. Was it left out?"]
            assert "'NoneType' obj" in str(info.value)


def _force(t, p, q, args):
    return jnp.sin(q)


TERMS = ds.hamiltonian_terms(lambda t, p, q, args: p**2 / 2 - jnp.cos(q), _force, ())


GIVEN = dict(t0=0, t1=1, y0=(0.0, 1.0), key=jr.key(0))
OF_ONE = GIVEN | dict(terms=TERMS, solver=ds.StormerVerlet(), dt0=0.5)


def _mean(phi=lambda t, y, args: y[1], **others):
    few = dict(sampling=ds.IndependentPaths(16))
    return ds.expectation(phi, **(OF_ONE | few | others))


def _paths(**others):
    return ds.ensemble(**(OF_ONE | dict(num_paths=4) | others))


def _drawn(fn=jr.normal, **others):
    return ds.monte_carlo(fn, **(dict(key=jr.key(0), num_paths=16) | others))


def _compared(**others):
    several = dict(terms=TERMS, solvers=[ds.StormerVerlet()], dt0=[0.5], num_paths=4)
    return ds.compare_solvers(**(GIVEN | several | others))


@dataclasses.dataclass
class _Parameters:
    stiffness: float = 1.0


DEVICE = jax.devices()[0]
TWO_KEYS = jr.split(jr.key(0), 2)
OLD_KEYS = jr.split(jr.PRNGKey(0), 2)
HUGE = 10**12
PATHS = ds.IndependentPaths(64, HUGE), ds.ValueFunctions(1, 64, HUGE)
LONG = dict(num_paths=10**9, ts=np.linspace(0.5, 5000, 10_000), t1=5000)


def _each(fn, **values):
    """Calls with each of these values of an argument."""
    pairs = [{name: x} for name, xs in values.items() for x in xs]
    return [ft.partial(fn, **pair) for pair in pairs]


# From a message to calls that are answered by it. None of them compiles a program.
REFUSED = {
    "`confidence` must be a number between 0 and 1, such as 0.95": _each(
        lambda confidence: _drawn().interval(confidence),
        confidence=[95, float("nan"), "0.95", np.array([0.5, 0.9])],
    ),
    "`tol` must be a positive number": _each(_mean, tol=[True, 1e-320, ONES]),
    "`devices` must be a list of one or more devices": [
        *_each(_mean, devices=["cpu", DEVICE]),
        *_each(_drawn, devices=[[]]),
    ],
    "`devices` must differ": _each(_drawn, devices=[[DEVICE, DEVICE]]),
    "`(expectation|ensemble|monte_carlo|compare_solvers)` needs one random key": [
        call
        for fn in (_mean, _paths, _drawn, _compared)
        for call in _each(fn, key=[TWO_KEYS, OLD_KEYS])
    ],
    "`expectation` needs a random key": _each(_mean, key=[3]),
    "`ensemble` needs a random key": _each(_paths, key=[3]),
    "`compare_solvers` needs a random key": _each(_compared, key=[None]),
    "`first` must be an integer from 0 to": [
        *_each(_drawn, first=[2**64]),
        *_each(_mean, first=[2**63]),
    ],
    "Samples have numbers below 2": _each(_drawn, first=[2**63 - 8], num_paths=[2**70]),
    "`levels` must be an integer from 1 to": _each(_mean, levels=[2000, 0]),
    "paths take .* GB or more, of .* GB. Pass a smaller `batch_size`": [
        *_each(_mean, sampling=PATHS),
        lambda: _drawn(num_paths=HUGE, batch_size=HUGE),
    ],
    "paths take .* GB or more, of .* GB. Pass a smaller `num_paths`": [
        *_each(_mean, sampling=[ds.ArrayRQMC(2**40)]),
        *_each(_paths, num_paths=[HUGE]),
        lambda: _paths(**LONG),
        *_each(_compared, num_paths=[HUGE]),
    ],
    "`num_paths` must be an integer, 2 or larger": _each(
        _compared, num_paths=[0, "many"]
    ),
    "must return arrays with one entry or more": [
        lambda: _mean(lambda t, y, args: {"one": y[1], "none": jnp.zeros((2, 0))}),
        lambda: _drawn(lambda key: jr.normal(key, (0,))),
    ],
    "`terms` must be Diffrax terms.*several in a `diffrax.MultiTerm.*got": [
        call
        for fn in (_mean, _paths)
        for call in _each(fn, terms=[[TERMS], (TERMS,), {"a": TERMS}, None])
    ],
    "`solver` must take fixed steps and be for equations with noise": [
        *_each(_mean, solver=[diffrax.Tsit5(), diffrax.HalfSolver(ds.StormerVerlet())]),
        *_each(_paths, solver=[diffrax.Kvaerno3()]),
    ],
    "`solvers` must be a list of one or more solvers": _each(
        _compared, solvers=[[], ds.StormerVerlet()]
    ),
    "`y0` must hold numbers and arrays of numbers.*got a": [
        call
        for fn in (
            _mean,
            lambda y0: _paths(y0=lambda key: y0),
            _compared,
            lambda y0: ds.suggest_solver(TERMS, 0.0, y0, want="weak"),
        )
        for call in _each(fn, y0=["rest", ("a", "b"), {0.0, 1.0}, _Parameters()])
    ],
    "`args` must hold arrays.*got a": [
        call
        for fn in (_mean, lambda args: _paths(args=lambda key: args))
        for call in _each(fn, args=[(1.0, {2}), _Parameters(), np.array(["a"])])
    ],
}
CALLS = [(message, call) for message, calls in REFUSED.items() for call in calls]


@pytest.mark.parametrize("message, call", CALLS)
def test_a_wrong_call_is_told_what_to_pass(message, call):
    with pytest.raises(ValueError, match=message):
        call()


def _frames(call) -> list[str]:
    with pytest.raises(Exception) as info:
        call()
    return [entry.name for entry in info.traceback]


@pytest.mark.parametrize("call, name", [(_mean, "expectation"), (_paths, "ensemble")])
def test_only_the_function_that_was_called_stands_between_a_user_and_a_message(
    call, name
):
    wrong = lambda: call(y0=jnp.ones(2))
    assert _frames(wrong)[-2:] == [call.__name__, name]

    def energy(t, p, q, args):
        raise ValueError("of the user")

    terms = ds.hamiltonian_terms(energy, _force, ())
    assert _frames(lambda: call(terms=terms))[-1] == "energy"
    try:
        jax.config.update("jax_traceback_filtering", "off")
        assert _frames(wrong)[-1] == "check_pair"
    finally:
        jax.config.update("jax_traceback_filtering", "auto")


def test_words_in_args_may_be_compared_and_not_computed_with():
    def energy(t, p, q, args):
        return p**2 / 2 + (q**2 if args["kind"] == "soft" else args["kind"] * q)

    terms = ds.hamiltonian_terms(energy, lambda t, p, q, args: -q, ())
    assert _paths(terms=terms, args={"kind": "soft"}).num_failed == 0
    with pytest.raises(TypeError) as info:
        _paths(terms=terms, args={"kind": "stiff"})
    assert "`args` hold no numbers, but str." in info.value.__notes__


def test_a_tolerance_whose_square_underflows_is_told_as_any_other():
    with pytest.warns(UserWarning, match="`tol=1e-300` was not reached"):
        _drawn(tol=1e-300)
