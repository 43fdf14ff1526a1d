"""What the record of each solver claims. One table of solvers; one compiled program for
each, solver and precision, that takes one step of many systems."""

import functools as ft

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import most_demanding_variable
from diffrax_symplectic._solver import AbstractLangevinSplitting, LANGEVIN, SOLVERS
from diffrax_symplectic._tableau import make_plan

from ..conftest import OPTIMIZED
from ..picard import by_picard
from ..problems import (
    FineSample,
    Given,
    one_after_another,
    over_steps,
    slope,
    SYSTEMS,
    values_of_a_step,
)


_GAUSS = 1 / 4 + np.sqrt(3) / 6
# Members of families that differ in what they do, beside the defaults.
MEMBERS = [
    ds.SRKw1(b=0.2),
    *(ds.SRKw3(variant) for variant in "abdef"),
    ds.SRKw4(a21=_GAUSS),
    ds.SRKs3(a=0.25),
    ds.SRKs4(sign=1),
    ds.SRKs4(beta1=0.3, beta2=-0.7, b=0.4),
]
DEFAULTS = [solver() for solver in SOLVERS]
GAMMA = 0.7


def oscillator(time, y, args):
    """The exact flow of p^2 / 2 + 2 q^2."""
    p, q = y
    c, s = jnp.cos(2 * time), jnp.sin(2 * time)
    return c * p - 2 * s * q, s / 2 * p + c * q


# Two baths, which share the noise of a step, around a step of Verlet's method.
OBABO = ds.Splitting(
    [ds.Bath(1 / 2), ds.Kick(1 / 2), ds.Flight(1), ds.Kick(1 / 2), ds.Bath(1 / 2)]
)

# Those that treat a part of the drift by itself: the friction of their terms, or a flow
# that the terms leave out.
SPLIT = [
    *(solver() for solver in LANGEVIN),
    OBABO,
    ds.BAOAB(ds.StormerVerlet()),
    ds.LinearFlow(ds.StormerVerlet(), oscillator),
]
TABLE = [*DEFAULTS, *SPLIT, *MEMBERS]
# Those whose step is another program. The others negate the increment, or are of the same
# blocks with other numbers.
STEPS = [
    *DEFAULTS,
    *SPLIT,
    ds.SRKw1(b=0.2),
    ds.SRKw3("a"),
    ds.SRKs3(a=0.25),
    ds.SRKw4(a21=_GAUSS),
]


def has_friction(solver) -> bool:
    return isinstance(solver, AbstractLangevinSplitting)


def area_factor(solver, rate_times_step):
    """The factor by which a step shrinks areas, where friction is one rate for all momenta:
    each bath is the midpoint rule for it, over a share of the step."""
    halves = [bath.share / 2 for bath in solver.pieces if isinstance(bath, ds.Bath)]
    factors = [(1 - x * rate_times_step) / (1 + x * rate_times_step) for x in halves]
    return ft.reduce(lambda x, y: x * y, factors)


def terms_for(solver, *args, **kwargs):
    """The terms of the solver's system, with a friction -GAMMA p if it needs one."""
    terms = SYSTEMS[solver.structure].terms(*args, **kwargs)
    if not has_friction(solver):
        return terms
    friction = ds.bath_terms(lambda t, p, q, args: p @ p / 2, GAMMA)
    return diffrax.MultiTerm(*terms.terms, *friction.terms)


def whole(terms, solver):
    """The terms of the system that the solver solves."""
    if not isinstance(solver, ds.LinearFlow):
        return terms
    left_out = diffrax.ODETerm(lambda t, y, args: (-4 * y[1], y[0]))
    return diffrax.MultiTerm(*terms.terms, left_out)


def once_for_each_kind(make):
    """`make(solver)`, once for all solvers whose systems are the same."""
    made = {}

    def of(solver):
        is_split = isinstance(solver, ds.LinearFlow)
        kind = solver.structure, has_friction(solver), is_split
        if kind not in made:
            made[kind] = make(solver)
        return made[kind]

    return of


def take_step(solver, terms, t0, t1, y0, args):
    """One step from a state of the solver made anew, if it has one."""
    state = None
    if has_friction(solver) or isinstance(solver, ds.LinearFlow):
        state = solver.init(terms, t0, t1, y0, args)
    y1, _, _, _, result = solver.step(terms, t0, t1, y0, args, state, False)
    return y1, result


