"""Gradients by walking back along the solution, and adjoints that are refused."""

import re

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from diffrax._term import WrapTerm

import diffrax_symplectic as ds
from diffrax_symplectic._adjoint import (
    _meet_checkpoint,
    _steps_without_inverse,
    _undoes_its_steps,
)
from diffrax_symplectic._solver import LANGEVIN, SOLVERS
from diffrax_symplectic._tableau import FlatTableau, is_own_inverse, Stage

from .problems import as_friction, damped_terms, Given, SYSTEMS
from .solver.test_every_solver import area_factor, OBABO, take_step, terms_for


REVERSIBLE = [
    solver
    for solver in (*(kind() for kind in (*SOLVERS, *LANGEVIN)), OBABO)
    if solver.undoes_its_steps
]


@pytest.mark.slow
@pytest.mark.parametrize("solver", REVERSIBLE, ids=repr)
def test_solvers_taken_for_their_own_inverse_undo_their_steps(solver):
    y0, args = SYSTEMS[solver.structure].draw(jr.key(0), 2, 2, float)
    W, A = jnp.array([0.3, -0.2]), jnp.array([[0, 0.05], [-0.05, 0]])
    # Of these `H` does not change its sign backward in time.
    given = Given(W, second=W[::-1], two_point=0.1 * jnp.sign(W), H=W[::-1] / 3, A=A)
    terms = terms_for(solver, given).terms

    @jax.jit
    def step(t0, t1, direction, y):
        wrapped = diffrax.MultiTerm(*[WrapTerm(x, direction) for x in terms])
        return take_step(solver, wrapped, t0, t1, y, args)[0]

    there = step(0.4, 0.5, 1, y0)
    back = step(-0.5, -0.4, -1, there)
    assert np.abs(np.subtract(there, y0)).max() > 1e-2
    np.testing.assert_allclose(back, y0, atol=1e-14)


def test_solvers_that_the_docstring_names_undo_all_but_the_steps_of_the_message():
    text = " ".join((ds.ReversingAdjoint.__doc__ or "").split())
    found = set(re.findall(r"diffrax_symplectic\.(\w+)", text))
    named = {kind.__name__ for kind in (*SOLVERS, *LANGEVIN)} & found
    assert len(named) > 5
    assert named <= {type(solver).__name__ for solver in REVERSIBLE}
    assert (
        "BAOAB`][] by $|(1 + x) / (1 - x)|$ in each step, $x = \\gamma h / 2$" in text
    )
    # And the message names the steps that shrink areas to zero.
    for solver in REVERSIBLE:
        if isinstance(solver, LANGEVIN):
            rate_times_step = solver.friction_without_inverse
            assert area_factor(solver, rate_times_step) == 0
            name = type(solver).__name__
            said = f"`{name}` with rate of friction times step equal to {rate_times_step:g}"
            assert said in _steps_without_inverse()


def test_solvers_that_do_not_undo_their_steps_are_refused():
    refused = (
        *[ds.SRKw2(), ds.SRKs3(), ds.SRKs4(), ds.SRKw3(), ds.SRKw4(), ds.SRKw5()],
        *[ds.PlateauVerlet(), ds.AdditiveGauss(), diffrax.Heun()],
        *[diffrax.HalfSolver(ds.StormerVerlet()), diffrax.HalfSolver(ds.BAOAB())],
        ds.BAOAB(ds.SRKs3()),
    )
    assert not any(map(_undoes_its_steps, refused))


