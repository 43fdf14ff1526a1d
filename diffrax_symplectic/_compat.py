"""What this package uses of others that they do not promise to keep, by its use.

Some of it is private, some is public but undocumented, and some is how a class happens to
store what it was given. It is used nowhere else. If a test of it in
`tests/test_private_parts.py`, or of what uses it, fails after an upgrade, change the
function here.
(What operations of MLIR tell is read in `_stablehlo/mlir.py` and `operation.py`, in the
same way.)
"""

import dataclasses
import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import lineax as lx
from diffrax._term import AdjointTerm, WrapTerm
from equinox.internal import (
    nondifferentiable as nondifferentiable,
    nondifferentiable_backward as nondifferentiable_backward,
    while_loop as while_loop,
    ω as ω,
)
from jax.extend.core import (
    ClosedJaxpr as ClosedJaxpr,
    Jaxpr as Jaxpr,
    JaxprEqn,
    Literal as Literal,
)
from jax.interpreters.mlir import make_ir_context
from jax.interpreters.partial_eval import dce_jaxpr as dce_jaxpr
from jaxlib.mlir import ir
from jaxtyping import Array, PRNGKeyArray, PyTree

from ._parts import parts_of, with_parts


# Operations that only call a function, and the parameter that holds it.
CALLS = {
    "checkpoint": "jaxpr",
    "closed_call": "call_jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vmap_call": "call",
    "jit": "jaxpr",
    "pjit": "jaxpr",
}


def is_threefry(key: PRNGKeyArray) -> bool:
    """Whether the key belongs to JAX's default generator, by its name, which is all that
    JAX tells of a generator."""
    return str(jr.key_impl(key)) == "threefry2x32"


def is_traced(x: Any) -> bool:
    """Whether this value is known only when the program runs."""
    return isinstance(x, jax.core.Tracer)


def at_trace_time() -> Any:
    """A context in which operations on known values are carried out at once, so that their
    results are known, too, inside of `jax.jit`."""
    return jax.ensure_compile_time_eval()


def is_result(x: Any) -> bool:
    """Whether this says how a solve ended, such as a `diffrax.RESULTS`. The results of
    Diffrax, Optimistix and Lineax have one class in common, which none of them names."""
    return isinstance(x, type(diffrax.RESULTS.successful))


def is_closure_mismatch(error: ValueError) -> bool:
    """Whether Equinox refused to call what it converted from a closure with arrays of
    another type, as it does on several devices. It has no class of errors for this."""
    return "Closure-converted function" in str(error)


@ft.cache
def quick_options() -> dict[str, bool]:
    """Options by which XLA compiles with its older generator of code for CPUs, if it has
    it."""
    options = {"xla_cpu_use_fusion_emitters": False}
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        # This version of XLA does not know the option.
        return {}
    return options


def linear_solution(
    solver: lx.AbstractLinearSolver[Any],
    operator: lx.AbstractLinearOperator,
    rhs: Array,
) -> tuple[Array, lx.RESULTS]:
    """The solution of a linear system by a solver of Lineax, and whether it was found.

    `lineax.linear_solve` does the same, with derivatives that would not be used here, and
    with a longer trace.
    """
    x, result, _ = solver.compute(solver.init(operator, {}), rhs, {})
    return x, result


def unwrapped(term: diffrax.AbstractTerm) -> diffrax.AbstractTerm:
    """The user's term. In a solve Diffrax wraps it, to be able to run backward in time."""
    return term.term if isinstance(term, WrapTerm) else term


def wrapped_like(term: diffrax.AbstractTerm, new: diffrax.AbstractTerm) -> Any:
    """`new` in the place of a term that Diffrax may have wrapped, in the same direction of
    time."""
    return WrapTerm(new, term.direction) if isinstance(term, WrapTerm) else new


def not_a_path(term: diffrax.ControlTerm) -> Any:
    """What was passed to a `ControlTerm` in place of a path or a function, or `None`."""
    # Diffrax takes anything that is no path for a function, and wraps it.
    given = getattr(term.control, "fn", None)
    return None if callable(given) else given


def resolution(tree: diffrax.VirtualBrownianTree) -> Any:
    """The length of time below which a tree only interpolates, its `tol`."""
    # It is stored in units of the length of the tree.
    return tree.tol * (tree.t1 - tree.t0)


def direction(terms: PyTree[diffrax.AbstractTerm]) -> Any:
    """The sign of the direction of time in the solve that the terms come from. Terms from
    outside a solve run forward."""
    # The same for all terms of a solve.
    return next((term.direction for term in parts_of(WrapTerm, terms)), 1)


def reversed_in_time(terms: PyTree[diffrax.AbstractTerm]) -> PyTree:
    """The terms of a solve with the direction of time reversed."""

    def reversed_term(term: Any) -> Any:
        return WrapTerm(term.term, -term.direction)

    return with_parts(WrapTerm, reversed_term, terms)


def is_adjoint_term(term: diffrax.AbstractTerm) -> bool:
    """Whether the term comes from `diffrax.BacksolveAdjoint`."""
    return isinstance(unwrapped(term), AdjointTerm)