# By the scope all tests of one solver follow each other, in the process that has compiled
# its program.
each = lambda solvers: pytest.mark.parametrize(
    "solver", solvers, ids=repr, scope="module"
)
# Optimized, a step with its derivative takes ten seconds to compile. So the core has one
# solver for each kind of step: one system of equations, several, none, and flows.
CORE = "ImplicitMidpoint()", "SRKw2()", "StormerVerlet()", "NinomiyaVictoir()"
# One for each kind of step. Others are of the same blocks with other numbers, which
# `test_tableau` knows; of implicit ones of separable systems the strong order is measured.
QUICK_STEPS = [*CORE, *map(repr, (ds.LevyAreaMidpoint(), ds.BAOAB(), SPLIT[-1]))]


def marked(solvers, quick, core=()):
    """Of these, those whose name is in `quick` or `core` without the mark `slow`, and the
    latter with the mark `core`."""

    def marks(solver):
        if repr(solver) in core:
            return pytest.mark.core
        return () if repr(solver) in quick else pytest.mark.slow

    return [pytest.param(solver, marks=marks(solver)) for solver in solvers]


N, D, M = 1000, 2, 2


class Batch(eqx.Module):
    """One step of each of many systems."""

    y0: tuple
    args: dict
    # Factors of the drift and of the noise.
    sizes: jax.Array
    h: jax.Array
    variables: dict


@ft.cache
def batch(structure: str, dtype) -> Batch:
    if dtype != jnp.float64:
        return jax.tree.map(dtype, batch(structure, jnp.float64))

    @jax.vmap
    def draw(key):
        k_system, k_size, k_h, k_A, *ks = jr.split(key, 11)
        y0, args = SYSTEMS[structure].draw(k_system, D, M, dtype)
        h = jnp.exp(jr.uniform(k_h, (), dtype, jnp.log(1e-3), jnp.log(0.2)))
        # One noise or two.
        used = jnp.arange(M) < jr.randint(k_size, (), 1, M + 1)
        names = ("W", "H", "K", "C", "second", "third", "two_point")
        drawn = {
            name: jnp.sqrt(h) * used * jr.normal(k, (M,), dtype)
            for name, k in zip(names, ks)
        }
        drawn["H"], drawn["K"] = drawn["H"] / 12**0.5, drawn["K"] / 720**0.5
        A = h / 2 * used[:, None] * used * jr.normal(k_A, (M, M), dtype)
        drawn["A"] = A - A.T
        return Batch(y0, args, jnp.ones(2, dtype), h, drawn)

    # It runs once.
    options = {"xla_backend_optimization_level": 0}
    return jax.jit(draw, compiler_options=options)(jr.split(jr.key(0), N))


@ft.cache
def program(solver, dtype, derivatives: bool):
    """Ends of the steps, their derivatives by state and sizes, if asked for, and which
    succeeded."""
    # Their equations are of the kinds that those of the core are. Without optimizations,
    # the first of these stands for the others.
    core = CORE if OPTIMIZED else CORE[:1]
    if dtype == jnp.float64 and repr(solver) not in (*core, "StrangGauss()"):
        solver = by_picard(solver)

    @jax.jit
    @jax.vmap
    def step(x: Batch):
        flat, unravel = jfu.ravel_pytree((x.y0, x.sizes))

        def end(flat):
            y0, sizes = unravel(flat)
            terms = terms_for(solver, Given(**x.variables), sizes)
            zero = jnp.zeros_like(x.h)
            y1, result = take_step(solver, terms, zero, x.h, y0, x.args)
            y1, _ = jfu.ravel_pytree(y1)
            return y1, (y1, result == diffrax.RESULTS.successful)

        if not derivatives:
            y1, success = end(flat)[1]
            return y1, None, success
        jacobian, (y1, success) = jax.jacrev(end, has_aux=True)(flat)
        return y1, jacobian, success

    return step


@each(marked(STEPS, QUICK_STEPS, CORE))
def test_steps_of_a_thousand_random_systems_are_symplectic(solver):
    x = batch(solver.structure, jnp.float64)
    y1, jacobian, success = program(solver, jnp.float64, True)(x)
    assert y1.dtype == jacobian.dtype == jnp.float64
    assert np.all(success)
    J = np.asarray(jacobian[:, :, : 2 * D])
    zero, one = np.zeros((D, D)), np.eye(D)
    omega = np.block([[zero, one], [-one, zero]])
    shrunk = 1.0
    if has_friction(solver):
        shrunk = area_factor(solver, GAMMA * np.asarray(x.h))[:, None, None]
    defects = np.swapaxes(J, 1, 2) @ omega @ J - shrunk * omega
    assert np.max(np.abs(defects)) <= 1e-13


