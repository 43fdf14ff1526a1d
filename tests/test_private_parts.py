"""What the package uses of other packages that they do not promise to keep. If one of these
tests fails after an upgrade, its name says what broke; other failures follow from it."""

import inspect
import subprocess
import sys
import textwrap

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic import _compat
from diffrax_symplectic._programs import compiled
from diffrax_symplectic._stablehlo import array_types

from .drjit_here import needs_drjit


class Seen(Exception):
    """What a solver gets has been seen: no step is needed."""


def test_diffrax_wraps_the_terms_of_a_solve_with_its_direction():
    """If this fails: find what `diffeqsolve` wraps terms in, and adapt `unwrapped`,
    `direction` and `reversed_in_time`."""

    class Spy(diffrax.Euler):
        def init(self, terms, t0, t1, y0, args):
            raise Seen(terms)

    drift = diffrax.ODETerm(lambda t, y, args: -y)
    with jax.disable_jit(), jax.ensure_compile_time_eval():
        with pytest.raises(Seen) as info:
            diffrax.diffeqsolve(drift, Spy(), 1.0, 0.0, -0.5, jnp.ones(2))
    (seen,) = info.value.args
    assert type(seen) is not type(drift) and _compat.unwrapped(drift) is drift
    assert type(_compat.unwrapped(seen)) is type(drift)
    assert _compat.direction(seen) == -1 and _compat.direction(drift) == 1
    other = _compat.wrapped_like(seen, drift)
    assert _compat.direction(other) == -1 and _compat.unwrapped(other) is drift
    assert _compat.wrapped_like(drift, drift) is drift
    turned = _compat.reversed_in_time({"drift": seen})
    assert _compat.direction(turned) == 1
    assert type(turned["drift"]) is type(seen)


def test_a_control_term_keeps_what_it_was_given_in_place_of_a_path():
    """If this fails: find where Diffrax keeps it, and adapt `not_a_path`."""
    field = lambda t, y, args: jnp.ones(3)
    assert _compat.not_a_path(diffrax.ControlTerm(field, (3,))) == (3,)
    for path in (ds.WeakBrownianPath((3,), jax.random.key(0)), lambda t0, t1: t1 - t0):
        assert _compat.not_a_path(diffrax.ControlTerm(field, path)) is None


def test_the_resolution_of_a_tree_is_the_tolerance_that_it_was_given():
    """If this fails: find how Diffrax stores `tol`, and adapt `resolution`."""
    tree = diffrax.VirtualBrownianTree(1.0, 5.0, 1e-3, (), jax.random.key(0))
    assert jnp.allclose(_compat.resolution(tree), 1e-3)


def test_the_terms_that_backsolve_adjoint_solves_are_known():
    """If this fails: find the term of `BacksolveAdjoint`, and adapt `is_adjoint_term`."""
    seen = []

    class Spy(diffrax.Euler):
        def init(self, terms, t0, t1, y0, args):
            seen.append(_compat.is_adjoint_term(terms))

    def loss(y0):
        drift = diffrax.ODETerm(lambda t, y, args: -y)
        adjoint = diffrax.BacksolveAdjoint()
        sol = diffrax.diffeqsolve(drift, Spy(), 0.0, 1.0, 0.5, y0, adjoint=adjoint)
        return sol.ys[-1]

    jax.eval_shape(jax.grad(loss), jnp.array(0.3))
    assert set(seen) == {False, True}


def test_omega_does_arithmetic_on_pytrees():
    """If this fails: take omega from where it moved to, or copy its hundred lines."""
    x = {"a": jnp.array([1.0, 2.0]), "b": (jnp.array(3.0),)}
    y = (2 * x**_compat.ω - x**_compat.ω / 2).ω
    assert jnp.array_equal(y["a"], jnp.array([1.5, 3.0])) and y["b"][0] == 4.5


def test_equinox_refuses_derivatives_of_what_is_nondifferentiable():
    """If this fails: write it by `jax.custom_jvp`, with a rule that raises."""
    f = lambda x: _compat.nondifferentiable(x, name="t")
    assert f(2.0) == 2.0
    with pytest.raises(RuntimeError, match="t"):
        jax.jvp(f, (2.0,), (1.0,))


@pytest.mark.core
def test_adjoints_of_diffrax_run_a_loop_with_the_arguments_and_the_state_known_here():
    """If this fails: read `diffrax/_integrate.py` for the new state of the loop, and adapt
    `SolveState`, `StepTimes` and `run_steps`. Nothing but `ReversingAdjoint` needs them."""
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
            steps.append(_compat.StepTimes(kwargs["stepsize_controller"], init_state))
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
            term, diffrax.Euler(), 0.1, 0.43, 0.1, jnp.array(1.0), saveat=saveat,
            adjoint=Spy(), max_steps=4,
        )  # fmt: skip
        # The state of a constant step size: how many steps are made, and in which times.
        assert steps[0].num_steps() == 4 == sol.stats["num_steps"]
        times = [steps[0].time(i) for i in range(5)]
    assert sol.ts[:5].tolist() == times and 0.2 in times and times[2] < 0.3


def test_values_are_told_from_traced_ones():
    """If this fails: find the class of traced values in `jax`, or try `np.asarray`, which
    raises for them."""
    seen = []
    jax.jit(lambda x: seen.append(_compat.is_traced(x)))(1.0)
    assert seen == [True]
    assert not any(map(_compat.is_traced, (1.0, jnp.ones(2), "traced")))


def test_the_default_generator_is_known_by_its_name():
    """If this fails: words of a step are drawn by folding keys, which is slower and gives
    other numbers for the same key. Find the new name of Threefry."""
    assert _compat.is_threefry(jax.random.key(0, impl="threefry2x32"))
    assert not _compat.is_threefry(jax.random.key(0, impl="rbg"))


