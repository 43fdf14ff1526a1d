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


def plain(drift, field=lambda p, q: (q, jnp.zeros(2))):
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


ONE = {"a": jnp.ones(()), "b": jnp.ones(())}
# Position before momentum.
SWAPPED = terms_of(
    lambda t, a, b, args: jnp.sum(b**2) / 2 + jnp.sum(a**4),
    lambda t, a, b, args: -jnp.sum(a),
)
BOTH_CHANGE = plain(lambda p, q: (-q, p), lambda p, q: (q, q))
SPIN = ds.spin_terms(
    lambda t, s, args: s[2], lambda t, s, args: s, ds.WeakBrownianPath((3,), jr.key(0))
)
FRICTION = diffrax.ODETerm(lambda t, y, args: (-0.1 * y[0], jnp.zeros(2)))
OF_WELL = terms_of(well, kicks)
BESIDES = "besides H0.*`langevin_terms"
# With whether the message speaks of derivatives of a Hamiltonian.
REFUSED = [
    (terms_of(coupled, kicks), "dH0/dq depends on p", True),
    (terms_of(mass_in_time, kicks), "dH0/dp depends on t", True),
    (terms_of(well, momentum), "dH_k/dp is not zero", True),
    # Plain terms are not blamed on a Hamiltonian.
    (BOTH_CHANGE, "a noise term changes q, the second half of the state", False),
    (
        plain(lambda p, q: (-q, p), lambda p, q: (p, 0 * q)),
        "p by an amount that",
        False,
    ),
    (plain(lambda p, q: (-p * q, p)), "depend on p", False),
    # Nor is friction in a second term.
    (diffrax.MultiTerm(FRICTION, OF_WELL), BESIDES, False),
    (diffrax.MultiTerm(*OF_WELL.terms, FRICTION), BESIDES, False),
    # A drift alone is that of H0, whatever it was made from.
    (diffrax.MultiTerm(FRICTION, OF_WELL.terms[1]), "makes dp/dt depend on p", False),
    (SWAPPED, "the wrong way round", True),
    (plain(lambda p, q: (q, -(p**3)), lambda p, q: (0 * p, p)), "wrong way rou", False),
]


def test_wrong_structure_is_refused_by_what_breaks_it():
    for terms, says, of_energy in REFUSED:
        message = said(terms)
        assert re.search(says, message)
        assert of_energy or not re.search("dH0/dq|dH_k|structure=", message)
    assert "the noise b_k depends on the state" in said(BOTH_CHANGE, ds.SRKs4())
    assert "the wrong way round" in said(SWAPPED, ds.SRKs2())
    assert "wrong way" not in said(terms_of(coupled, coupled))
    # One array of several is enough.
    H0 = lambda t, p, q, args: p["a"] ** 2 + q["a"] ** 2 + p["b"] * q["b"]
    terms = terms_of(H0, lambda t, p, q, args: q["a"])
    assert "depends on" in said(terms, y0=(ONE, ONE))
    # Spins are not told to write sums.
    message = said(SPIN, y0=ds.to_spinors(jnp.array([1.0, 0.0, 0.0])))
    assert re.search("For spins and complex .* `ImplicitMidpoint`", message)
    # Plain terms of a separable system are taken.
    VERLET.init(plain(lambda p, q: (-4 * q**3, 2 * p)), 0.0, 0.1, START, None)


def test_friction_in_the_drift_is_told_of_langevin_terms():
    kick = lambda p, q: (jnp.ones(2), jnp.zeros(2))
    found = plain(lambda p, q: (-0.5 * p - q**3, p), kick)
    # Position before velocity.
    swapped = plain(lambda x, v: (v, -0.5 * v - x**3), lambda x, v: kick(v, x)[::-1])
    for terms in (found, swapped):
        message = said(terms, ds.BAOAB())
        assert re.search("is another equation .* from `langevin_terms", message)
        assert ("wrong way round?" in message) is (terms is swapped)
    system = ds.suggest_solver(found, 0.0, START, want="weak").system
    assert "is another equation" in system
    # Friction of its own and plain terms go together.
    friction = ds.bath_terms(lambda t, p, q, args: p @ p / 2, 0.5).terms
    terms = plain(lambda p, q: (-(q**3), p), kick)
    terms = diffrax.MultiTerm(*terms.terms, *friction)
    best = ds.suggest_solver(terms, 0.0, START, want="weak")[0]
    assert isinstance(best.solver, ds.BAOAB)


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


def test_a_wrong_assertion_is_refused_where_values_are_known():
    # In single precision rounding errors are larger.
    start = jax.tree.map(lambda x: x.astype(np.float32), START)
    path = VERLET.path(jax.ShapeDtypeStruct((), np.float32), jr.key(0))
    *times, field = (jnp.float32(x) for x in (0.0, 0.1, 0.5))
    terms = lambda H0, asserted="separable": terms_of(
        H0, kicks, path, structure=asserted
    )
    of = lambda terms, solver=VERLET: said(terms, solver, start, field, times)

    wrong, given = terms(_in_a_field), (0, 0.2, 0.1, start, field)
    says = r'y0` H0 mixes p and q.*Leave `structure="separable"`.*`hamiltonian_terms`'
    assert re.search(says, of(wrong))
    with pytest.raises(ValueError, match=says):
        phi = lambda t, y, args: jnp.sum(y[0])
        ds.expectation(phi, wrong, VERLET, *given, key=jr.key(0))
    with pytest.raises(ValueError, match=says):
        ds.ensemble(wrong, VERLET, *given, key=jr.key(0), num_paths=4)
    # Without a field it is right, in spite of rounding errors.
    cancelling = lambda t, p, q, args: (
        jnp.sum(p**2 + q**2) / 2
        + args * jnp.sum(p * (jnp.sin(q) + jnp.exp(q)))
        - args * (p @ jnp.sin(q) + p @ jnp.exp(q))
    )
    VERLET.init(terms(cancelling), *times, start, 10 * field)
    # The advice that offers an assertion names the function that makes the terms.
    offer = '`structure="separable"` to `{}_terms`'
    assert offer.format("hamiltonian") in of(terms(_in_a_field, None))
    path = ds.BAOAB().path(jax.ShapeDtypeStruct((2,), np.float32), jr.key(0))
    heated = ds.langevin_terms(_in_a_field, 1.0, 1.5, path)
    assert offer.format("langevin") in of(heated, ds.BAOAB())


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