@each(marked([*DEFAULTS, *SPLIT], (CORE[0], CORE[2], "BAOAB()"), CORE[:1]))
def test_steps_in_single_precision_are_those_in_double_precision(solver):
    # Which are symplectic. Derivatives are more than half of a program.
    with_derivatives = OPTIMIZED or repr(solver) in CORE[1:3]
    x = batch(solver.structure, jnp.float32)
    y1, jacobian, success = program(solver, jnp.float32, with_derivatives)(x)
    assert np.all(success)
    doubled = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), x)
    exact, exact_jacobian, _ = program(solver, jnp.float64, True)(doubled)

    def assert_close(single, double, bound):
        assert single.dtype == jnp.float32
        size = np.max(np.abs(double), axis=1, keepdims=True)
        assert np.max(np.abs(single - double) / size) <= bound

    # Of `ImplicitMidpoint` 6.5e-7 are measured, six units in the last place.
    assert_close(y1, exact, 1.5e-6)
    if with_derivatives:
        flat = lambda x: np.reshape(x, (N, -1))
        assert_close(flat(jacobian), flat(exact_jacobian), 5e-6)


def _some(x: Batch, number: int) -> Batch:
    """The first so many systems, again and again: of the size of the whole batch."""
    return jax.tree.map(lambda leaf: leaf[jnp.arange(N) % number], x)


@each(marked(STEPS, QUICK_STEPS))
def test_derivatives_equal_central_differences(solver):
    # Each system is moved along each of its unknowns and sizes, forward and back.
    n = 2 * D + 2
    x = _some(batch(solver.structure, jnp.float64), 40)
    moved = np.arange(N) // 40
    along = jnp.asarray(np.eye(n + 1, n)[moved % (n + 1)])
    sign = jnp.where(moved >= n + 1, -1.0, 1.0)[:, None]
    flat = jnp.concatenate([*x.y0, x.sizes], axis=1) + 1e-5 * sign * along
    p, q, sizes = jnp.split(flat, [D, 2 * D], axis=1)
    x = eqx.tree_at(lambda x: (x.y0, x.sizes), x, ((p, q), sizes))
    y1, jacobian, success = program(solver, jnp.float64, True)(x)
    assert np.all(success)
    plus, minus = y1[: 40 * n], y1[40 * (n + 1) : 40 * (2 * n + 1)]
    differences = ((plus - minus) / 2e-5).reshape(n, 40, 2 * D)
    exact = jacobian[40 * n : 40 * (n + 1)]
    np.testing.assert_allclose(np.moveaxis(differences, 0, 2), exact, atol=1e-8)


@each(marked(STEPS, QUICK_STEPS))
def test_failures_are_reported_and_leave_others_as_they_are(solver):
    x = batch(solver.structure, jnp.float64)
    sizes = np.ones((N, 2))
    sizes[7, 0], sizes[9, 1] = np.nan, np.nan
    broken = eqx.tree_at(lambda x: x.sizes, x, jnp.asarray(sizes))
    step = program(solver, jnp.float64, True)
    fine, others = step(x), step(broken)
    whole = np.all(np.isfinite(sizes), axis=1)
    np.testing.assert_array_equal(others[2], whole)
    for a, b in zip(fine[:2], others[:2]):
        np.testing.assert_allclose(a[whole], b[whole], rtol=1e-12, atol=1e-13)