def test_solvers_of_lineax_compute_without_linear_solve():
    """If this fails: call `lineax.linear_solve(..., throw=False)`."""
    A = jnp.array([[2.0, 1.0], [0.0, 4.0]])
    struct = jax.ShapeDtypeStruct((2,), A.dtype)
    operator = lx.FunctionLinearOperator(lambda x: A @ x, struct)
    solve = eqx.filter_jit(_compat.linear_solution)
    for solver in (lx.LU(), lx.GMRES(1e-6, 1e-6)):
        x, result = solve(solver, operator, jnp.array([4.0, 4.0]))
        assert result == lx.RESULTS.successful
        assert jnp.allclose(x, jnp.array([1.5, 1.0]), atol=1e-5)


def test_results_of_all_solves_are_told_from_other_values():
    """If this fails: find the class of the results of Equinox's enumerations."""
    for results in (diffrax.RESULTS, optx.RESULTS, lx.RESULTS):
        assert _compat.is_result(results.successful)
    assert not any(map(_compat.is_result, (1, jnp.ones(2), "successful")))


def test_a_program_may_have_compiler_options_unless_it_is_inside_of_another():
    double = compiled(lambda x: 2 * x, quickly=True)
    x = jnp.ones(())
    assert double(x) == 2
    assert jax.jit(double)(x) == 2

    def captured(x):
        return compiled(lambda y: x * y, quickly=True)(2.0)

    assert jax.grad(captured)(x) == 2


def test_a_function_with_an_error_of_its_own_is_called_once():
    calls = []

    def wrong(x):
        calls.append(x)
        raise ValueError("other")

    with pytest.raises(ValueError, match="other"):
        compiled(wrong, quickly=True)(jnp.ones(()))
    assert len(calls) == 1


@needs_drjit
def test_drjit_knows_the_values_of_constants_and_of_what_follows_from_them():
    """If this fails: find how an array of Dr.Jit tells its state, and adapt `is_literal`.
    Without it loops are not unrolled, and zeros are not left out."""
    number = array_types()["f64"]
    assert _compat.is_literal(number(2)) and _compat.is_literal(2 * number(2) + 1)
    assert not _compat.is_literal(number([1, 2]))
    pair = array_types()["complex<f64>"]
    assert _compat.is_literal(pair(1, 2))
    assert not _compat.is_literal(pair(1, number([1, 2])))


on_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="needs LLVM")


def needs_llvm(test):
    return needs_drjit(on_cpu(test))


def _ends_with(code: str) -> subprocess.CompletedProcess:
    """A program of Dr.Jit, which may abort, in a process of its own."""
    start = "import drjit as dr\nfrom drjit.llvm import Float\nx = Float([1, -2, 3])\n"
    command = [sys.executable, "-c", start + textwrap.dedent(code)]
    return subprocess.run(command, capture_output=True, text=True)


# Two faults of Dr.Jit 1.5. Once one of these tests fails, Dr.Jit has mended it. The
# function that is named can go as soon as `pyproject.toml` asks for that version.


@pytest.mark.slow
@needs_llvm
def test_drjit_writes_the_result_of_a_conditional_into_what_its_branch_returned():
    # So `_stablehlo.tensor.copied_entries` copies what a branch returns.
    done = _ends_with(
        """
        y = 3 * x
        dr.if_stmt((), x > 0, lambda: x * x, lambda: y, mode="symbolic")
        print(y)
        """
    )
    assert done.stdout.split("\n")[0] == "[1, -6, 9]", done.stderr


@pytest.mark.slow
@needs_llvm
def test_drjit_returns_the_constant_of_a_branch_from_a_conditional():
    # So `_stablehlo.tensor.as_own_literal` makes constants anew.
    done = _ends_with(
        """
        half = lambda sign: lambda: (Float(0.5), sign * x)
        y, z = dr.if_stmt((), x > 0, half(1), half(-1), mode="symbolic")
        print(z + dr.if_stmt((), x > 0, lambda: y, lambda: x, mode="symbolic"))
        """
    )
    assert done.returncode < 0 and "does not dominate all uses" in done.stderr


def test_operations_of_a_jaxpr_are_evaluated_one_by_one():
    """If this fails: look up how `jax.core.eval_jaxpr` binds an operation, and adapt
    `results_of_operation`."""

    @jax.custom_jvp
    def sine(x):
        return jnp.sin(x)

    sine.defjvp(lambda primals, tangents: (sine(*primals), tangents[0]))
    program = jax.make_jaxpr(lambda x: jax.lax.sort((sine(x), x)))(jnp.arange(3.0))
    call, sort = program.jaxpr.eqns
    (y,) = _compat.results_of_operation(call, [jnp.arange(3.0)], call.params)
    assert jnp.allclose(y, jnp.sin(jnp.arange(3.0)))
    keys, values = _compat.results_of_operation(sort, [-y, y], sort.params)
    assert jnp.array_equal(keys, jnp.sort(-y)) and jnp.array_equal(values, -keys)


def test_the_versions_with_calls_of_lapack_that_block_each_other(monkeypatch):
    """If this fails: adapt `has_blocking_lapack` to how JAX writes its version."""
    known = {(0, 9, 2): False, (0, 10, 0): True, (0, 10, 2): True, (0, 11, 2): False}
    for version, blocking in known.items():
        monkeypatch.setattr(jax, "__version_info__", version)
        on_cpu = jax.default_backend() == "cpu"
        assert _compat.has_blocking_lapack() == (blocking and on_cpu)