def with_captured_arrays(fn: Callable, value: PyTree) -> tuple[Callable, list[Any]]:
    """Returns a function `call(value, arrays)` for `fn(value)`, which takes the arrays that
    `fn` captures as an argument; and these arrays.
    (`eqx.filter_closure_convert` would refuse them under `shard_map`, which changes the
    types that it checks.)"""
    traced, struct = jax.make_jaxpr(fn, return_shape=True)(value)
    result_treedef = jtu.tree_structure(struct)

    def call(value: PyTree, arrays: list[Any]) -> PyTree:
        results = evaluated(traced.jaxpr, arrays, jtu.tree_leaves(value))
        return result_treedef.unflatten(results)

    return call, traced.consts


def is_program(x: Any) -> bool:
    """Whether this is a jaxpr, among the parameters of an operation."""
    return isinstance(x, Jaxpr | ClosedJaxpr)


def is_rule(x: Any) -> bool:
    """Whether this parameter of an operation is a function, such as the rule of a custom
    derivative, or a callback."""
    # Types and meshes of devices are callable, but no rules. Some rules JAX wraps in an
    # object that is not callable, with the function as `call_wrapped`.
    if isinstance(x, type | jax.sharding.Mesh):
        return False
    return callable(x) or hasattr(x, "call_wrapped")


class OperandPlace(NamedTuple):
    """Where a program reads a value.

    - `operation`: the number of the operation that reads it. The number after that of the
        last operation stands for what the program returns.
    - `position`: its position among the arguments of the operation, or among the results of
        the program.
    """

    operation: int
    position: int


def with_constants_at(jaxpr: Jaxpr, places: Sequence[OperandPlace]) -> Jaxpr:
    """The program that reads a new constant in each of these places. The new constants come
    after those that it has."""
    operands: list[list[Any]] = [list(eqn.invars) for eqn in jaxpr.eqns]
    operands.append(list(jaxpr.outvars))
    avals = [operands[place.operation][place.position].aval for place in places]
    structs = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]
    for place, constant in zip(places, _variables_like(*structs)):
        operands[place.operation][place.position] = constant
    *operands_of_eqns, results = operands
    eqns = [eqn.replace(invars=xs) for eqn, xs in zip(jaxpr.eqns, operands_of_eqns)]
    constants = [*jaxpr.constvars, *_variables_like(*structs)]
    return jaxpr.replace(eqns=eqns, outvars=results, constvars=constants)


@ft.lru_cache(maxsize=128)
def _variables_like(*structs: jax.ShapeDtypeStruct) -> list[Any]:
    """Variables of programs for arrays like these."""
    # The constructor of a variable differs between versions of JAX. So JAX makes them: they
    # are the inputs of a trace of the identity.
    return jax.make_jaxpr(lambda *xs: xs)(*structs).jaxpr.invars


# Made on import, since no such context may be made while other threads use JAX.
_numbered_traces = jax.make_user_context(0)


def with_traces_of(number: int) -> Any:
    """A context in which JAX uses a trace again only if it was made in a context of the
    same number. Otherwise JAX would use the trace of an inner function, such as
    `diffrax.diffeqsolve`, whenever its arguments are the same objects, although a function
    among them may compute something else by now."""
    return _numbered_traces(number)


