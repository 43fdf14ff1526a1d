"""Suggested solvers fit the system."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import increment_struct, UnspecifiedPath
from diffrax_symplectic._solver import LANGEVIN, own_path
from diffrax_symplectic._suggest import _shape_code, FOR_FRICTION, ranked, System
from diffrax_symplectic._terms import (
    brownian_paths,
    motion_numbers,
    with_paths,
    with_paths_for_shapes,
)

from .picard import by_picard
from .problems import damped_terms


class Kicks(diffrax.AbstractBrownianPath):
    """Kicks at random times, whose law is no Gaussian."""

    key: jax.Array
    t0 = 0.0
    t1 = jnp.inf
    levy_area = diffrax.BrownianIncrement

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        return 1.0 * jr.poisson(self.key, t1 - t0)


def _mixed(t, p, q, args):
    return jnp.sum(p**2 + q**2) / 2 + jnp.sum(p * q) ** 2 / 3


def _separable(t, p, q, args):
    return jnp.sum(p**2) / 2 - jnp.sum(jnp.cos(q))


# Energies and noises, what they are, and the solvers that are suggested first for means and
# paths.
CASES = {
    "separable": (
        _separable,
        lambda t, p, q, args: args * jnp.sin(q[:1]),
        {"separable"},
        ["StormerVerlet", "PlateauVerlet"],
    ),
    "constant": (
        _mixed,
        lambda t, p, q, args: jnp.stack([args * q[0], p[0] - 2 * jnp.sum(q)]),
        {"additive", "constant"},
        ["AdditiveGauss", "SRKs4"],
    ),
    "additive": (
        _mixed,
        lambda t, p, q, args: jnp.stack([jnp.exp(-t) * jnp.sum(p), t * p[0]]),
        {"additive"},
        ["SRKs4", "SRKs4"],
    ),
    "commuting": (
        _mixed,
        lambda t, p, q, args: jnp.stack([args * p @ q, jnp.cos(t) * jnp.sin(p @ q)]),
        set(),
        ["StrangGauss", "PlateauGauss"],
    ),
    "not commuting": (
        _mixed,
        lambda t, p, q, args: jnp.stack([p @ q, jnp.sum(p + args * q**2) ** 2]),
        {"do not commute"},
        ["NinomiyaVictoir", "LevyAreaMidpoint"],
    ),
}
WORDS = {"separable", "additive", "constant", "do not commute"}


@pytest.mark.parametrize("name", CASES)
def test_no_suggestion_is_refused_and_systems_are_known(name):
    H0, noise, words, first = CASES[name]
    dtype = jnp.float32 if "additive" in name else jnp.float64
    y0 = jnp.ones(2, dtype), jnp.full(2, 0.5, dtype)
    args = jnp.asarray(0.3, dtype)
    shape = noise(0.1, *y0, args).shape
    path = ds.WeakBrownianPath(jax.ShapeDtypeStruct(shape, dtype), jr.key(0))
    terms = ds.hamiltonian_terms(H0, noise, path)
    t0 = jnp.asarray(0.1, dtype)
    for want, best in zip(("weak", "strong"), first):
        found = ds.suggest_solver(terms, t0, y0, args, want=want)
        assert type(found[0].solver).__name__ == best
        assert {word for word in WORDS if word in found.system} == words
        assert getattr(found[0], f"{want}_order") >= 1
        for s in found:
            state = s.solver.init(s.terms(jr.key(1)), t0, t0 + 0.01, y0, args)
            if s is found[0]:
                given = t0, t0 + 0.01, y0, args, state, False
                step = lambda key: by_picard(s.solver).step(s.terms(key), *given)[0]
                y1 = jax.eval_shape(step, jr.key(1))
                assert jax.tree.map(jnp.shape, y1) == ((2,), (2,))


@pytest.mark.parametrize("want", ["weak", "strong"])
def test_with_friction_solvers_that_have_it_are_suggested(want):
    other = lambda t, p, q, args: jnp.sin(q)
    y0 = jnp.ones(2), jnp.ones(2)
    friction = jnp.array([0.5, 0.2])
    path = ds.WeakBrownianPath((2,), jr.key(0))
    bath = lambda H0: ds.langevin_terms(H0, friction, 0.3, path)
    of_order = ds.SRKs4() if want == "strong" else ds.BAOAB()
    other_general = ds.PlateauGauss() if want == "strong" else ds.BAOAB()
    any_energy = ds.BAOAB(ds.ImplicitMidpoint())
    splittings = [kind() for kind in FOR_FRICTION]
    for terms, first, apart in (
        # Stationary positions come first for means, and the order for paths.
        (bath(_separable), of_order, splittings),
        (damped_terms(_separable, friction, other, path), other_general, splittings),
        # Constant noise, and a mass that depends on positions.
        (bath(_mixed), any_energy, [any_energy]),
    ):
        found = ds.suggest_solver(terms, 0.0, y0, want=want)
        assert found[0].solver == first
        assert "with friction" in found.system
        langevin = [s.solver for s in found if isinstance(s.solver, LANGEVIN)]
        assert langevin[0] in (ds.BAOAB(), any_energy)
        assert {*map(repr, langevin)} == {*map(repr, apart)}
        for s in found:
            s.solver.init(s.terms(jr.key(1)), 0.0, 0.1, y0, None)
            assert "Path((2,), key" in s.path or ").path((2,), key" in s.path
        # Which of the two is for momenta.
        reason = {type(s.solver): s.reason for s in found}
        if ds.LangevinMiddle() in apart:
            assert "momenta" in reason[ds.LangevinMiddle]


def test_beside_other_noise_solvers_for_strong_friction_in_the_drift_come_first():
    H0 = lambda t, p, q, args: (p**2 + q**2) / 2
    y0 = jnp.array(0.0), jnp.array(0.0)
    path = lambda seed: ds.WeakBrownianPath((), jr.key(seed))
    bath = ds.langevin_terms(H0, 5.0, 1.0, path(0))
    for noise in (
        lambda t, p, q, args: 0.1 * p + 0.2 * q,
        lambda t, p, q, args: 0.1 * p * q,
    ):
        both = diffrax.MultiTerm(*bath.terms, *ds.noise_terms(noise, path(1)).terms)
        found = ds.suggest_solver(both, 0.0, y0, want="weak")
        assert "friction in the drift" in found.system
        assert type(found[0].solver) is ds.SRKw1
        limits = [s.solver.record.most_friction is not None for s in found]
        assert limits == sorted(limits) and limits[-1]


def test_many_noises_that_do_not_commute_do_not_ask_for_a_flow_of_each():
    first = lambda m: type(ranked("weak", System((), False, m))[0])
    assert first(2) is first(4) is ds.NinomiyaVictoir
    assert first(6) is first(300) is ds.SRKw1


def test_friction_as_a_term_gets_a_solver_and_is_told_of_langevin_terms():
    noise = lambda t, p, q, args: jnp.sum(jnp.sin(q))
    terms = ds.hamiltonian_terms(_separable, noise, ds.WeakBrownianPath((), jr.key(0)))
    friction = lambda t, y, args: (-0.1 * y[0], jnp.zeros_like(y[1]))
    damped = diffrax.MultiTerm(*terms.terms, diffrax.ODETerm(friction))
    y0 = (jnp.ones(1), jnp.ones(1))
    found = ds.suggest_solver(damped, 0.0, y0, want="weak")
    without = ds.suggest_solver(terms, 0.0, y0, want="weak")
    assert type(found[0].solver).__name__ == "StrangGauss"
    assert "`langevin_terms(H0, friction" in str(found)
    assert "`langevin_terms(H0, friction" not in str(without)
    assert f"\n{len(found)}. {type(found[-1].solver).__name__}()" in repr(found)


def test_noises_that_do_not_commute_may_be_terms_or_arrays_of_their_own():
    # In single precision.
    shape = jax.ShapeDtypeStruct((), jnp.float32)
    matrices = jnp.array([[[0, 1], [0, 0]], [[0, 0], [1, 0]]], jnp.float32)
    noises = [
        diffrax.ControlTerm(
            lambda t, y, args, A=A: A @ y, ds.WeakBrownianPath(shape, jr.key(i))
        )
        for i, A in enumerate(matrices)
    ]
    drift = diffrax.ODETerm(lambda t, y, args: y)
    one = jnp.ones((), jnp.float32)
    both = ds.WeakBrownianPath((shape, shape), jr.key(0))
    crossed = diffrax.ControlTerm(lambda t, y, args: y[::-1], both)
    for terms, y0 in ((noises, jnp.stack([one, one])), ([crossed], (one, one))):
        found = ds.suggest_solver(
            diffrax.MultiTerm(drift, *terms), 0.0, y0, want="strong"
        )
        # Lévy areas are those of one array of noises.
        assert [type(s.solver) for s in found] == [ds.ImplicitMidpoint]
        assert found[0].strong_order == 0.5
        assert "do not commute" in found.system and "friction" not in found.system


def test_code_of_a_path_makes_the_path():
    H0 = lambda t, p, q, args: p**2 / 2
    path = ds.WeakBrownianPath((2,), jr.key(0))
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: jnp.stack([q, p]), path)
    names, y0 = dict(ds=ds, key=jr.key(3)), (jnp.ones(()), jnp.ones(()))
    for want in ("weak", "strong"):
        for s in ds.suggest_solver(terms, 0.0, y0, want=want):
            made = brownian_paths(s.terms(jr.key(3)))[0]
            assert eqx.tree_equal(eval(s.path, names), made)
    # A half solver gets a Gaussian path.
    half = own_path(diffrax.HalfSolver(ds.StormerVerlet()), "weak", (), jr.key(0))
    assert type(half) is ds.FixedStepBrownianPath
    # Shapes are written with their precision.
    shapes = [jax.ShapeDtypeStruct((2,), x) for x in (jnp.float32, jnp.float64)]
    for shape in shapes:
        written = eval(_shape_code(shape))
        assert increment_struct(ds.WeakBrownianPath(written, jr.key(0))) == shape
    assert _shape_code(shapes[1]) == "(2,)" and _shape_code(shapes) == "shape"


def _driven(*paths):
    """Terms with one noise for each of these paths."""
    noise = [diffrax.ControlTerm(lambda t, y, args: y, path) for path in paths]
    return diffrax.MultiTerm(diffrax.ODETerm(lambda t, y, args: -y), *noise)


def _keys(terms) -> list[set]:
    """The keys of each path."""
    is_key = lambda x: jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    keys = lambda path: filter(is_key, jax.tree.leaves(path))
    return [
        {jr.key_data(x).tobytes() for x in keys(path)} for path in brownian_paths(terms)
    ]


def _weak(key):
    return ds.WeakBrownianPath((), jr.key(key))


def test_terms_that_share_a_path_share_the_new_one():
    path = _weak(0)
    shared = motion_numbers([path, path, _weak(0), _weak(7), path])
    assert shared == (0, 0, 0, 1, 0)
    for solver in (ds.ImplicitMidpoint(), ds.PlateauVerlet(), ds.LevyAreaMidpoint()):
        terms = _driven(path, path, _weak(0), _weak(7))
        keys = _keys(with_paths(solver.path, shared[:4], terms, jr.key(1)))
        assert keys[0] == keys[1] == keys[2] and keys[0].isdisjoint(keys[3])
    # No operation on PyTrees keeps the identity of a path.
    copied = jax.tree.map(lambda x: x, _driven(path, _weak(7), path))
    best = ds.suggest_solver(copied, 0.0, jnp.ones(()), want="weak")[0]
    in_a_program = eqx.filter_jit(lambda make, key: make(key))
    for terms in (best.terms(jr.key(3)), in_a_program(best.terms, jr.key(3))):
        first, second, third = _keys(terms)
        assert first == third and first.isdisjoint(second)


def test_traced_paths_are_one_brownian_motion_if_they_hold_the_same_key():
    traced = []

    def numbers(*keys):
        paths = [ds.WeakBrownianPath((), keys[i]) for i in (0, 1, 0)]
        traced.append(motion_numbers(paths))

    jax.eval_shape(numbers, jr.key(0), jr.key(0))
    assert traced == [(0, 1, 0)]


def test_each_shape_of_a_path_is_a_brownian_motion_of_its_own():
    shape = UnspecifiedPath(shape=jax.ShapeDtypeStruct((), jnp.float64))
    assert motion_numbers([shape, shape]) == (0, 1)
    for first in (shape, _weak(0)):
        terms = _driven(first, shape, shape)
        keys = _keys(with_paths_for_shapes(terms, ds.WeakBrownianPath))
        assert len(set.union(*keys)) == 3


ONE = jnp.ones(())
PAIR = ds.hamiltonian_terms(
    lambda t, p, q, args: p**2 / 2, lambda t, p, q, args: q, _weak(0)
)
RAMP = diffrax.LinearInterpolation(jnp.array([0.0, 1.0]), jnp.array([0.0, 1.0]))
TOO_LONG = diffrax.MultiTerm(
    diffrax.ODETerm(lambda t, y, args: jnp.ones(3)), _driven(_weak(0)).terms[1]
)


@pytest.mark.parametrize(
    "message, terms, y0, want",
    [
        ("`want` must be one of", PAIR, (ONE, ONE), "moments"),
        ("with a Brownian path; got function", _separable, (ONE, ONE), "strong"),
        ("got terms without one", _driven().terms[0], ONE, "strong"),
        ("got terms without one", _driven(RAMP), ONE, "strong"),
        ("broadcast", TOO_LONG, jnp.ones(2), "strong"),
        ("is a pair", PAIR, jnp.ones(2), "strong"),
        ("real floating-point", PAIR, (1j * ONE, ONE), "strong"),
    ],
)
def test_bad_input_gets_a_clear_error(message, terms, y0, want):
    with pytest.raises(ValueError, match=message):
        ds.suggest_solver(terms, 0.0, y0, want=want)


def test_suggestions_say_what_the_other_order_of_the_state_would_allow():
    f = lambda t, y, args: (y[1], -jnp.sin(y[0]))
    struct = jax.ShapeDtypeStruct((), jnp.result_type(float))
    g = lambda t, y, args: lx.FunctionLinearOperator(lambda w: (0 * w, 0.3 * w), struct)
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = diffrax.MultiTerm(diffrax.ODETerm(f), diffrax.ControlTerm(g, path))
    y0 = jnp.array(0.5), jnp.array(0.1)
    got = ds.suggest_solver(terms, 0, y0, want="strong")
    assert "is the state the wrong way round?" in got.system
    assert "StormerVerlet" not in str(got)


def test_with_constraints_only_solvers_that_keep_them_are_suggested():
    rod = lambda q, args: jnp.stack([jnp.sum(q**2) - 1])
    H0 = lambda t, p, q, args: jnp.sum(p**2) / 2 + q[0]
    noise = lambda t, p, q, args: jnp.sin(q[0])
    y0 = jnp.array([0.0, 0.1]), jnp.array([1.0, 0.0])
    kicked = ds.hamiltonian_terms(H0, noise, (), constraint=rod)
    bath = ds.langevin_terms(H0, 1.0, 0.5, (2,), constraint=rod)
    in_bath = [ds.BAOAB(), ds.BAOAB(ds.StormerVerlet())]
    for terms, solvers in ((kicked, [ds.StormerVerlet()]), (bath, in_bath)):
        for want in ("weak", "strong"):
            found = ds.suggest_solver(terms, 0.0, y0, want=want)
            assert [s.solver for s in found] == solvers
            assert "constraints" in found.system
        # With the path of the solver these are still terms with a constraint.
        found[0].solver.init(found[0].terms(jr.key(0)), 0.0, 0.1, y0, None)
        with pytest.raises(ValueError, match="terms are constrained"):
            at = found[0].terms(jr.key(0)), 0.0, 0.1, y0, None, None, False
            ds.ImplicitMidpoint().step(*at)
    mixed = lambda t, p, q, args: jnp.sum(p**2) * q[0]
    terms = ds.hamiltonian_terms(mixed, noise, (), constraint=rod)
    with pytest.raises(ValueError, match="Solvers for constrained terms need"):
        ds.suggest_solver(terms, 0.0, y0, want="weak")


def test_a_keyed_path_of_ones_own_is_kept_with_another_key():
    terms = ds.hamiltonian_terms(_separable, lambda t, p, q, args: -q, Kicks(jr.key(0)))
    for want in ("strong", "weak"):
        for suggestion in ds.suggest_solver(terms, 0.0, (0.0, 1.0), want=want):
            paths = [brownian_paths(suggestion.terms(jr.key(seed))) for seed in (1, 2)]
            (one,), (other,) = paths
            assert type(one) is type(other) is Kicks
            assert one.key != other.key
            assert suggestion.path == "the `Kicks` of the terms, with another key"
            # It has increments only.
            assert suggestion.solver.variables == ("W",)
