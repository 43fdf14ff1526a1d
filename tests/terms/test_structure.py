"""Systems are refused for their structure, not for the way in which they are written."""

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


def _solve(H0, noise, solver):
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(H0, noise, path)
    y0 = (jnp.array([0.3, 0.1]), jnp.array([0.5, -0.2]))
    return solver.init(terms, 0.0, 0.1, y0, None)


_good_H0 = lambda t, p, q, args: jnp.sum(p**2 + q**4)


_good_noise = lambda t, p, q, args: jnp.sum(jnp.sin(q))


def test_wrong_structure_is_refused_by_the_derivative():
    coupled = lambda t, p, q, args: jnp.sum(p * q)
    in_time = lambda t, p, q, args: jnp.sum(p**2) * (1 + t)
    momentum = lambda t, p, q, args: jnp.sum(p)
    for H0, noise, derivative in (
        (coupled, _good_noise, "dH0/dq depends on p"),
        (in_time, _good_noise, "dH0/dp depends on t"),
        (_good_H0, momentum, "dH_k/dp is not zero"),
        (_good_H0, coupled, "dH_k/dp is not zero"),
    ):
        with pytest.raises(ValueError, match=derivative):
            _solve(H0, noise, ds.StormerVerlet())


_pair = (jax.ShapeDtypeStruct((2,), jnp.float64),) * 2


def test_position_before_momentum_is_asked_about():
    H0 = lambda t, a, b, args: jnp.sum(b**2) / 2 + jnp.sum(a**4)
    kick = lambda t, a, b, args: -jnp.sum(a)
    for solver in (ds.StormerVerlet(), ds.SRKs2()):
        with pytest.raises(ValueError, match="the wrong way round"):
            _solve(H0, kick, solver)
    # As plain terms, too.
    kick = diffrax.ControlTerm(
        lambda t, y, args: lx.PyTreeLinearOperator((jnp.zeros(2), jnp.ones(2)), _pair),
        ds.WeakBrownianPath((), jr.key(0)),
    )
    drift = diffrax.ODETerm(lambda t, y, args: (y[1], -(y[0] ** 3)))
    terms = diffrax.MultiTerm(drift, kick)
    with pytest.raises(ValueError, match="the wrong way round"):
        ds.StormerVerlet().init(terms, 0.0, 0.1, _positive_state, None)
    with pytest.raises(ValueError) as info:
        _solve(H0, lambda t, p, q, args: jnp.sum(p * q), ds.StormerVerlet())
    assert "wrong way" not in str(info.value)


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
    y0 = jnp.ones(2), jnp.zeros(2)
    start = lambda terms: ds.BAOAB().init(terms, 0.0, 0.1, y0, None)
    for first in (True, False):
        with pytest.raises(
            ValueError, match="is another equation .* from `langevin_terms"
        ) as info:
            start(_langevin(0.5, first))
        assert ("wrong way round?" in str(info.value)) is not first
        found = ds.suggest_solver(_langevin(0.5, first), 0.0, y0, want="weak")
        assert "is another equation" in found.system
    # Friction of its own and plain terms go together.
    kinetic = lambda t, p, q, args: p @ p / 2
    friction = ds.bath_terms(kinetic, 0.5).terms
    terms = diffrax.MultiTerm(*_langevin(0.0, True).terms, *friction)
    start(terms)
    found = ds.suggest_solver(terms, 0.0, y0, want="weak")
    assert isinstance(found[0].solver, ds.BAOAB)


def test_spins_are_not_told_to_write_sums():
    terms = ds.spin_terms(
        lambda t, s, args: s[2],
        lambda t, s, args: s,
        ds.WeakBrownianPath((3,), jr.key(0)),
    )
    y0 = ds.to_spinors(jnp.array([1.0, 0.0, 0.0]))
    with pytest.raises(ValueError, match="For spins and complex .* `ImplicitMidpoint`"):
        ds.StormerVerlet().init(terms, 0.0, 0.1, y0, None)


