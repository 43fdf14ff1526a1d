"""Systems are refused for their structure, not for the way in which they are written."""

import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._terms import noises_commute


START = jnp.array([0.3, 0.1]), jnp.array([0.5, 0.2])
VERLET = ds.StormerVerlet()
PATH = ds.WeakBrownianPath((), jr.key(0))
PAIR = (jax.ShapeDtypeStruct((2,), jnp.float64),) * 2


def well(t, p, q, args):
    return jnp.sum(p**2 + q**4)


def kicks(t, p, q, args):
    return jnp.sum(jnp.sin(q))


def coupled(t, p, q, args):
    return jnp.sum(p * q)


def momentum(t, p, q, args):
    return jnp.sum(p)


def mass_in_time(t, p, q, args):
    return jnp.sum(p**2) * (1 + t)


def terms_of(H0, noise, path=PATH, **kwargs):
    return ds.hamiltonian_terms(H0, noise, path, **kwargs)


def plain(drift, field):
    """Terms of Diffrax."""
    operator = lambda t, y, args: lx.PyTreeLinearOperator(field(*y), PAIR)
    return diffrax.MultiTerm(
        diffrax.ODETerm(lambda t, y, args: drift(*y)),
        diffrax.ControlTerm(operator, PATH),
    )


def said(terms, solver=VERLET, y0=START, args=None, times=(0.0, 0.1)) -> str:
    """The message that refuses these terms."""
    with pytest.raises(ValueError) as info:
        solver.init(terms, *times, y0, args)
    return str(info.value)


def test_wrong_structure_is_refused_by_the_derivative():
    for H0, noise, derivative in (
        (coupled, kicks, "dH0/dq depends on p"),
        (mass_in_time, kicks, "dH0/dp depends on t"),
        (well, momentum, "dH_k/dp is not zero"),
        (well, coupled, "dH_k/dp is not zero"),
    ):
        assert derivative in said(terms_of(H0, noise))
    # One array of several is enough.
    H0 = lambda t, p, q, args: p["a"] ** 2 + q["a"] ** 2 + p["b"] * q["b"]
    one = {"a": jnp.ones(()), "b": jnp.ones(())}
    terms = terms_of(H0, lambda t, p, q, args: q["a"])
    assert "depends on" in said(terms, y0=(one, one))


def test_position_before_momentum_is_asked_about():
    H0 = lambda t, a, b, args: jnp.sum(b**2) / 2 + jnp.sum(a**4)
    for solver in (VERLET, ds.SRKs2()):
        terms = terms_of(H0, lambda t, a, b, args: -jnp.sum(a))
        assert "the wrong way round" in said(terms, solver)
    terms = plain(lambda p, q: (q, -(p**3)), lambda p, q: (jnp.zeros(2), jnp.ones(2)))
    assert "the wrong way round" in said(terms)
    assert "wrong way" not in said(terms_of(H0, coupled))


def _langevin(friction: float, momentum_first: bool) -> diffrax.MultiTerm:
    """Plain terms with the friction in the drift."""
    order = (lambda x, v: (v, x)) if momentum_first else (lambda x, v: (x, v))
    noises = jax.ShapeDtypeStruct((2,), jnp.float64)

    def drift(t, y, args):
        x, v = order(*y)
        return order(v, -(x**3) - friction * v if friction else -(x**3))

    kick = lambda w: order(jnp.zeros(2), 0.3 * w)
    operator = lambda t, y, args: lx.FunctionLinearOperator(kick, noises)
    path = ds.WeakBrownianPath((2,), jr.key(0))
    return diffrax.MultiTerm(
        diffrax.ODETerm(drift), diffrax.ControlTerm(operator, path)
    )


def test_friction_in_the_drift_is_told_of_langevin_terms():
    for first in (True, False):
        message = said(_langevin(0.5, first), ds.BAOAB())
        assert re.search("is another equation .* from `langevin_terms", message)
        assert ("wrong way round?" in message) is not first
        found = ds.suggest_solver(_langevin(0.5, first), 0.0, START, want="weak")
        assert "is another equation" in found.system
    # Friction of its own and plain terms go together.
    friction = ds.bath_terms(lambda t, p, q, args: p @ p / 2, 0.5).terms
    terms = diffrax.MultiTerm(*_langevin(0.0, True).terms, *friction)
    ds.BAOAB().init(terms, 0.0, 0.1, START, None)
    found = ds.suggest_solver(terms, 0.0, START, want="weak")
    assert isinstance(found[0].solver, ds.BAOAB)