def test_own_inverses_mirror_the_times_of_stages_and_read_no_areas_of_time():
    def midpoint(c, channels=("h", "W")):
        stages = (Stage(channels, c, "y", "y"),)
        return FlatTableau(stages, np.array([[0.5]]), np.array([1.0]))

    assert is_own_inverse(midpoint(0.5))
    assert not is_own_inverse(midpoint(0.3))
    # A space-time area keeps its sign backward in time.
    assert not is_own_inverse(midpoint(0.5, ("h", "H")))

    def two_kicks(*weights):
        stages = tuple(Stage(("h",), c, "q", "p") for c in (0.25, 0.75))
        return FlatTableau(stages, np.zeros((2, 2)), np.array(weights))

    assert is_own_inverse(two_kicks(0.5, 0.5))
    assert not is_own_inverse(two_kicks(0.3, 0.7))

    def additive_midpoint(c):
        stages = Stage(("h",), 0.5, "y", "y"), Stage(("W",), c, "", "y")
        return FlatTableau(stages, np.array([[0.5, 0.5], [0, 0]]), np.ones(2))

    # Noise that does not depend on the state has to be read at the middle of the step.
    assert is_own_inverse(additive_midpoint(0.5))
    assert not is_own_inverse(additive_midpoint(0.0))


class Spring(eqx.Module):
    stiffness: jax.Array

    def __call__(self, t, p, q, args):
        return jnp.sum(p**2) / 2 + jnp.sum(self.stiffness * (1 - jnp.cos(q - t)))


def kicks(t, p, q, args):
    return args * jnp.sum(jnp.sin(q))


def phase(t, p, q, args):
    return args * jnp.sum(p * jnp.sin(q))


SAVED = jnp.array([0.0, 0.07, 0.2, 0.21, 0.22, 0.9, 1.03])
STEPS_IN_SINGLE = jnp.array([0.0, 1.03, 0.1], jnp.float32)
TO = jnp.array([0.0, 0.1, 0.4, 0.5, 0.9, 1.0, 1.03])


# Solver, noise, times of the solve, saved times, and precision. The steps are not all of
# one length.
CASES = {
    # Here, the first steps lie before the first saved time.
    "backward by given steps": (
        *(ds.StormerVerlet(), kicks),
        dict(t0=1.03, t1=0.0, dt0=None, stepsize_controller=diffrax.StepTo(TO[::-1])),
        *(SAVED[4::-1], jnp.float64),
    ),
    "implicit": (
        *(ds.ImplicitMidpoint(), phase, dict(t0=0.0, t1=1.03, dt0=0.1)),
        *(SAVED, jnp.float64),
    ),
    "with friction": (
        *(ds.BAOAB(ds.StormerVerlet()), kicks, dict(t0=0.0, t1=1.03, dt0=0.1)),
        *(SAVED, jnp.float64),
    ),
    "in single precision": (
        *(ds.StormerVerlet(), kicks, dict(zip(["t0", "t1", "dt0"], STEPS_IN_SINGLE))),
        *(SAVED.astype(jnp.float32), jnp.float32),
    ),
}


@pytest.mark.parametrize(
    "name",
    [
        "backward by given steps",
        pytest.param("implicit", marks=pytest.mark.slow),
        pytest.param("with friction", marks=pytest.mark.slow),
        pytest.param("in single precision", marks=[pytest.mark.slow, pytest.mark.core]),
    ],
)
def test_gradients_are_those_of_forward_mode(name):
    """With respect to a Module of the terms, `args` and the initial state."""
    solver, noise, times, saved, dtype = CASES[name]
    y0 = jnp.array([0.3, -0.2], dtype), jnp.array([0.1, 0.7], dtype)
    stiffness, args = jnp.array([1.0, 1.5], dtype), jnp.array(0.4, dtype)
    path = ds.WeakBrownianPath(jax.ShapeDtypeStruct((), dtype), jr.key(0))

    def loss(x, adjoint):
        stiffness, args, y0 = x
        terms = ds.hamiltonian_terms(Spring(stiffness), noise, path)
        if isinstance(solver, LANGEVIN):
            # Of the rates, too.
            rates = as_friction(jnp.diag(stiffness))
            terms = damped_terms(Spring(stiffness), rates, noise, path)
        p, q = diffrax.diffeqsolve(
            terms, solver, **times, y0=y0, args=args, adjoint=adjoint,
            saveat=diffrax.SaveAt(ts=saved),
        ).ys  # fmt: skip
        weights = jnp.arange(1.0, p.size + 1, dtype=dtype).reshape(p.shape)
        return jnp.sum(weights * (p**2 + 2 * q**2))

    @jax.jit
    def both(x):
        ours = jax.grad(loss)(x, ds.ReversingAdjoint(checkpoints=3))
        return ours, jax.jacfwd(loss)(x, diffrax.ForwardMode())

    got, expected = map(jax.tree.leaves, both((stiffness, args, y0)))
    assert min(np.abs(x).min() for x in expected) > 1e-3
    for a, b in zip(got, expected, strict=True):
        assert a.dtype == dtype
        np.testing.assert_allclose(a, b, rtol=1e-12 if dtype == jnp.float64 else 1e-5)