def test_plain_terms_of_a_separable_system_are_taken():
    # The noise is written out, with a block of zeros.
    kick = diffrax.ControlTerm(
        lambda t, y, args: lx.PyTreeLinearOperator(
            (jnp.cos(y[1]), jnp.zeros_like(y[1])), _pair
        ),
        ds.WeakBrownianPath((), jr.key(0)),
    )
    drift = diffrax.ODETerm(lambda t, y, args: (-4 * y[1] ** 3, 2 * y[0]))
    terms = diffrax.MultiTerm(drift, kick)
    got = diffrax.diffeqsolve(terms, ds.StormerVerlet(), 0.0, 0.2, 0.1, _positive_state)
    noise = lambda t, p, q, args: -jnp.sum(jnp.sin(q))
    same = ds.hamiltonian_terms(_good_H0, noise, ds.WeakBrownianPath((), jr.key(0)))
    sol = diffrax.diffeqsolve(same, ds.StormerVerlet(), 0.0, 0.2, 0.1, _positive_state)
    np.testing.assert_allclose(got.ys, sol.ys, rtol=1e-14)


def test_plain_noise_is_not_blamed_on_a_hamiltonian():
    drift = diffrax.ODETerm(lambda t, y, args: (-y[1], y[0]))
    both = lambda p, q: (q, q)
    forward = lambda p, q: (p, jnp.zeros(2))
    for field, solver, says in (
        (both, ds.StormerVerlet(), "a noise term changes q, the second half of the st"),
        (forward, ds.StormerVerlet(), "changes p by an amount that depends on p"),
        (both, ds.SRKs4(), "the noise b_k depends on the state"),
    ):
        kick = diffrax.ControlTerm(
            lambda t, y, args: lx.PyTreeLinearOperator(field(*y), _pair),
            ds.WeakBrownianPath((), jr.key(0)),
        )
        terms = diffrax.MultiTerm(drift, kick)
        with pytest.raises(ValueError, match=says) as info:
            solver.init(terms, 0.0, 0.1, _positive_state, None)
        assert "dH" not in str(info.value)


def test_one_coupled_array_of_several_is_enough_to_refuse():
    H0 = lambda t, p, q, args: p["a"] ** 2 + q["a"] ** 2 + p["b"] * q["b"]
    noise = lambda t, p, q, args: q["a"]
    terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
    one = {"a": jnp.ones(()), "b": jnp.ones(())}
    with pytest.raises(ValueError, match="depends on"):
        ds.StormerVerlet().init(terms, 0.0, 0.1, (one, one), None)


def test_noises_commute_only_if_that_could_be_tested():
    path = ds.WeakBrownianPath((2,), jr.key(0))
    for second, expected in (
        (lambda p, q: jnp.sum(p * q) ** 2, True),
        (lambda p, q: jnp.sum(p), False),
        (lambda p, q: jnp.sum(jnp.sqrt(-1 - (p * q) ** 2)), False),
    ):
        noise = lambda t, p, q, args: jnp.stack([jnp.sum(p * q), second(p, q)])
        term = ds.hamiltonian_terms(_good_H0, noise, path).terms[1]
        assert noises_commute((term,), 0.0, _positive_state, None) == expected


_positive_state = jnp.array([0.3, 0.1]), jnp.array([0.5, 0.2])


def test_an_asserted_structure_is_relied_on():
    # Whether this is separable depends on a value that is not known while tracing.
    H0 = lambda t, p, q, args: jnp.sum(p**2 + q**4) + args * jnp.sum(p * q)
    path, coupling = ds.WeakBrownianPath((), jr.key(0)), jnp.array(0.0)

    def solve(**kwargs):
        terms = ds.hamiltonian_terms(H0, _good_noise, path, **kwargs)
        return diffrax.diffeqsolve(
            terms, ds.StormerVerlet(), 0.0, 0.2, 0.1, _positive_state, coupling
        ).ys

    with pytest.raises(ValueError, match="depends on p.*pass `structure="):
        solve()
    with pytest.raises(ValueError, match="depends on"):
        solve(structure="additive")
    expected = _solve_from(_good_H0, _positive_state)
    np.testing.assert_allclose(solve(structure="separable"), expected, rtol=1e-14)
    with pytest.raises(ValueError, match="`structure` must be one of"):
        solve(structure="seperable")