def evaluated(jaxpr: Jaxpr, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
    """The results of a program. Operations keep the lines of the user's code that they come
    from, by which messages name them."""
    return jax.core.eval_jaxpr(jaxpr, consts, *inputs)


def programs_in(eqn: JaxprEqn) -> list[Jaxpr]:
    """The programs that an operation runs, such as the branches of a conditional."""
    leaves = jtu.tree_leaves(eqn.params, is_leaf=is_program)
    return [getattr(x, "jaxpr", x) for x in leaves if is_program(x)]


def results_of_operation(eqn: JaxprEqn, args: Sequence[Any], params: Any) -> list[Any]:
    """The results of one operation of a jaxpr, with these parameters."""
    bind_params = eqn.primitive.get_bind_params(params)
    functions = ()
    # Some versions of JAX return a pair: functions, which `bind` takes before the other
    # arguments, and the parameters.
    if isinstance(bind_params, tuple):
        functions, bind_params = bind_params
    with eqn.ctx.manager:
        outs = eqn.primitive.bind(*functions, *args, **bind_params)
    return outs if eqn.primitive.multiple_results else [outs]


def results_of_program(
    program: Jaxpr | ClosedJaxpr,
    args: Sequence[Any],
    results_of: Callable[[JaxprEqn, list[Any]], Sequence[Any]],
) -> list[Any]:
    """The results of a program for these arguments, operation by operation: `results_of`
    gives those of one, for its arguments."""
    jaxpr = getattr(program, "jaxpr", program)
    consts = getattr(program, "consts", [])
    values = dict(zip(jaxpr.constvars, consts)) | dict(zip(jaxpr.invars, args))

    def value_of(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for eqn in jaxpr.eqns:
        results = results_of(eqn, [value_of(atom) for atom in eqn.invars])
        values.update(zip(eqn.outvars, results))
    return [value_of(atom) for atom in jaxpr.outvars]


def has_blocking_lapack() -> bool:
    """Whether calls of LAPACK that run at the same time can block each other, as on CPUs by
    the versions of JAX that share out a batch in the pool from which they are called."""
    shares_out_batches = (0, 10, 0) <= jax.__version_info__ < (0, 11, 2)
    return shares_out_batches and jax.default_backend() == "cpu"


def stablehlo_module(program: Any) -> Any:
    """The module of MLIR of a program in StableHLO: parsed from its text, or what
    `compiler_ir("stablehlo")` of a lowered function returned."""
    if not isinstance(program, str):
        return program
    with make_ir_context():
        return ir.Module.parse(program)


def is_literal(x: Any) -> bool:
    """Whether the value of an array of Dr.Jit is known while a kernel is recorded: it is a
    constant, or was computed from constants."""
    return x.state.name == "Literal"


class SolveState(NamedTuple):
    """What is used here of the state of Diffrax's loop over steps.

    - `y`: the state of the equation.
    - `num_steps`: the number of steps so far.
    - `num_saved`: the number of times of `SaveAt(ts=...)` so far.
    - `ys`: the saved states.
    """

    y: PyTree[Array]
    num_steps: Any
    num_saved: Any
    ys: PyTree[Array]


def solve_state(loop_state: Any) -> SolveState:
    """The parts of a state of Diffrax's loop."""
    return SolveState(
        y=loop_state.y,
        num_steps=loop_state.num_steps,
        num_saved=loop_state.save_state.saveat_ts_index,
        ys=loop_state.save_state.ys,
    )


def without_derivatives(loop_state: Any, stop_gradient: Callable) -> Any:
    """A state of Diffrax's loop through which no derivatives pass: without the state of the
    equation, and with `stop_gradient(x)` in place of each leaf `x` of the solver's
    state."""
    solver_state = jtu.tree_map(stop_gradient, loop_state.solver_state)
    # In place of the state there is an object that is no array, so that using it by mistake
    # is an error.
    return dataclasses.replace(loop_state, y=object(), solver_state=solver_state)


def with_y(loop_state: Any, y: PyTree[Array]) -> Any:
    """A state of Diffrax's loop with this state of the equation."""
    return eqx.tree_at(lambda state: state.y, loop_state, y)


def with_only_ys_differentiable(loop_state: Any) -> Any:
    """A state of Diffrax's loop with an error for derivatives of anything but the saved
    states."""
    ys = loop_state.save_state.ys
    refused = nondifferentiable_backward(loop_state, symbolic=False)
    return eqx.tree_at(lambda state: state.save_state.ys, refused, ys)


def run_steps(adjoint: Any, outer_while_loop: Callable, **kwargs: Any) -> Any:
    """Runs Diffrax's loop over steps, for an adjoint, with `outer_while_loop` for it and
    an ordinary loop for the times to save at. `kwargs` are those of `adjoint.loop`."""
    return adjoint._loop(
        **kwargs,
        event=None,
        inner_while_loop=ft.partial(while_loop, kind="lax"),
        outer_while_loop=outer_while_loop,
    )


def saves_states(sub_saveat: diffrax.SubSaveAt) -> bool:
    """Whether the states themselves are saved, not a function of them."""
    # The default is a private function, the same object in each.
    return sub_saveat.fn is diffrax.SubSaveAt(t1=True).fn


class StepTimes(NamedTuple):
    """The times of the steps of a solve, computed by its controller.

    - `controller`: `diffrax.ConstantStepSize` or `diffrax.StepTo`.
    - `init_state`: the state of Diffrax's loop before the first step.
    """

    controller: diffrax.AbstractStepSizeController
    init_state: Any

    def num_steps(self) -> Any:
        """The number of steps of the solve."""
        if isinstance(self.controller, diffrax.StepTo):
            return len(self.controller.ts) - 1
        # The state of a constant step size: steps so far, number of steps, and more.
        _, num_steps, *_ = self.init_state.controller_state
        return num_steps

    def time(self, i: Any) -> Any:
        """The time after `i` steps."""
        if isinstance(self.controller, diffrax.StepTo):
            return self.controller.ts[i]
        _, *other_state = self.init_state.controller_state
        initial_time = self.init_state.tprev
        time_after_first_step = self.init_state.tnext
        # A constant step size is asked for the next step after `i - 1` steps, the number
        # that its state begins with. It answers with the start and the end of that step,
        # and more. The start is the `t1` that it is given, and is not used.
        _, _, time_after_step, *_ = self.controller.adapt_step_size(
            t0=initial_time,
            t1=time_after_first_step,
            y0=None,
            y1_candidate=None,
            args=None,
            y_error=None,
            error_order=1,
            controller_state=(i - 1, *other_state),
        )
        # In Diffrax the first step ends at `t0 + dt0`, and all later ones at fractions of
        # the interval, which differ by rounding. Both are followed here.
        return jnp.where(i == 1, time_after_first_step, time_after_step)

    def solver_state(self) -> Any:
        """The state of the solver before the first step."""
        return self.init_state.solver_state