def test_memory_does_not_grow_with_steps():
    # One program for any number of steps, of which no bound has to be known.
    def end(args, y0, t1):
        path = ds.WeakBrownianPath((), jr.key(0))
        energy = lambda t, p, q, args: p @ p / 2 + jnp.sum(jnp.cos(q + t))
        terms = ds.hamiltonian_terms(energy, lambda t, p, q, args: args * q[0], path)
        adjoint = ds.ReversingAdjoint(checkpoints=8)
        sol = diffrax.diffeqsolve(
            terms, ds.StormerVerlet(), 0.0, t1, 0.01, y0, args, adjoint=adjoint,
            max_steps=None,
        )  # fmt: skip
        return jnp.sum(sol.ys[1] ** 2)

    d = 100
    args, y0 = jnp.array(0.1), (jnp.zeros(d), jnp.linspace(2.0, 4.0, d))
    compiled = jax.jit(jax.value_and_grad(end)).lower(args, y0, 1.0).compile()
    state = 2 * d * 8
    assert compiled.memory_analysis().temp_size_in_bytes <= (8 + 16) * state
    # 1,000 steps of it are no more than rounding off from a difference quotient.
    e, t1 = 1e-6, 10.0
    above, below = (compiled(args + x, y0, t1)[0] for x in (e, -e))
    change = (above - below) / (2 * e)
    np.testing.assert_allclose(compiled(args, y0, t1)[1], change, rtol=1e-5)


@pytest.mark.slow
def test_a_way_back_that_is_lost_is_reported_for_that_path_alone():
    # Away from an unstable equilibrium, rounding errors grow by exp(2 t rate) on the walk.
    def end(q0, rate, checkpoints, throw):
        hill = lambda t, p, q, args: p**2 / 2 - (args * q) ** 2 / 2
        path = ds.WeakBrownianPath((), jr.key(0))
        terms = ds.hamiltonian_terms(hill, lambda t, p, q, args: 0.1 * q, path)
        adjoint = ds.ReversingAdjoint(checkpoints=checkpoints)
        return diffrax.diffeqsolve(
            terms, ds.StormerVerlet(), 0.0, 10.0, 0.05, (0.0 * q0, q0), rate,
            adjoint=adjoint, throw=throw,
        ).ys[1][-1]  # fmt: skip

    gradient = lambda checkpoints, throw: jax.jit(
        jax.vmap(jax.grad(end), in_axes=(None, 0, None, None)), static_argnums=(2, 3)
    )(jnp.array(1.0), jnp.array([0.1, 3.0]), checkpoints, throw)
    lost = gradient(1, False)
    found = gradient(20, True)
    assert np.isnan(lost[1]) and np.all(np.isfinite(found))
    np.testing.assert_allclose(lost[0], found[0], rtol=1e-12)
    with pytest.raises(Exception, match="could not reconstruct the solution"):
        jax.block_until_ready(gradient(1, True))