def _in_a_field(t, p, q, args):
    """A charge in a magnetic field, which mixes momenta and positions."""
    return jnp.sum((p - args * jnp.array([-q[1], q[0]])) ** 2) / 2 + jnp.sum(q**2) / 2


def _kicked(H0, structure, noise=_good_noise):
    return ds.hamiltonian_terms(H0, noise, (), structure=structure)


def _heated(H0, structure, noise=None):
    return ds.langevin_terms(H0, 1.0, 1.5, (2,), structure=structure)


# In single precision rounding errors are larger.
@pytest.mark.parametrize(
    "make, solver, name, dtype",
    [
        (_kicked, ds.StormerVerlet(), "hamiltonian_terms", jnp.float64),
        (_heated, ds.BAOAB(ds.StormerVerlet()), "langevin_terms", jnp.float32),
    ],
)
def test_a_wrong_assertion_is_refused_where_values_are_known(make, solver, name, dtype):
    y0 = jax.tree.map(lambda x: x.astype(dtype), _positive_state)
    struct = jax.ShapeDtypeStruct(() if make is _kicked else (2,), dtype)
    t0, field = jnp.zeros((), dtype), jnp.array(0.5, dtype)

    def terms(H0, structure):
        made = make(H0, structure).terms
        own = solver.path(struct, jr.key(0))
        return diffrax.MultiTerm(made[0], eqx.tree_at(lambda x: x.path, made[1], own))

    wrong = terms(_in_a_field, "separable"), solver, 0, 0.2, 0.1, y0, field
    says = rf'at or near `y0` H0 mixes p and q.*Leave `structure="separable"`.*`{name}`'
    with pytest.raises(ValueError, match=says):
        ds.expectation(lambda t, y, args: jnp.sum(y[0] ** 2), *wrong, key=jr.key(0))
    with pytest.raises(ValueError, match=says):
        ds.ensemble(*wrong, key=jr.key(0), num_paths=4)
    init = lambda H0, structure, args: solver.init(
        terms(H0, structure), t0, t0 + 0.1, y0, args
    )
    with pytest.raises(ValueError, match=says):
        init(_in_a_field, "separable", field)
    # Without a field it is right, in spite of rounding errors.
    cancelling = lambda t, p, q, args: (
        jnp.sum(p**2 + q**2) / 2
        + args * jnp.sum(p * (jnp.sin(q) + jnp.exp(q)))
        - args * (p @ jnp.sin(q) + p @ jnp.exp(q))
    )
    init(cancelling, "separable", 10 * field)
    # The advice that offers an assertion names the same function.
    with pytest.raises(ValueError, match=f'`structure="separable"` to `{name}`'):
        init(_in_a_field, None, field)


def test_each_part_of_an_assertion_is_compared():
    momentum = lambda t, p, q, args: jnp.sum(p)
    in_time = lambda t, p, q, args: (1 + t) * jnp.sum(p**2)
    for structure, H0, noise, says in (
        ("separable", _good_H0, momentum, "noise Hamiltonian"),
        ("additive", _good_H0, _good_noise, "the noise depends on the state"),
        ("separable", in_time, _good_noise, "dH0/dp depends on t"),
    ):
        terms = _kicked(H0, structure, noise)
        with pytest.raises(ValueError, match=f"is wrong: at or near `y0`.*{says}"):
            ds.suggest_solver(terms, 0.0, _positive_state, want="weak")


def test_a_wrong_assertion_is_refused_from_an_extremum_too():
    # At q = 0 all derivatives of the force -q**2 vanish but the second one.
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: p**2 / 2,
        lambda t, p, q, args: q**3 / 3,
        (),
        structure="additive",
    )
    for momentum in (0.0, 1.0):
        y0 = jnp.array(momentum), jnp.array(0.0)
        with pytest.raises(ValueError, match="the noise depends on the state"):
            ds.suggest_solver(terms, 0.0, y0, want="weak")


def test_an_assertion_counts_where_the_terms_have_values():
    # Near the start the noise has none, since the root of a negative number is NaN.
    terms = ds.hamiltonian_terms(
        lambda t, p, q, args: p**2 / 2,
        lambda t, p, q, args: jnp.sqrt(q) * 0 + q,
        (),
        structure="additive",
    )
    ds.suggest_solver(terms, 0.0, (jnp.array(0.0), jnp.array(0.0)), want="weak")