@once_for_each_kind
def _flows(solver) -> jax.Array:
    """Exact flows of the drift over 0.1 and over 0.05."""
    x = batch(solver.structure, jnp.float64)

    @jax.jit
    @jax.vmap
    def flow(y0, args, h):
        terms = whole(terms_for(solver, Given(jnp.zeros(M)), jnp.ones(2)), solver)
        drift = diffrax.MultiTerm(
            *(terms.terms[i] for i in (0, *range(2, len(terms.terms))))
        )
        y, unravel = jfu.ravel_pytree(y0)
        dt = h / 100

        # Runge's and Kutta's method of order four, one program for all of its stages.
        def stage(carry, coefficients):
            (t, y, k, change), (a, b) = carry, coefficients
            at = t + a * dt, unravel(y + a * k), args
            k, _ = jfu.ravel_pytree(drift.vf_prod(*at, drift.contr(0.0, dt)))
            return (t, y, k, change + b * k), None

        def step(i, y):
            stages = jnp.array([0, 1 / 2, 1 / 2, 1]), jnp.array([1, 2, 2, 1]) / 6
            begin = i * dt, y, jnp.zeros_like(y), jnp.zeros_like(y)
            return y + jax.lax.scan(stage, begin, stages)[0][3]

        return jax.lax.fori_loop(0, 100, step, y)

    some = jax.tree.map(lambda leaf: leaf[:50], (x.y0, x.args))
    return jnp.stack([flow(*some, jnp.full(50, h)) for h in (0.1, 0.05)])


@each(marked(STEPS, QUICK_STEPS))
def test_the_order_without_noise_is_that_of_the_coefficients(solver):
    x = _some(batch(solver.structure, jnp.float64), 50)
    sizes = jnp.ones((N, 2)).at[:, 1].set(0)
    h = jnp.repeat(jnp.array([0.1, 0.05, 0.001]), np.array([50, 50, N - 100]))
    x = eqx.tree_at(lambda x: (x.sizes, x.h), x, (sizes, h))
    y1, _, _ = program(solver, jnp.float64, True)(x)
    ends = jnp.stack([y1[:50], y1[50:100]])
    errors = np.linalg.norm(ends - _flows(solver), axis=(1, 2))
    order = slope(np.array([0.1, 0.05]), errors) - 1
    assert abs(order - solver.order(None)) <= 0.2


# Kinds of noises, and whether they commute.
KINDS = {"one": True, "commuting": True, "others": False}
# Small enough for the leading term of the error, to 0.1 of an order.
_WEAK_STEPS = jnp.array([0.002, 0.001, 0.0005])


def _kinds(structure: str) -> dict[str, bool]:
    return KINDS if structure == "any" else {"one": True, "commuting": True}


@once_for_each_kind
def _weak_systems(solver):
    """Two systems of each kind, with two noises; and the means of exact steps, but for
    terms beyond the third or fourth order of the step."""
    order = 3 if solver.structure == "constant" else 2
    system = SYSTEMS[solver.structure]
    keys = jr.split(jr.key(4), 2)
    kinds = _kinds(solver.structure)

    @jax.jit
    def of_each_kind(keys):
        draw = ft.partial(system.draw, d=1, m=2, dtype=jnp.float64, strength=2.0)
        drawn = [jax.vmap(ft.partial(draw, kind=kind))(keys) for kind in kinds]
        return jax.tree.map(lambda *x: jnp.concatenate(x), *drawn)

    y0, args = of_each_kind(keys)
    path = ds.WeakBrownianPath((2,), jr.key(0))
    terms = terms_for(solver, path, commuting=True)
    terms = whole(terms, solver)

    def exact(h, y0, args):
        kwargs = dict(fn=values_of_a_step)
        # Any solver will do: its steps cancel.
        at = (terms, diffrax.Heun(), 0.1, 0.1 + h, y0, args)
        mean = ds.step_expectation(*at, **kwargs)
        return mean - ds.weak_order_defect(*at, **kwargs, order=order)

    return y0, args, np.asarray(over_steps(exact, _WEAK_STEPS, y0, args))


# The outcomes of Lévy areas cannot be enumerated. Quick tests know the order of tableaus by
# its conditions, and the flows of `NinomiyaVictoir` one by one.
@pytest.mark.slow
@each([s for s in TABLE if "A" not in s.variables])
def test_local_weak_order(solver):
    y0, args, exact = _weak_systems(solver)
    path = solver.path((2,), jr.key(0), want="weak")
    terms = terms_for(solver, path, commuting=True)
    quick = by_picard(solver)

    def mean(h, y0, args):
        # Gaussian variables by quadrature.
        kwargs = dict(fn=values_of_a_step, nodes=4)
        return ds.step_expectation(terms, quick, 0.1, 0.1 + h, y0, args, **kwargs)

    defects = over_steps(mean, _WEAK_STEPS, y0, args, one_after_another) - exact
    for i, kind in enumerate(_kinds(solver.structure)):
        sizes = np.linalg.norm(defects[2 * i : 2 * i + 2], axis=(0, 2))
        order = slope(_WEAK_STEPS, sizes) - 1
        claim = solver.record.order("weak", KINDS[kind])
        assert abs(order - claim) <= 0.1, (kind, order)


