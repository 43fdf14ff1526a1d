"""Systems are refused for their structure, not for the way in which they are written."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._structure_checks import commuting


def _solve(H0, noise, solver=None, args=None):
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(H0, noise, path)
    y0 = (jnp.array([0.3, 0.1]), jnp.array([0.5, -0.2]))
    solver = ds.SRKw3() if solver is None else solver
    return diffrax.diffeqsolve(terms, solver, 0.0, 0.2, 0.1, y0, args)


_good_H0 = lambda t, p, q, args: jnp.sum(p**2 + q**4)


_good_noise = lambda t, p, q, args: jnp.sum(jnp.sin(q))


@pytest.mark.parametrize(
    "solver", [ds.SRKw3("c"), ds.SRKw4(), ds.SRKs2(), ds.SRKs3(), ds.StormerVerlet()]
)
@pytest.mark.parametrize(
    "H0, noise, derivative",
    [
        (lambda t, p, q, args: jnp.sum(p * q), _good_noise, r"d\(dH0/dq\)/dp"),
        (lambda t, p, q, args: jnp.sum(p**2) * (1 + t), _good_noise, r"d\(dH0/dp\)/dt"),
        (_good_H0, lambda t, p, q, args: jnp.sum(p), "dH_k/dp"),
        (_good_H0, lambda t, p, q, args: jnp.sum(p * q), "dH_k/dp"),
    ],
    ids=["coupled", "time", "momentum", "both"],
)
def test_wrong_structure_is_refused_by_the_derivative(solver, H0, noise, derivative):
    with pytest.raises(ValueError, match=f"{derivative} does not vanish"):
        _solve(H0, noise, solver)


@pytest.mark.parametrize(
    "H0",
    [
        lambda t, p, q, args: jnp.sum((p - q) ** 2 / 2 + p * q),
        lambda t, p, q, args: jnp.sum(jnp.concatenate([p, q]) ** 2 / 2),
        lambda t, p, q, args: args * jnp.sum(jnp.exp(p) + q**2 * jnp.cos(t)),
        lambda t, p, q, args: jnp.sum(jnp.log(jnp.exp(p**2) * jnp.exp(q**2))),
    ],
    ids=["square", "concatenated", "parameter", "logarithm"],
)
def test_structure_is_never_refused_for_the_way_it_is_written(H0):
    # In the first, the last and the noise it takes some algebra to see.
    noise = lambda t, p, q, args: jnp.sum(jnp.sin(q + p - p))
    # The structure is checked while tracing.
    jax.eval_shape(lambda args: _solve(H0, noise, args=args), jnp.array(0.7))


def test_general_solvers_take_any_structure():
    _solve(lambda t, p, q, args: jnp.sum(p * q), _good_noise, ds.ImplicitMidpoint())


_oscillator = lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
@pytest.mark.parametrize(
    "H0, noise",
    [
        (_oscillator, lambda t, p, q, args: 1e-4 * jnp.sum(p)),
        (_oscillator, lambda t, p, q, args: 1e-20 * jnp.sum(p * q)),
        (lambda t, p, q, args: jnp.sum((p - 1e-3 * q) ** 2 + q**2), _good_noise),
        # Defined for positive numbers only: the more, the fewer random draws are.
        (_oscillator, lambda t, p, q, args: jnp.sum(jnp.sqrt(args) * p[0] * q[0])),
        (lambda t, p, q, args: jnp.sum(p[0] ** 2 * q[0] * jnp.sqrt(args)), _good_noise),
    ],
    ids=["small", "tiny", "tilted", "domain of noise", "domain of drift"],
)
def test_small_couplings_and_narrow_domains_do_not_get_past_the_check(H0, noise, dtype):
    path = ds.WeakBrownianPath(jax.ShapeDtypeStruct((), dtype), jr.key(0))
    terms = ds.hamiltonian_terms(H0, noise, path)
    y0 = (jnp.array([0.3, 0.1], dtype), jnp.array([0.5, -0.2], dtype))
    args = jnp.full(12, 0.1, dtype)
    t0, t1, h = jnp.array([0.0, 0.2, 0.1], dtype)
    with pytest.raises(ValueError, match="does not vanish"):
        diffrax.diffeqsolve(terms, ds.SRKw3(), t0, t1, h, y0, args)


def test_structure_that_cannot_be_tested_is_refused():
    nowhere = lambda t, p, q, args: jnp.sum(p**2 + jnp.sqrt(-1 - (p * q) ** 2))
    with pytest.raises(ValueError, match="could not be tested"):
        _solve(nowhere, _good_noise)


def test_one_coupled_array_of_several_is_enough_to_refuse():
    H0 = lambda t, p, q, args: p["a"] ** 2 + q["a"] ** 2 + p["b"] * q["b"]
    noise = lambda t, p, q, args: q["a"]
    terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
    one = {"a": jnp.ones(()), "b": jnp.ones(())}
    with pytest.raises(ValueError, match="does not vanish"):
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
        assert commuting((term,), 0.0, _positive_state, None) == expected


def _guarded(H0):
    """`H0` for positive coordinates, as a user may write it: checked and looked at."""

    def energy(t, p, q, args):
        q = eqx.error_if(q, jnp.any(q <= 0), "coordinates must be positive")

        def accumulate(total, x):
            x = eqx.error_if(x, x[1] <= 0, "coordinates must be positive")
            jax.debug.print("at {}", x)
            return total + H0(*x), None

        return jax.lax.scan(accumulate, jnp.zeros(()), (p, q))[0]

    return energy


_positive_state = jnp.array([0.3, 0.1]), jnp.array([0.5, 0.2])


def test_the_check_raises_no_error_of_the_user_and_prints_nothing(capfd):
    # Only algebra shows that p and q do not couple, so that numbers have to decide.
    separable = _guarded(lambda p, q: (p - jnp.log(q)) ** 2 / 2 + p * jnp.log(q))
    coupled = _guarded(lambda p, q: (p - jnp.log(q)) ** 2 / 2)
    solver, path = ds.StormerVerlet(), ds.WeakBrownianPath((), jr.key(0))
    check = lambda H0: jax.eval_shape(
        lambda y: solver.init(
            ds.hamiltonian_terms(H0, _good_noise, path), 0.0, 0.1, y, None
        ),
        _positive_state,
    )
    check(separable)
    with pytest.raises(ValueError, match="does not vanish"), jax.disable_jit():
        check(coupled)
    jax.effects_barrier()
    assert "at" not in capfd.readouterr().out


def test_the_check_draws_only_what_is_read():
    # A million times the memory of this machine, which only its shape is used of.
    H0 = lambda t, p, q, args: jnp.sum((p - q) ** 2 / 2 + p * q) * args.ndim
    terms = ds.hamiltonian_terms(H0, _good_noise, ds.WeakBrownianPath((), jr.key(0)))
    huge = jax.ShapeDtypeStruct((10**15,), jnp.float64)
    init = lambda args: ds.SRKs2().init(terms, 0.0, 0.1, _positive_state, args)
    jax.eval_shape(init, huge)


def test_an_asserted_structure_is_relied_on():
    # Whether this is separable depends on a value that is not known while tracing.
    H0 = lambda t, p, q, args: jnp.sum(p**2 + q**4) + args * jnp.sum(p * q)
    path, coupling = ds.WeakBrownianPath((), jr.key(0)), jnp.array(0.0)

    def solve(**kwargs):
        terms = ds.hamiltonian_terms(H0, _good_noise, path, **kwargs)
        return diffrax.diffeqsolve(
            terms, ds.StormerVerlet(), 0.0, 0.2, 0.1, _positive_state, coupling
        ).ys

    with pytest.raises(ValueError, match="does not vanish.*pass `structure=`"):
        solve()
    with pytest.raises(ValueError, match="does not vanish"):
        solve(structure="additive")
    expected = _solve_from(_good_H0, _positive_state)
    np.testing.assert_allclose(solve(structure="separable"), expected, rtol=1e-14)
    with pytest.raises(ValueError, match="`structure` must be one of"):
        solve(structure="seperable")


def _solve_from(H0, y0):
    terms = ds.hamiltonian_terms(H0, _good_noise, ds.WeakBrownianPath((), jr.key(0)))
    return diffrax.diffeqsolve(terms, ds.StormerVerlet(), 0.0, 0.2, 0.1, y0).ys


def test_friction_in_a_second_term_is_not_blamed_on_the_hamiltonian():
    friction = diffrax.ODETerm(lambda t, y, args: (-0.1 * y[0], 0 * y[1]))
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(_good_H0, _good_noise, path)
    for both in (
        diffrax.MultiTerm(friction, terms),
        diffrax.MultiTerm(*terms.terms, friction),
    ):
        with pytest.raises(ValueError, match="beside that of H0.*`Damped") as info:
            ds.StormerVerlet().init(both, 0.0, 0.1, _positive_state, None)
        assert "dH0/dq" not in str(info.value)
    # A drift alone is that of H0, whatever it was made from.
    alone = diffrax.MultiTerm(friction, terms.terms[1])
    with pytest.raises(ValueError, match=r"d\(dH0/dq\)/dp does not vanish"):
        ds.StormerVerlet().init(alone, 0.0, 0.1, _positive_state, None)
    # What could not be tested is not said to be friction.
    nowhere = diffrax.ODETerm(lambda t, y, args: (jnp.sqrt(-1 - y[0] ** 2), 0 * y[1]))
    with pytest.raises(ValueError, match="could not be tested"):
        both = diffrax.MultiTerm(*terms.terms, nowhere)
        ds.StormerVerlet().init(both, 0.0, 0.1, _positive_state, None)
