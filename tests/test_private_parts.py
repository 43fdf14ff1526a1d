"""What the package uses of other packages that they do not promise to keep. If one of these
tests fails after an upgrade, its name says what broke; other failures follow from it."""

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic import _compat
from diffrax_symplectic._adjoint import _Steps


def test_private_parts_of_others_are_used_in_one_module_only():
    # Private modules, and public ones without a promise to be kept.
    private = re.compile(r"\._(?!_)|\.internal|jax\.extend|jax\.interpreters")
    root = Path(ds.__file__).parent
    for file in root.rglob("*.py"):
        found = set()
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                found |= {f"{node.module}.{alias.name}" for alias in node.names}
        if file != root / "_compat.py":
            assert not {name for name in found if private.search(name)}, file


@pytest.fixture
def terms():
    H0, noise = (lambda t, p, q, args: p**2 / 2), (lambda t, p, q, args: q)
    path = ds.WeakBrownianPath((), jax.random.key(0))
    return ds.hamiltonian_terms(H0, noise, path)


def test_diffrax_wraps_the_terms_of_a_solve_with_its_direction(terms):
    seen = []

    class Spy(diffrax.Euler):
        def init(self, terms, t0, t1, y0, args):
            seen.append(terms)

    y0 = jnp.array(0.3), jnp.array(0.7)
    drift = terms.terms[0]
    solve = lambda: diffrax.diffeqsolve(drift, Spy(), 1.0, 0.0, -0.5, y0).ys
    jax.eval_shape(solve)
    assert type(_compat.unwrapped(seen[0])) is type(_compat.unwrapped(drift))
    assert type(seen[0]) is not type(drift) and _compat.unwrapped(drift) is drift
    with jax.disable_jit(), jax.ensure_compile_time_eval():
        solve()
    assert _compat.direction(seen[1]) == -1 and _compat.direction(drift) == 1
    other = _compat.replaced(seen[1], drift)
    assert _compat.direction(other) == -1 and _compat.unwrapped(other) is drift
    assert _compat.replaced(drift, drift) is drift
    turned = _compat.reversed_in_time({"drift": seen[1]})
    assert _compat.direction(turned) == 1
    assert type(turned["drift"]) is type(seen[1])


def test_the_terms_that_backsolve_adjoint_solves_are_known(terms):
    y0 = jnp.array(0.3), jnp.array(0.7)
    seen = []

    class Spy(diffrax.Euler):
        def init(self, terms, t0, t1, y0, args):
            seen.append(_compat.is_adjoint_term(terms))

    def loss(y0):
        adjoint = diffrax.BacksolveAdjoint()
        sol = diffrax.diffeqsolve(
            terms.terms[0], Spy(), 0.0, 1.0, 0.5, y0, adjoint=adjoint
        )
        return sol.ys[0][-1]

    jax.eval_shape(jax.grad(loss), y0)
    assert set(seen) == {False, True}


def test_omega_does_arithmetic_on_pytrees():
    x = {"a": jnp.array([1.0, 2.0]), "b": (jnp.array(3.0),)}
    y = (2 * x**_compat.ω - x**_compat.ω / 2).ω
    assert jnp.array_equal(y["a"], jnp.array([1.5, 3.0])) and y["b"][0] == 4.5


def test_equinox_refuses_derivatives_of_what_is_nondifferentiable():
    f = lambda x: _compat.nondifferentiable(x, name="t")
    assert f(2.0) == 2.0
    with pytest.raises(RuntimeError, match="t"):
        jax.jvp(f, (2.0,), (1.0,))


@pytest.mark.core
def test_adjoints_of_diffrax_run_a_loop_with_the_arguments_and_the_state_known_here():
    # `ReversingAdjoint` calls the loop of a solve, and reads these parts of its state.
    steps = []

    class Spy(diffrax.RecursiveCheckpointAdjoint):
        def loop(self, *, init_state, terms, passed_solver_state, **kwargs):
            own = set(inspect.signature(ds.ReversingAdjoint.loop).parameters)
            given = {"init_state", "terms", "passed_solver_state", *kwargs}
            assert own - {"self", "kwargs"} <= given
            assert callable(self._loop)
            for part in ("y", "tprev", "tnext", "num_steps", "solver_state"):
                assert hasattr(init_state, part)
            for part in ("ys", "saveat_ts_index"):
                assert hasattr(init_state.save_state, part)
            steps.append(_Steps(kwargs["stepsize_controller"], init_state))
            return super().loop(
                init_state=init_state,
                terms=terms,
                passed_solver_state=passed_solver_state,
                **kwargs,
            )

    term = diffrax.ODETerm(lambda t, y, args: -y)
    saveat = diffrax.SaveAt(t0=True, steps=True)
    with jax.ensure_compile_time_eval(), jax.disable_jit():
        sol = diffrax.diffeqsolve(
            term, diffrax.Euler(), 0.1, 1.13, 0.1, jnp.array(1.0), saveat=saveat,
            adjoint=Spy(), max_steps=16,
        )  # fmt: skip
        # The state of a constant step size: how many steps are made, and in which times.
        assert steps[0].between(1) == 11 == sol.stats["num_steps"]
        times = [steps[0].time(i) for i in range(12)]
    assert sol.ts[:12].tolist() == times and 0.2 in times and times[2] < 0.3


def test_loops_of_equinox_take_buffers_and_gradients_can_be_refused():
    final = _compat.while_loop(
        lambda i: i < 3, lambda i: i + 1, jnp.array(0), kind="lax", max_steps=None
    )
    assert final == 3
    refused = lambda x: _compat.nondifferentiable_backward(x, symbolic=False)
    assert jax.jvp(refused, (2.0,), (1.0,))[1] == 1
    with pytest.raises(RuntimeError, match="[Rr]everse-mode"):
        jax.grad(refused)(2.0)


def test_what_takes_long_to_import_is_imported_when_it_is_needed():
    code = "import sys, diffrax_symplectic; print('scipy.special' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert out.stdout.split() == [b"False"]


def test_a_function_takes_other_arrays_in_place_of_the_captured_ones():
    captured = jnp.arange(3.0)
    fn = lambda value: {"sum": value["x"] + captured, "x": value["x"]}
    call, arrays = _compat.captured_arrays(fn, {"x": jnp.ones(3)})
    assert len(arrays) == 1
    out = call({"x": jnp.zeros(3)}, [jnp.full(3, 2.0)])
    assert out["sum"].tolist() == [2.0] * 3 and out["x"].tolist() == [0.0] * 3


def test_traced_programs_tell_literals_and_what_they_call():
    jaxpr = jax.make_jaxpr(lambda x: jax.jit(lambda x: 2.0 * x)(x))(1.0).jaxpr
    assert isinstance(jaxpr, _compat.Jaxpr)
    (call,) = jaxpr.eqns
    assert call.primitive.name in ("jit", "pjit")
    (product,) = call.params["jaxpr"].jaxpr.eqns
    assert product.primitive.name == "mul"
    literals = [isinstance(x, _compat.Literal) for x in product.invars]
    assert literals == [True, False]