def test_spins_are_not_told_to_write_sums():
    field = lambda t, s, args: s
    path = ds.WeakBrownianPath((3,), jr.key(0))
    terms = ds.spin_terms(lambda t, s, args: s[2], field, path)
    message = said(terms, y0=ds.to_spinors(jnp.array([1.0, 0.0, 0.0])))
    assert re.search("For spins and complex .* `ImplicitMidpoint`", message)


def test_plain_terms_of_a_separable_system_are_taken():
    # The noise is written out, with a block of zeros.
    terms = plain(
        lambda p, q: (-4 * q**3, 2 * p), lambda p, q: (-jnp.cos(q), jnp.zeros_like(q))
    )
    ends = []
    for x in (terms, terms_of(well, kicks)):
        VERLET.init(x, 0.0, 0.1, START, None)
        ends.append(VERLET.step(x, 0.0, 0.1, START, None, None, False)[0])
    np.testing.assert_allclose(*ends, rtol=1e-14)


def test_plain_terms_are_not_blamed_on_a_hamiltonian():
    turn = lambda p, q: (-q, p)
    both = plain(turn, lambda p, q: (q, q))
    for terms, solver, says in (
        (both, VERLET, "a noise term changes q, the second half of the state"),
        (both, ds.SRKs4(), "the noise b_k depends on the state"),
        (
            plain(turn, lambda p, q: (p, jnp.zeros(2))),
            VERLET,
            "changes p by an amount that depends on p",
        ),
    ):
        message = said(terms, solver)
        assert says in message
        assert "dH" not in message and "structure=" not in message
    drift = lambda p, q: (-p * q, p)
    message = said(plain(drift, lambda p, q: (jnp.cos(q), jnp.zeros(2))))
    assert "depend on p" in message and "structure=" not in message


def test_noises_commute_only_if_that_could_be_tested():
    path = ds.WeakBrownianPath((2,), jr.key(0))
    for second, expected in (
        (lambda p, q: jnp.sum(p * q) ** 2, True),
        (lambda p, q: jnp.sum(p), False),
        (lambda p, q: jnp.sum(jnp.sqrt(-1 - (p * q) ** 2)), False),
    ):
        noise = lambda t, p, q, args: jnp.stack([jnp.sum(p * q), second(p, q)])
        term = terms_of(well, noise, path).terms[1]
        assert noises_commute((term,), 0.0, START, None) == expected

    # A check of the user's does not stop the advice.
    def checked(t, p, q, args):
        q = eqx.error_if(q, jnp.any(q < 0.15), "coordinates must be positive")
        return jnp.stack([jnp.sum(p * q), jnp.sum(p * q) ** 2])

    terms = terms_of(coupled, checked, path)
    assert not noises_commute((terms.terms[1],), 0.0, START, None)
    assert len(ds.suggest_solver(terms, 0.0, START, want="strong")) > 0


def test_an_asserted_structure_is_relied_on():
    # Whether this is separable depends on a value that is not known while tracing.
    H0 = lambda t, p, q, args: well(t, p, q, args) + args * jnp.sum(p * q)

    def start(args, **kwargs):
        VERLET.init(terms_of(H0, kicks, **kwargs), 0.0, 0.1, START, args)

    for kwargs, says in (
        ({}, "depends on p.*pass `structure="),
        (dict(structure="additive"), "depends on"),
    ):
        with pytest.raises(ValueError, match=says):
            jax.eval_shape(lambda args: start(args, **kwargs), jnp.array(0.0))
    jax.eval_shape(lambda args: start(args, structure="separable"), jnp.array(0.0))
    with pytest.raises(ValueError, match="`structure` must be one of"):
        terms_of(H0, kicks, structure="seperable")


def _in_a_field(t, p, q, args):
    """A charge in a magnetic field, which mixes momenta and positions."""
    return jnp.sum((p - args * jnp.array([-q[1], q[0]])) ** 2) / 2 + jnp.sum(q**2) / 2