@pytest.mark.slow
def test_the_way_back_leads_to_rest():
    # Three-point increments are zero in two steps of three: several first steps may rest.
    path = ds.WeakBrownianPath((1,), jr.key(0))
    H0 = lambda t, p, q, args: jnp.sum(p**2) / 2 + 1 - jnp.sum(jnp.cos(q))
    terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: args * q, path)

    @jax.jit
    def gradients(y0):
        def end(args, key, adjoint):
            new = eqx.tree_at(lambda x: x.terms[1].path.key, terms, key)
            sol = diffrax.diffeqsolve(
                new, ds.StormerVerlet(), 0.0, 20.0, 0.01, y0, args, adjoint=adjoint
            )
            return jnp.sum(sol.ys[1][-1] ** 2)

        adjoints = ds.ReversingAdjoint(), diffrax.RecursiveCheckpointAdjoint()
        over = lambda by: lambda key: jax.grad(end)(jnp.array([0.5]), key, by)
        return [jax.vmap(over(by))(jr.split(jr.key(1), 50)) for by in adjoints]

    for momentum in (0.0, 1e-12):
        ours, theirs = gradients((jnp.array([momentum]), jnp.zeros(1)))
        np.testing.assert_allclose(ours, theirs, rtol=1e-7)


def test_a_loss_on_the_way_back_is_not_forgotten_at_the_next_saved_state():
    # The states after no, two and four steps.
    saved = jnp.array([3.0, 2.0, 1.0])
    at_saved = lambda y, found, size=0.0: _meet_checkpoint(
        y, saved, jnp.array(2), 2, jnp.array(found), jnp.array(size)
    )
    assert at_saved(jnp.array(2.0), True) == (2.0, True)
    bound = 2 * jnp.finfo(float).eps ** (2 / 3)
    assert at_saved(jnp.array(2 + 0.99 * bound), True) == (2.0, True)
    assert at_saved(jnp.array(2 + 1.01 * bound), True) == (2.0, False)
    assert at_saved(jnp.array(2 + 1.01 * bound), True, 2.1) == (2.0, True)
    assert at_saved(jnp.array(2.0), False) == (2.0, False)
    between = _meet_checkpoint(
        jnp.array(1.6), saved, jnp.array(3), 2, jnp.array(True), jnp.array(0.0)
    )
    assert between == (1.6, True)


def test_what_reversing_cannot_do_is_refused_with_advice():
    def solve(y0=1.0, solver=None, path=None, adjoint=None, **options):
        H0 = lambda t, p, q, args: p**2 / 2
        path = path or ds.WeakBrownianPath((), jr.key(0), second=True)
        terms = ds.hamiltonian_terms(H0, lambda t, p, q, args: q, path)
        return diffrax.diffeqsolve(
            terms, solver or ds.StormerVerlet(), 0.0, 1.0, 0.1, (y0, y0), **options,
            adjoint=adjoint or ds.ReversingAdjoint(),
        ).ys[1][-1]  # fmt: skip

    tree = diffrax.VirtualBrownianTree(0.0, 1.0, 0.01, (), jr.key(0))
    pid = diffrax.PIDController(rtol=1e-3, atol=1e-3)
    at_end = diffrax.SubSaveAt(t1=True)
    for message, options in (
        ("got `SRKw5`", dict(solver=ds.SRKw5())),
        ("steps that are known in adv", dict(path=tree, stepsize_controller=pid)),
        ("not support events", dict(event=diffrax.Event(lambda t, y, *_, **__: t > 9))),
        ("takes no `solver_state`", dict(solver_state=())),
        (r"SaveAt\(fn", dict(saveat=diffrax.SaveAt(t1=True, fn=lambda t, y, a: y[0]))),
        *(
            (r"SaveAt\(ts=...\)", dict(saveat=diffrax.SaveAt(**saved)))
            for saved in (
                dict(steps=True),
                dict(t0=True, t1=True),
                dict(t1=True, ts=[0.5]),
                dict(subs=[at_end, at_end]),
                dict(t1=True, dense=True),
            )
        ),
    ):
        with pytest.raises(ValueError, match=message):
            jax.eval_shape(lambda: solve(**options))
    with pytest.raises(ValueError, match="`checkpoints` must be"):
        ds.ReversingAdjoint(checkpoints=0)
    # Another adjoint takes steps of its own, which have other increments of a weak path,
    # and its state is no pair (p, q).
    backsolve = lambda y0: solve(y0, adjoint=diffrax.BacksolveAdjoint())
    with pytest.raises(ValueError, match="BacksolveAdjoint.*ReversingAdjoint"):
        jax.eval_shape(jax.grad(backsolve), 1.0)
