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
from diffrax_symplectic._brownian import VARIABLES
from diffrax_symplectic._plan import make_plan
from diffrax_symplectic._suggest import SOLVERS

from .problems import FineSample, Given, slope, SYSTEMS, values_of_a_step


_GAUSS = 1 / 4 + np.sqrt(3) / 6
# Members of families that differ in what they do, beside the defaults.
MEMBERS = [
    ds.SRKw1(b=0.2),
    ds.SRKw2((1, 2, 3, 4)),
    *(ds.SRKw3(variant) for variant in "abdef"),
    ds.SRKw4(a21=_GAUSS),
    ds.SRKs3(a=0.25),
    ds.SRKs4(sign=1),
    ds.SRKs4(beta1=0.3, beta2=-0.7, b=0.4),
]
DEFAULTS = [solver() for solver in SOLVERS]
TABLE = [*DEFAULTS, *MEMBERS]
# Those whose step is another program. The others negate the increment, or are of the same
# blocks with other numbers.
STEPS = [
    *DEFAULTS,
    ds.SRKw1(b=0.2),
    ds.SRKw3("a"),
    ds.SRKs3(a=0.25),
    ds.SRKw4(a21=_GAUSS),
]
each = lambda solvers: pytest.mark.parametrize("solver", solvers, ids=repr)

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

    return jax.jit(draw)(jr.split(jr.key(0), N))


@ft.cache
def program(solver, dtype):
    """Ends of the steps, their derivatives by state and sizes, and which succeeded."""
    del dtype  # Programs are kept apart.
    system = SYSTEMS[solver.structure]

    @jax.jit
    @jax.vmap
    def step(x: Batch):
        flat, unravel = jfu.ravel_pytree((x.y0, x.sizes))

        def end(flat):
            y0, sizes = unravel(flat)
            terms = system.terms(Given(**x.variables), sizes)
            zero = jnp.zeros_like(x.h)
            y1, *_, result = solver.step(terms, zero, x.h, y0, x.args, None, False)
            y1, _ = jfu.ravel_pytree(y1)
            return y1, (y1, result == diffrax.RESULTS.successful)

        jacobian, (y1, success) = jax.jacrev(end, has_aux=True)(flat)
        return y1, jacobian, success

    return step


@pytest.mark.core
@pytest.mark.parametrize(
    "solver, dtype, bound",
    [(solver, jnp.float64, 1e-13) for solver in STEPS]
    + [(solver, jnp.float32, 5e-6) for solver in DEFAULTS],
    ids=repr,
)
def test_steps_of_a_thousand_random_systems_are_symplectic(solver, dtype, bound):
    y1, jacobian, success = program(solver, dtype)(batch(solver.structure, dtype))
    assert y1.dtype == jacobian.dtype == dtype
    assert np.all(success)
    J = np.asarray(jacobian[:, :, : 2 * D])
    zero, one = np.zeros((D, D)), np.eye(D)
    omega = np.block([[zero, one], [-one, zero]]).astype(dtype)
    defects = np.swapaxes(J, 1, 2) @ omega @ J - omega
    assert np.max(np.abs(defects)) <= bound


def _some(x: Batch, number: int) -> Batch:
    """The first so many systems, again and again: of the size of the whole batch."""
    return jax.tree.map(lambda leaf: leaf[jnp.arange(N) % number], x)


@each(STEPS)
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
    y1, jacobian, success = program(solver, jnp.float64)(x)
    assert np.all(success)
    plus, minus = y1[: 40 * n], y1[40 * (n + 1) : 40 * (2 * n + 1)]
    differences = ((plus - minus) / 2e-5).reshape(n, 40, 2 * D)
    exact = jacobian[40 * n : 40 * (n + 1)]
    np.testing.assert_allclose(np.moveaxis(differences, 0, 2), exact, atol=1e-8)


@each(STEPS)
def test_failures_are_reported_and_leave_others_as_they_are(solver):
    x = batch(solver.structure, jnp.float64)
    sizes = np.ones((N, 2))
    sizes[7, 0], sizes[9, 1] = np.nan, np.nan
    broken = eqx.tree_at(lambda x: x.sizes, x, jnp.asarray(sizes))
    step = program(solver, jnp.float64)
    fine, others = step(x), step(broken)
    whole = np.all(np.isfinite(sizes), axis=1)
    np.testing.assert_array_equal(others[2], whole)
    for a, b in zip(fine[:2], others[:2]):
        np.testing.assert_allclose(a[whole], b[whole], rtol=1e-12, atol=1e-13)


@ft.cache
def _flows(structure: str) -> jax.Array:
    """Exact flows of the drift over 0.1 and over 0.05."""
    x = batch(structure, jnp.float64)

    @jax.jit
    @jax.vmap
    def flow(y0, args, h):
        drift, _ = SYSTEMS[structure].terms(Given(jnp.zeros(M)), jnp.ones(2)).terms
        kwargs = dict(max_steps=None, adjoint=diffrax.ForwardMode())
        sol = diffrax.diffeqsolve(
            drift, diffrax.Dopri8(), 0.0, h, h / 20, y0, args, **kwargs
        )
        return jfu.ravel_pytree(sol.ys)[0]

    some = jax.tree.map(lambda leaf: leaf[:50], (x.y0, x.args))
    return jnp.stack([flow(*some, jnp.full(50, h)) for h in (0.1, 0.05)])