# In single precision rounding errors are larger.
@pytest.mark.parametrize(
    "name, dtype", [("hamiltonian", "float64"), ("langevin", "f4")]
)
def test_a_wrong_assertion_is_refused_where_values_are_known(name, dtype):
    kicked = name == "hamiltonian"
    solver = VERLET if kicked else ds.BAOAB(VERLET)
    start = jax.tree.map(lambda x: x.astype(dtype), START)
    path = solver.path(jax.ShapeDtypeStruct(() if kicked else (2,), dtype), jr.key(0))
    t0, t1, field = (jnp.array(x, dtype) for x in (0.0, 0.1, 0.5))

    def terms(H0, structure="separable"):
        if kicked:
            return ds.hamiltonian_terms(H0, kicks, path, structure=structure)
        return ds.langevin_terms(H0, 1.0, 1.5, path, structure=structure)

    wrong = terms(_in_a_field)
    says = rf'y0` H0 mixes p and q.*Leave `structure="separable"`.*`{name}_terms`'
    assert re.search(says, said(wrong, solver, start, field, (t0, t1)))
    if kicked:
        given = wrong, solver, 0, 0.2, 0.1, start, field
        with pytest.raises(ValueError, match=says):
            ds.expectation(lambda t, y, args: jnp.sum(y[0]), *given, key=jr.key(0))
        with pytest.raises(ValueError, match=says):
            ds.ensemble(*given, key=jr.key(0), num_paths=4)
    # Without a field it is right, in spite of rounding errors.
    cancelling = lambda t, p, q, args: (
        jnp.sum(p**2 + q**2) / 2
        + args * jnp.sum(p * (jnp.sin(q) + jnp.exp(q)))
        - args * (p @ jnp.sin(q) + p @ jnp.exp(q))
    )
    solver.init(terms(cancelling), t0, t1, start, 10 * field)
    # The advice that offers an assertion names the same function.
    message = said(terms(_in_a_field, None), solver, start, field, (t0, t1))
    assert f'`structure="separable"` to `{name}_terms`' in message


def test_each_part_of_an_assertion_is_compared():
    additive = ds.SRKs4()
    for structure, H0, noise, solver, says in (
        ("separable", well, momentum, VERLET, "noise Hamiltonian"),
        ("additive", well, kicks, additive, "the noise depends on the state"),
        ("separable", mass_in_time, kicks, VERLET, "dH0/dp depends on t"),
    ):
        message = said(terms_of(H0, noise, structure=structure), solver)
        assert re.search(f"at or near `y0`.*{says}", message)
    wrong = terms_of(well, momentum, structure="separable")
    with pytest.raises(
        ValueError, match="is wrong: at or near `y0` a noise Hamiltonian"
    ):
        ds.suggest_solver(wrong, 0.0, START, want="weak")
    free = lambda t, p, q, args: p**2 / 2
    # At q = 0 all derivatives of the force -q**2 vanish but the second one.
    terms = terms_of(free, lambda t, p, q, args: q**3 / 3, structure="additive")
    for p in (0.0, 1.0):
        y0 = jnp.array(p), jnp.array(0.0)
        assert "the noise depends on the state" in said(terms, additive, y0)
    # Near the start the noise has no values, since the root of a negative number is NaN.
    rooted = lambda t, p, q, args: jnp.sqrt(q) * 0 + q
    terms = terms_of(free, rooted, structure="additive")
    additive.init(terms, 0.0, 0.1, (jnp.zeros(()),) * 2, None)


def test_friction_in_a_second_term_is_not_blamed_on_the_hamiltonian():
    friction = diffrax.ODETerm(lambda t, y, args: (-0.1 * y[0], jnp.zeros(2)))
    terms = terms_of(well, kicks)
    for both in (
        diffrax.MultiTerm(friction, terms),
        diffrax.MultiTerm(*terms.terms, friction),
    ):
        message = said(both)
        assert re.search("besides H0.*`langevin_terms", message)
        assert "dH0/dq" not in message
    # A drift alone is that of H0, whatever it was made from.
    alone = diffrax.MultiTerm(friction, terms.terms[1])
    assert "a drift term makes dp/dt depend on p" in said(alone)


def test_a_force_that_is_no_gradient_is_a_term_of_its_own_and_the_message_says_so():
    # An active particle, pushed along its momentum: hidden from derivatives, an assertion
    # would pass the check at `y0`, and the step would be wrong.
    speed = lambda p: p / jnp.sqrt(1 + jnp.sum(p**2))
    kinetic = lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2
    push = lambda p, q: q @ jax.lax.stop_gradient(speed(p))
    pushed = lambda t, p, q, args: kinetic(t, p, q, args) - push(p, q)
    path = ds.WeakBrownianPath((2,), jr.key(0))
    own_term = r"no part of H0, and no `structure` makes it one: add it as a term"
    assert own_term in said(ds.langevin_terms(pushed, 1.0, 1.0, path), ds.BAOAB())
    # What the message says.
    along_p = diffrax.ODETerm(lambda t, y, args: (speed(y[0]), jnp.zeros(2)))
    both = diffrax.MultiTerm(*ds.langevin_terms(kinetic, 1.0, 1.0, path).terms, along_p)
    takes = r"takes such a term, and so does `BAOAB\(Imp"
    assert re.search(takes, said(both, ds.BAOAB()))
    ds.BAOAB(ds.ImplicitMidpoint()).init(both, 0.0, 0.1, START, None)