_STRONG_STEPS = np.array([16, 32, 64])
# So many that the standard errors of slopes are at most 0.08, for every solver.
_STRONG_PATHS = 240


def squared_errors(solver) -> np.ndarray:
    """Those of states after so many steps, by kind of noise and path, over common paths."""
    system, m = SYSTEMS[solver.structure], 2
    fine = 2**8 if "L" in solver.variables else 2**9
    # The errors that are measured are larger than 1e-6.
    quick = by_picard(solver, 1e-11)
    kinds = _kinds(solver.structure)

    @jax.jit
    def of_each_kind(key):
        drawn = [system.draw(key, 1, m, jnp.float64, kind) for kind in kinds]
        return jax.tree.map(lambda *x: jnp.stack(x), *drawn)

    y0, args = of_each_kind(jr.key(11))

    def end(key, y0, args, steps):
        k_sample, k_more = jr.split(key)
        path = FineSample.draw(k_sample, fine, m)
        if "C" in solver.variables:
            path = ds.PlateauBrownianPath(path, k_more)
        if "A" in solver.variables:
            path = ds.LevyAreaBrownianPath(path, k_more, num_terms=0, cell=1 / fine)
        terms, h = terms_for(solver, path, commuting=True), 1 / steps
        step = lambda i, y: take_step(quick, terms, i * h, (i + 1) * h, y, args)[0]
        return jfu.ravel_pytree(jax.lax.fori_loop(0, steps, step, y0))[0]

    # One batch of all paths and kinds; the number of steps is not known while compiling.
    number = len(kinds)
    repeat = lambda x: jnp.repeat(x, _STRONG_PATHS, axis=0)
    batch = jax.tree.map(repeat, (y0, args))
    keys = jnp.tile(jr.split(jr.key(0), _STRONG_PATHS), number)
    over = jax.jit(jax.vmap(end, (0, 0, 0, None)))
    *coarse, exact = (
        over(keys, *batch, n).reshape(number, _STRONG_PATHS, -1)
        for n in np.array([*_STRONG_STEPS, fine])
    )
    return np.sum((np.stack(coarse) - exact) ** 2, axis=-1)


STRONG = [
    *filter(lambda s: s.record.strong is not None, DEFAULTS),
    ds.SRKs4(0.3, -0.7),
    *(s for s in SPLIT if s.record.strong is not None),
]


# How far slopes of steps that are not yet small lie above the claim, where terms of higher
# order are still seen. For noises of order 1/2 it tells this order from 1. Of
# `SRKs4(0.3, -0.7)`, of order 3/2, 2.0 is measured down to steps of 1 / 128.
_ABOVE = {1 / 2: 0.2, 1: 0.3, 3 / 2: 0.5}


# The order 1 of `StormerVerlet` is measured by `test_compare`, too.
@each(marked(STRONG, ["SRKs4()"]))
def test_strong_order(solver):
    squares = squared_errors(solver)
    means = np.mean(squares, axis=-1, keepdims=True)
    # A slope is a sum over logarithms of errors, and so, to first order, over paths.
    x = -np.log(_STRONG_STEPS)
    weights = (x - x.mean()) / np.sum((x - x.mean()) ** 2) / 2
    orders = np.einsum("i,ik->k", weights, np.log(means[..., 0]))
    parts = np.einsum("i,ikn->kn", weights, squares / means)
    bars = np.std(parts, axis=-1) / np.sqrt(_STRONG_PATHS)
    for kind, order, bar in zip(_kinds(solver.structure), orders, bars):
        claim = solver.record.order("strong", KINDS[kind])
        # With wider bars a slope of 1/2 would pass for the claim 1, of which 0.9 - 3 * 0.1
        # is the least that passes.
        assert bar <= 0.1, (kind, bar)
        low = claim - 0.1 - 3 * bar
        high = claim + _ABOVE[claim] + 3 * bar
        assert low <= order <= high, (kind, order)