@each(STEPS)
def test_the_order_without_noise_is_that_of_the_coefficients(solver):
    x = _some(batch(solver.structure, jnp.float64), 50)
    sizes = jnp.ones((N, 2)).at[:, 1].set(0)
    h = jnp.repeat(jnp.array([0.1, 0.05, 0.001]), np.array([50, 50, N - 100]))
    x = eqx.tree_at(lambda x: (x.sizes, x.h), x, (sizes, h))
    y1, _, _ = program(solver, jnp.float64)(x)
    ends = jnp.stack([y1[:50], y1[50:100]])
    errors = np.linalg.norm(ends - _flows(solver.structure), axis=(1, 2))
    order = slope(np.array([0.1, 0.05]), errors) - 1
    assert abs(order - solver.order(None)) <= 0.2


# Kinds of noises, and whether they commute.
KINDS = {"one": True, "commuting": True, "others": False}
_WEAK_STEPS = jnp.array([0.01, 0.005, 0.0025])


def _kinds(structure: str) -> dict[str, bool]:
    return KINDS if structure == "any" else {"one": True, "commuting": True}


@ft.cache
def _weak_systems(structure: str):
    """Two systems of each kind, with two noises; and the means of exact steps, but for
    terms beyond the third or fourth order of the step."""
    order = 3 if structure == "constant" else 2
    system = SYSTEMS[structure]
    draw = lambda kind, key: system.draw(key, 1, 2, jnp.float64, kind, strength=2.0)
    keys = jr.split(jr.key(4), 2)
    drawn = [jax.vmap(ft.partial(draw, kind))(keys) for kind in _kinds(structure)]
    y0, args = jax.tree.map(lambda *x: jnp.concatenate(x), *drawn)
    terms = system.terms(ds.WeakBrownianPath((2,), jr.key(0)), commuting=True)
    solver = ds.ImplicitMidpoint()

    def exact(h, y0, args):
        kwargs = dict(fn=values_of_a_step)
        at = (terms, solver, 0.1, 0.1 + h, y0, args)
        mean = ds.step_expectation(*at, **kwargs)
        return mean - ds.weak_order_defect(*at, **kwargs, order=order)

    over = jax.vmap(jax.vmap(exact, (0, None, None)), (None, 0, 0))
    return y0, args, jax.jit(over)(_WEAK_STEPS, y0, args)


# The outcomes of Lévy areas cannot be enumerated.
@each([solver for solver in TABLE if "A" not in solver.variables])
def test_local_weak_order(solver):
    y0, args, exact = _weak_systems(solver.structure)
    path = solver.path((2,), jr.key(0), want="expectations")
    terms = SYSTEMS[solver.structure].terms(path, commuting=True)

    def mean(h, y0, args):
        # Gaussian variables by quadrature.
        kwargs = dict(fn=values_of_a_step, nodes=4)
        return ds.step_expectation(terms, solver, 0.1, 0.1 + h, y0, args, **kwargs)

    over = jax.vmap(jax.vmap(mean, (0, None, None)), (None, 0, 0))
    defects = np.asarray(jax.jit(over)(_WEAK_STEPS, y0, args) - exact)
    for i, (kind, commute) in enumerate(_kinds(solver.structure).items()):
        sizes = np.linalg.norm(defects[2 * i : 2 * i + 2], axis=(0, 2))
        order = slope(_WEAK_STEPS, sizes) - 1
        claim = solver.record.weak_order(commute)
        # Where a lower order is claimed for noises that do not commute, it is seen.
        lower = not commute and isinstance(solver.record.weak, tuple)
        least, most = (0.3, 0.5) if lower else (0.25, 0.25)
        assert claim - least <= order <= claim + most, (kind, order)
        if kind != "one":
            # A solver does not know whether noises commute.
            assert solver.weak_order(terms) == solver.record.weak_order(False)
    one = SYSTEMS[solver.structure].terms(solver.path((1,), jr.key(0)))
    assert solver.weak_order(one) == solver.record.weak_order(True)


_STRONG_STEPS = np.array([16, 32, 64])