def test_plain_terms_are_not_told_to_assert_a_structure():
    drift = diffrax.ODETerm(lambda t, y, args: (-y[0] * y[1], y[0]))
    path = ds.WeakBrownianPath((), jr.key(0))
    noise = ds.hamiltonian_terms(_good_H0, _good_noise, path).terms[1]
    terms = diffrax.MultiTerm(drift, noise)
    with pytest.raises(ValueError, match="depend on p") as info:
        ds.StormerVerlet().init(terms, 0.0, 0.1, _positive_state, None)
    assert "structure=" not in str(info.value)


def _solve_from(H0, y0):
    terms = ds.hamiltonian_terms(H0, _good_noise, ds.WeakBrownianPath((), jr.key(0)))
    return diffrax.diffeqsolve(terms, ds.StormerVerlet(), 0.0, 0.2, 0.1, y0).ys


def test_friction_in_a_second_term_is_not_blamed_on_the_hamiltonian():
    friction = diffrax.ODETerm(lambda t, y, args: (-0.1 * y[0], jnp.zeros(2)))
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(_good_H0, _good_noise, path)
    for both in (
        diffrax.MultiTerm(friction, terms),
        diffrax.MultiTerm(*terms.terms, friction),
    ):
        with pytest.raises(ValueError, match="besides H0.*`langevin_terms") as info:
            ds.StormerVerlet().init(both, 0.0, 0.1, _positive_state, None)
        assert "dH0/dq" not in str(info.value)
    # A drift alone is that of H0, whatever it was made from.
    alone = diffrax.MultiTerm(friction, terms.terms[1])
    with pytest.raises(ValueError, match="a drift term makes dp/dt depend on p"):
        ds.StormerVerlet().init(alone, 0.0, 0.1, _positive_state, None)


def test_a_check_of_the_users_does_not_stop_the_advice():
    def noise(t, p, q, args):
        q = eqx.error_if(q, jnp.any(q < 0.15), "coordinates must be positive")
        return jnp.stack([jnp.sum(p * q), jnp.sum(p * q) ** 2])

    path = ds.WeakBrownianPath((2,), jr.key(0))
    terms = ds.hamiltonian_terms(lambda t, p, q, args: jnp.sum(p * q), noise, path)
    assert not noises_commute((terms.terms[1],), 0.0, _positive_state, None)
    assert len(ds.suggest_solver(terms, 0.0, _positive_state, want="strong")) > 0


def _speed(p):
    return p / jnp.sqrt(1 + jnp.sum(p**2))


def test_a_force_that_is_no_gradient_is_a_term_of_its_own_and_the_message_says_so():
    # An active particle, pushed along its momentum: hidden from derivatives, an assertion
    # would pass the check at `y0`, and the step would be wrong.
    kinetic = lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2
    push = lambda p, q: q @ jax.lax.stop_gradient(_speed(p))
    pushed = lambda t, p, q, args: kinetic(t, p, q, args) - push(p, q)
    path, y0 = ds.WeakBrownianPath((2,), jr.key(0)), (jnp.ones(2), jnp.zeros(2))

    def solve(terms, solver):
        return diffrax.diffeqsolve(terms, solver, 0.0, 1.0, 0.1, y0).ys

    own_term = r"no part of H0, and no `structure` makes it one: add it as a term"
    with pytest.raises(ValueError, match=own_term):
        solve(ds.langevin_terms(pushed, 1.0, 1.0, path), ds.BAOAB())
    # What the message says.
    terms = ds.langevin_terms(kinetic, 1.0, 1.0, path)
    along_p = diffrax.ODETerm(lambda t, y, args: (_speed(y[0]), jnp.zeros(2)))
    midpoint = ds.ImplicitMidpoint()
    both = diffrax.MultiTerm(*terms.terms, along_p)
    by_flow, whole = solve(both, ds.BAOAB(midpoint)), solve(both, midpoint)
    np.testing.assert_allclose(by_flow, whole, atol=0.02)
    with pytest.raises(ValueError, match=r"takes such a term, and so does `BAOAB\(Imp"):
        solve(both, ds.BAOAB())
