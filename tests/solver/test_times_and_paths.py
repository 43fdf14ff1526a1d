"""Steps that cannot be taken at their times: numbers do not resolve them, or a path does
not cover them; and paths that hold given noise."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._solver import LANGEVIN

from ..families import slow_except
from ..picard import by_picard


TOO_SHORT = diffrax.RESULTS.dt_min_reached
SOLVERS = [
    ds.StormerVerlet(),
    ds.ImplicitMidpoint(),
    ds.NinomiyaVictoir(),
    ds.BAOAB(ds.StormerVerlet()),
    *(kind() for kind in LANGEVIN),
]
# Of the places where times are checked, two: separable steps and steps with friction.
each = pytest.mark.parametrize(
    "solver", slow_except([SOLVERS[0], SOLVERS[4]], SOLVERS), ids=repr
)


def _oscillator(path, solver=None):
    H0 = lambda t, p, q, args: p**2 / 2 + q**2 / 2
    if isinstance(solver, LANGEVIN):
        return ds.langevin_terms(H0, 0.1, 0.05, path)
    return ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.1 * q, path)


def _solve(solver, path, t0, t1, dt0, dtype=jnp.float64, **options):
    y0 = jnp.zeros((), dtype), jnp.ones((), dtype)
    times = [jnp.asarray(t, dtype) for t in (t0, t1, dt0)]
    options = dict(max_steps=None, adjoint=diffrax.ForwardMode()) | options
    return diffrax.diffeqsolve(_oscillator(path, solver), solver, *times, y0, **options)


def _single(solver):
    return solver.path(jax.ShapeDtypeStruct((), jnp.float32), jr.key(0))


@each
def test_steps_that_single_precision_does_not_resolve_fail(solver):
    # At 58,000 a solve of a hundred steps had 62, and at a million nearly all had length 0.
    # 100 roundings are 100 eps t: steps of 0.01 are too short beyond 839, and those that
    # are rounded down a little before. A flow takes half steps.
    path = _single(solver)
    end = 420 if getattr(solver, "has_flow", False) else 839

    @jax.jit
    @jax.vmap
    def run(t0, t1, dt0):
        sol = _solve(solver, path, t0, t1, dt0, jnp.float32, throw=False)
        success = sol.result == diffrax.RESULTS.successful
        return success, sol.result == TOO_SHORT, sol.stats["num_steps"]

    cases = [
        (1e6, 1e6 + 100, 0.01),
        (58e3, 58001, 0.01),
        (-1e4, -9999, 1e-2),
        (end - 19.0, end + 100.0, 0.01),
        (58e3, 58000, -0.01),
        (end - 19.0, end - 10.0, 0.01),
    ]
    success, too_short, num_steps = run(*jnp.array(cases, jnp.float32).T)
    np.testing.assert_array_equal(too_short, [True] * 4 + [False] * 2)
    np.testing.assert_array_equal(success, ~too_short)
    np.testing.assert_array_equal(num_steps[:3], 1)
    assert end - 9 < end - 19 + num_steps[3] * 0.01 < end


def test_too_short_steps_raise_the_message_of_the_faq_and_double_precision_resolves_them():
    solver = ds.StormerVerlet()
    solve = lambda path, dtype: _solve(solver, path, 1e6, 1e6 + 0.1, 0.01, dtype)
    with pytest.raises(eqx.EquinoxRuntimeError, match="minimum step size was reached"):
        solve(_single(solver), jnp.float32)
    path = solver.path((), jr.key(0))
    assert solve(path, jnp.float64).stats["num_steps"] == 10


class Recorded(diffrax.AbstractBrownianPath):
    """Noise that was measured, at equal times."""

    W: jax.Array
    t0: float = 0.0
    t1: float = 1.0
    levy_area: type = eqx.field(static=True, default=diffrax.BrownianIncrement)

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        at = lambda t: jnp.interp(
            t, jnp.linspace(self.t0, self.t1, len(self.W)), self.W
        )
        W = at(t1) - at(t0)
        return diffrax.BrownianIncrement(dt=t1 - t0, W=W) if use_levy else W


RECORD = Recorded(jnp.cumsum(0.3 * jr.normal(jr.key(0), (11,))))


# A record has increments alone.
@pytest.mark.parametrize(
    "solver",
    slow_except(
        [SOLVERS[0], SOLVERS[4]], [x for x in SOLVERS if x.variables == ("W",)]
    ),
    ids=repr,
)
def test_beyond_the_end_of_recorded_noise_there_is_an_error(solver):
    @eqx.filter_jit
    def run(t0, t1):
        sol = _solve(solver, RECORD, t0, t1, (t1 - t0) / 10, throw=False)
        return sol.ys, sol.result == diffrax.RESULTS.successful

    for t0, t1 in ((0.0, 1.0), (1.0, 0.0)):
        ys, success = run(jnp.array(t0), jnp.array(t1))
        assert success and np.all(np.isfinite(ys))
    for t0, t1 in ((0.0, 1.1), (-0.1, 0.9), (1.0, -0.1)):
        with pytest.raises(eqx.EquinoxRuntimeError, match="pass a longer path"):
            jax.block_until_ready(run(jnp.array(t0), jnp.array(t1)))


def test_recorded_noise_leads_to_solvers_that_need_only_increments():
    at = _oscillator(RECORD), 0.0, 0.1, (jnp.zeros(()), jnp.ones(())), None, None, False
    for solver, missing in (
        (ds.PlateauVerlet(), "plateaus"),
        (ds.PlateauGauss(), "Lévy"),
    ):
        says = f"needs .*{missing}.*but `Recorded` has no random key.* `StormerVerlet`"
        with pytest.raises(ValueError, match=says):
            solver.step(*at)


def test_suggestions_keep_recorded_noise():
    y0 = jnp.zeros(()), jnp.ones(())
    for want in ("strong", "weak"):
        found = ds.suggest_solver(_oscillator(RECORD), 0.0, y0, want=want)
        # It has no Lévy areas.
        assert {s.solver.variables for s in found} == {("W",)}
        for s in found:
            assert "given noise" in s.path
            terms = s.terms(jr.key(1))
            assert eqx.tree_equal(terms.terms[1].path, RECORD)
    # Beside random noise, which is made anew.
    random = ds.WeakBrownianPath((), jr.key(0))
    both = diffrax.MultiTerm(*_oscillator(RECORD).terms, _oscillator(random).terms[1])
    best = ds.suggest_solver(both, 0.0, y0, want="weak")[0]
    assert best.path == 'ds.StormerVerlet().path((), key, want="weak")'
    *_, kept, new = best.terms(jr.key(1)).terms
    assert eqx.tree_equal(kept.path, RECORD) and new.path.key == jr.key(1)
    # Keys of both kinds are seen.
    for key in (jr.key(0), jr.PRNGKey(0)):
        tree = diffrax.VirtualBrownianTree(0.0, 1.0, 1e-3, (), key)
        best = ds.suggest_solver(_oscillator(tree), 0.0, y0, want="weak")[0]
        assert isinstance(best.terms(jr.key(1)).terms[1].path, ds.WeakBrownianPath)


def test_suggestions_tell_of_a_path_of_diffrax_that_repeats_its_noise():
    y0 = jnp.zeros(()), jnp.ones(())
    unsafe = diffrax.UnsafeBrownianPath((), jr.key(0))
    ours = ds.FixedStepBrownianPath((), jr.key(0))
    said = lambda path: ds.suggest_solver(_oscillator(path), 0, y0, want="weak").system
    assert "repeats its noise" in said(unsafe)
    assert "repeats" not in said(ours)
    # If Diffrax has mended it, take out this sentence, and the ones in FAQ and docstrings.
    t = 4096 + 1e-4 * jnp.arange(10_001)
    draw = lambda path: jax.vmap(path.evaluate)(t[:-1], t[1:]) / jnp.sqrt(jnp.diff(t))
    distinct = lambda path: len(np.unique(np.round(draw(path), 9)))
    assert distinct(unsafe) < 5_000 and distinct(ours) == 10_000


def test_noises_that_do_not_fit_their_control_term_are_refused():
    single, y0 = jax.ShapeDtypeStruct((2,), jnp.float32), jnp.ones(2)
    kick = lx.FunctionLinearOperator(lambda w: 0.1 * w, jnp.ones(2))
    says = r"vector field, .*{} f64\[2.*increments of its path, f{}\. Construct"
    for solver, matrix, takes in (
        (by_picard(ds.ImplicitMidpoint()), kick, "operator on"),
        (by_picard(ds.NinomiyaVictoir()), 0.1 * jnp.eye(2), "array"),
    ):

        def terms(shape, matrix=matrix):
            path = ds.WeakBrownianPath(shape, jr.key(0), two_point=True)
            drift = diffrax.ODETerm(lambda t, y, args: -y)
            diffusion = diffrax.ControlTerm(lambda t, y, args: matrix, path)
            return diffrax.MultiTerm(drift, diffusion)

        def solve(shape, y0, solver=solver, terms=terms):
            at = terms(shape), 0.0, 0.5, y0, None
            return solver.step(*at, solver.init(*at), False)[0]

        with pytest.raises(ValueError, match=says.format(takes, r"64\[3\]")):
            solve((3,), y0)
        with pytest.raises(ValueError, match=says.format(takes, r"64\[3\]")):
            ds.suggest_solver(terms((3,)), 0, y0, want="weak")
        with pytest.raises(ValueError, match="state|The terms change an array"):
            solve((2,), jnp.ones(3))
        if matrix is kick:
            with pytest.raises(ValueError, match=says.format(takes, r"32\[2\]")):
                solve(single, y0)
        else:
            # Diffrax multiplies arrays of different precision.
            np.testing.assert_allclose(solve(single, y0), solve((2,), y0), rtol=1e-6)