@each([*filter(lambda s: s.record.strong is not None, DEFAULTS), ds.SRKs4(0.3, -0.7)])
def test_strong_order(solver):
    system, m, fine = (
        SYSTEMS[solver.structure],
        2,
        2**8 if "L" in solver.variables else 2**9,
    )
    draw = lambda kind: system.draw(jr.key(11), 1, m, jnp.float64, kind)
    drawn = [draw(kind) for kind in _kinds(solver.structure)]
    y0, args = jax.tree.map(lambda *x: jnp.stack(x), *drawn)

    def end(key, y0, args, steps):
        k_sample, k_more = jr.split(key)
        path = FineSample.draw(k_sample, fine, m)
        if "C" in solver.variables:
            path = ds.PlateauBrownianPath(path, k_more)
        if "A" in solver.variables:
            path = ds.LevyAreaBrownianPath(path, k_more, terms=0, cell=1 / fine)
        terms, h = system.terms(path, commuting=True), 1 / steps

        def step(i, y):
            return solver.step(terms, i * h, (i + 1) * h, y, args, None, False)[0]

        return jfu.ravel_pytree(jax.lax.fori_loop(0, steps, step, y0))[0]

    over = jax.vmap(end, (0, None, None, None))
    over = jax.jit(jax.vmap(over, (None, 0, 0, None)))
    keys = jr.split(jr.key(0), 60)
    *coarse, exact = (over(keys, y0, args, n) for n in (*_STRONG_STEPS, fine))
    squares = np.sum((np.stack(coarse) - exact) ** 2, axis=-1)
    errors = np.sqrt(np.mean(squares, axis=-1)).T
    for (kind, commute), error in zip(_kinds(solver.structure).items(), errors):
        order, claim = (
            slope(1 / _STRONG_STEPS, error),
            solver.record.strong_order(commute),
        )
        # Where a lower order is claimed for noises that do not commute, it is seen.
        most = 0.4 if not commute and isinstance(solver.record.strong, tuple) else 0.6
        assert claim - 0.15 <= order <= claim + most, (kind, order)


@each(TABLE)
def test_coefficients_are_symplectic_and_of_the_claimed_order(solver):
    if isinstance(solver, ds.NinomiyaVictoir):
        return
    tableau, record = solver.tableau, solver.record
    worst = [np.max(np.abs(ds.symplectic_residuals(tableau)))]
    order = min(record.weak_order(True), 2)
    worst += map(abs, ds.weak_order_residuals(tableau, order).values())
    if record.strong is not None:
        worst += map(abs, ds.strong_order_residuals(tableau).values())
    assert max(worst) <= 1e-14
    assert solver.stage_vectors(5) == tuple(
        n
        for block in make_plan(tableau.flatten()).blocks
        if (n := sum(len(group) for group in block.unknown))
    )


@each(TABLE)
def test_own_paths_hold_what_a_step_needs(solver):
    system = SYSTEMS[solver.structure]
    y0, args = system.draw(jr.key(0), 1, 2, jnp.float64)
    for want in ("paths", "expectations", None):
        path = solver.path((2,), jr.key(0), want=want)
        terms = system.terms(path)
        solver.init(terms, 0.0, 0.1, y0, args)
        step = lambda y0, terms=terms: solver.step(
            terms, 0.0, 0.1, y0, args, None, False
        )
        assert jax.tree.map(jnp.shape, eqx.filter_eval_shape(step, y0)[0]) == (
            (1,),
            (1,),
        )
        area = issubclass(path.levy_area, solver.minimal_levy_area)
        assert area or solver.variables == ("W",)


@each(DEFAULTS)
def test_a_path_without_what_a_step_needs_is_refused_with_advice(solver):
    if solver.variables == ("W",):
        return
    y0, args = SYSTEMS[solver.structure].draw(jr.key(0), 1, 2, jnp.float64)
    plain = ds.FixedStepBrownianPath((2,), jr.key(0))
    terms = SYSTEMS[solver.structure].terms(plain)
    name = type(solver).__name__
    held = [v for v in VARIABLES if v in solver.variables]
    with pytest.raises(ValueError, match=f"`{name}` needs") as info:
        solver.step(terms, 0.0, 0.1, y0, args, None, False)
    assert "Pass `solver.path(shape, key)`, or `" in str(info.value)
    assert VARIABLES[held[0]].name in str(info.value) or name == "NinomiyaVictoir"


@each([s for s in DEFAULTS if s.structure != "any"])
def test_systems_of_another_structure_are_refused(solver):
    y0, args = SYSTEMS["any"].draw(jr.key(0), 1, 2, jnp.float64)
    terms = SYSTEMS["any"].terms(ds.WeakBrownianPath((2,), jr.key(0)))
    with pytest.raises(ValueError, match=f"`{type(solver).__name__}` needs"):
        solver.init(terms, 0.0, 0.1, y0, args)


def test_bad_shapes_keys_and_wants_are_refused():
    path = ds.ImplicitMidpoint().path
    with pytest.raises(ValueError, match="`want` must be"):
        path((2,), jr.key(0), want="moments")  # pyright: ignore
    with pytest.raises(ValueError, match="key"):
        path((2,), 3)  # pyright: ignore
    with pytest.raises(ValueError, match="`shape`"):
        path(3, jr.key(0))  # pyright: ignore


def test_solvers_print_in_a_line():
    assert repr(ds.ImplicitMidpoint()) == "ImplicitMidpoint()"
    assert repr(ds.SRKw1(b=0.2)) == "SRKw1(b=0.2)"
    own = ds.SRKs1(root_finder=ds.PicardNewton(rtol=1e-3), root_find_max_steps=5)
    assert repr(own).startswith("SRKs1(root_finder=PicardNewton(rtol=0.001")