@pytest.mark.slow
def test_the_default_sign_of_srks4_has_the_smaller_strong_error():
    gain = squared_errors(ds.SRKs4(sign=1)) - squared_errors(ds.SRKs4())
    bar = np.std(gain, axis=-1) / np.sqrt(_STRONG_PATHS)
    # Of shorter steps both have smaller errors.
    assert np.all(np.mean(gain, axis=-1)[0] > 3 * bar[0])
    assert np.all(np.mean(gain, axis=-1) > 0)


@each([*DEFAULTS, *SPLIT])
def test_own_paths_hold_what_a_step_needs_and_others_are_refused(solver):
    system = SYSTEMS[solver.structure]
    y0, args = system.draw(jr.key(0), 1, 2, jnp.float64)
    # The test of weak orders takes a step along the other path.
    path = solver.path((2,), jr.key(0), want="strong")
    quick = by_picard(solver)
    terms = terms_for(solver, path)
    step = lambda y0: take_step(quick, terms, 0.0, 0.1, y0, args)[0]
    y1 = eqx.filter_eval_shape(step, y0)
    assert [x.shape for x in y1] == [(1,), (1,)]
    assert issubclass(path.levy_area, solver.minimal_levy_area) or (
        solver.variables == ("W",)
    )
    meant = "weak" if solver.record.strong is None else "strong"
    default, asked = (solver.path((2,), jr.key(0), want=w) for w in (None, meant))
    assert eqx.tree_equal(default, asked)
    name = type(solver).__name__
    if solver.structure != "any" and not isinstance(solver, ds.LinearFlow):
        # Systems of another structure are refused.
        system = SYSTEMS["any"]
        other = system.draw(jr.key(0), 1, 2, jnp.float64)
        with pytest.raises(ValueError, match=f"`{name}` needs"):
            solver.init(system.terms(path), 0.0, 0.1, *other)
    # A path with less is refused with advice.
    terms = terms_for(solver, ds.FixedStepBrownianPath((2,), jr.key(0)))
    if solver.variables == ("W",) or has_friction(solver):
        return
    with pytest.raises(ValueError, match=f"`{name}` needs") as info:
        solver.step(terms, 0.0, 0.1, y0, args, None, False)
    assert "by `solver.path(shape, key)`." in str(info.value)
    needed = most_demanding_variable(solver.variables)
    assert needed.name in str(info.value) or name == "NinomiyaVictoir"


def test_bad_shapes_keys_and_wants_are_refused():
    for shape, key, want, says in (
        ((2,), jr.key(0), "moments", "`want` must be"),
        ((2,), 3, "weak", "key"),
        (3, jr.key(0), "weak", "`shape`"),
    ):
        with pytest.raises(ValueError, match=says):
            ds.ImplicitMidpoint().path(shape, key, want=want)


def test_solvers_say_what_they_need():
    assert ds.ImplicitMidpoint().minimal_levy_area is diffrax.AbstractBrownianIncrement
    for kinds, increment in (
        ((ds.SRKs4, ds.PlateauGauss), diffrax.AbstractSpaceTimeLevyArea),
        ((ds.SRKw5, ds.AdditiveGauss, ds.NinomiyaVictoir), ds.WeakIncrement),
        ((ds.PlateauVerlet,), ds.PlateauIncrement),
        ((ds.LevyAreaMidpoint,), ds.LevyAreaIncrement),
    ):
        for kind in kinds:
            assert kind().minimal_levy_area is increment
    for solver in DEFAULTS:
        if hasattr(solver, "tableau"):
            is_implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
            assert is_implicit == (len(solver.stage_vectors(5)) > 0)
            # The unknown vectors of each system of equations.
            blocks = make_plan(solver.tableau.flatten()).blocks
            sizes = (sum(map(len, block.unknown)) for block in blocks)
            assert solver.stage_vectors(5) == tuple(n for n in sizes if n)
    for solver in TABLE:
        for m in (1, 2):
            terms = terms_for(solver, solver.path((m,), jr.key(0)))
            # A solver does not know whether several noises commute.
            assert solver.weak_order(terms) == solver.record.order("weak", m == 1)


def test_solvers_print_in_a_line():
    assert repr(ds.ImplicitMidpoint()) == "ImplicitMidpoint()"
    assert repr(ds.SRKw1(b=0.2)) == "SRKw1(b=0.2)"
    own = ds.SRKs1(root_finder=ds.PicardNewton(rtol=1e-3), root_find_max_steps=5)
    assert repr(own).startswith("SRKs1(root_finder=PicardNewton(rtol=0.001")
