"""What this package uses of other packages although they do not promise to keep it.

Some of it is private, some is public but undocumented, and some is how a class happens to
store its arguments. Other modules use it only through the names here. If a test in
`tests/test_private_parts.py` fails after an upgrade, change the function here.
(`_stablehlo/mlir.py` and `operation.py` do the same for operations of MLIR.)
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
    while_loop,
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


# Equinox's loop without derivatives, which can write arrays in place.
lax_while_loop = ft.partial(while_loop, kind="lax")

# Operations that only call a function, and the parameter that holds the function.
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
    """Whether the key belongs to JAX's default generator."""
    # JAX tells only the name of a generator.
    return str(jr.key_impl(key)) == "threefry2x32"


def is_traced(x: Any) -> bool:
    """Whether the value `x` is known only when the program runs."""
    return isinstance(x, jax.core.Tracer)


def at_trace_time() -> Any:
    """A context in which operations on values that are not traced are carried out at once,
    even inside of `jax.jit`, so that their results are known while tracing."""
    return jax.ensure_compile_time_eval()


def is_result(x: Any) -> bool:
    """Whether `x` says how a solve ended, such as a `diffrax.RESULTS`. The results of
    Diffrax, Optimistix and Lineax have a class in common, which is not public."""
    return isinstance(x, type(diffrax.RESULTS.successful))


def is_closure_mismatch(error: ValueError) -> bool:
    """Whether Equinox raised the error because a closure that it had converted was called
    with arrays of another type, as on several devices."""
    # Equinox has no class of errors for this.
    return "Closure-converted function" in str(error)


@ft.cache
def quick_options() -> dict[str, bool]:
    """Options for compiling with XLA's older generator of code for CPUs, if it has one."""
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
    """`new` for use in place of `term`, which Diffrax may have wrapped, in the same
    direction of time."""
    return WrapTerm(new, term.direction) if isinstance(term, WrapTerm) else new


def not_a_path(term: diffrax.ControlTerm) -> Any:
    """What was passed to a `ControlTerm` in place of a path or a function, or `None`."""
    # Diffrax takes anything that is no path for a function, and wraps it.
    given = getattr(term.control, "fn", None)
    return None if callable(given) else given


def resolution(tree: diffrax.VirtualBrownianTree) -> Any:
    """The length of time below which a tree only interpolates, its `tol`."""
    # The tree stores it in units of its own length.
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
    """Returns a function `call` and the arrays that `fn` captures, such that
    `call(value, arrays)` is `fn(value)`.

    (`eqx.filter_closure_convert` does this, too, but checks the types of the arrays. Under
    `shard_map` it would refuse them, since their types change there.)"""
    program, struct = jax.make_jaxpr(fn, return_shape=True)(value)
    result_treedef = jtu.tree_structure(struct)

    def call(value: PyTree, arrays: list[Any]) -> PyTree:
        results = evaluated(program.jaxpr, arrays, jtu.tree_leaves(value))
        return result_treedef.unflatten(results)

    return call, program.consts


def is_program(x: Any) -> bool:
    """Whether a parameter of an operation is a jaxpr."""
    return isinstance(x, Jaxpr | ClosedJaxpr)


def is_rule(x: Any) -> bool:
    """Whether a parameter of an operation is a function, such as the rule of a custom
    derivative, or a callback."""
    # Types and meshes of devices are callable, but no rules. Some functions are wrapped by
    # JAX in an object that is not callable, and has the function as `call_wrapped`.
    if isinstance(x, type | jax.sharding.Mesh):
        return False
    return callable(x) or hasattr(x, "call_wrapped")


# The `operation` of an `OperandPlace` for a value that the program returns.
RESULTS = -1


class OperandPlace(NamedTuple):
    """Where a program reads a value.

    - `operation`: the number of the operation that reads the value, or `RESULTS`.
    - `position`: the position of the value among the arguments of the operation, or among
        the results of the program.
    """

    operation: int
    position: int


def with_constants_at(
    jaxpr: Jaxpr, places: Sequence[OperandPlace]
) -> tuple[Jaxpr, list[Any]]:
    """The program with a new constant in each of these places, and what it reads there now.
    The new constants come after those that the program has, in the order of `places`."""
    # For each operation what it reads, and at the last index, `RESULTS`, what the program
    # returns.
    reads: list[list[Any]] = [list(eqn.invars) for eqn in jaxpr.eqns]
    reads.append(list(jaxpr.outvars))
    replaced = [reads[place.operation][place.position] for place in places]
    structs = [jax.ShapeDtypeStruct(x.aval.shape, x.aval.dtype) for x in replaced]
    constants = _variables_like(*structs)
    for place, constant in zip(places, constants):
        reads[place.operation][place.position] = constant
    *operands, results = reads
    eqns = [eqn.replace(invars=xs) for eqn, xs in zip(jaxpr.eqns, operands)]
    constvars = [*jaxpr.constvars, *constants]
    jaxpr = jaxpr.replace(eqns=eqns, outvars=results, constvars=constvars)
    return jaxpr, replaced


@ft.lru_cache(maxsize=128)
def _variables_like(*structs: jax.ShapeDtypeStruct) -> list[Any]:
    """Variables of programs for arrays like these."""
    # The constructor of a variable differs between versions of JAX. So JAX makes the
    # variables, as the inputs of a trace of the identity.
    return jax.make_jaxpr(lambda *xs: xs)(*structs).jaxpr.invars


# Made on import, since no such context may be made while other threads use JAX.
_number_of_traces = jax.make_user_context(0)


def with_traces_of(number: int) -> Any:
    """A context in which JAX uses a trace again only if the trace was made in a context of
    the same number. Outside of such contexts JAX uses the trace of an inner function, such
    as `diffrax.diffeqsolve`, again whenever its arguments are the same objects, although a
    function among them may compute something else by now."""
    return _number_of_traces(number)


def evaluated(jaxpr: Jaxpr, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
    """The results of a program. Error messages name the lines of the user's code that its
    operations come from."""
    return jax.core.eval_jaxpr(jaxpr, consts, *inputs)


def programs_in(eqn: JaxprEqn) -> list[Jaxpr]:
    """The programs that an operation runs, such as the branches of a conditional."""
    leaves = jtu.tree_leaves(eqn.params, is_leaf=is_program)
    return [getattr(x, "jaxpr", x) for x in leaves if is_program(x)]


def results_of_operation(eqn: JaxprEqn, args: Sequence[Any], params: Any) -> list[Any]:
    """The results of an operation of a jaxpr for these arguments, with `params` in place of
    its own parameters."""
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
    """The results of a program for these arguments, operation by operation.
    `results_of(eqn, args)` computes the results of one operation for its arguments."""
    # A `Jaxpr` has no constants.
    jaxpr = getattr(program, "jaxpr", program)
    consts = getattr(program, "consts", [])
    # The values of variables so far.
    values = dict(zip(jaxpr.constvars, consts)) | dict(zip(jaxpr.invars, args))

    def value_of(atom: Any) -> Any:
        return atom.val if isinstance(atom, Literal) else values[atom]

    for eqn in jaxpr.eqns:
        results = results_of(eqn, [value_of(atom) for atom in eqn.invars])
        values.update(zip(eqn.outvars, results))
    return [value_of(atom) for atom in jaxpr.outvars]


def has_blocking_lapack() -> bool:
    """Whether calls of LAPACK that run at the same time can block each other. They can on
    CPUs, where JAX shares out a batch in the pool of threads that makes the calls."""
    shares_out_batches = (0, 10, 0) <= jax.__version_info__ < (0, 11, 2)
    return shares_out_batches and jax.default_backend() == "cpu"


def stablehlo_module(program: Any) -> Any:
    """The module of MLIR for a program in StableHLO. `program` is its text, or what
    `compiler_ir("stablehlo")` of a lowered function returned."""
    if not isinstance(program, str):
        return program
    with make_ir_context():
        return ir.Module.parse(program)


def is_literal(x: Any) -> bool:
    """Whether the value of an array of Dr.Jit is known while a kernel is recorded, as that
    of a constant, or of an array that was computed from constants."""
    return x.state.name == "Literal"


class SolveState(NamedTuple):
    """The parts that are used here of the state of Diffrax's loop over steps.

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
    """The parts that are used here of a state of Diffrax's loop."""
    return SolveState(
        y=loop_state.y,
        num_steps=loop_state.num_steps,
        num_saved=loop_state.save_state.saveat_ts_index,
        ys=loop_state.save_state.ys,
    )


def without_derivatives(loop_state: Any) -> Any:
    """A state of Diffrax's loop without the state `y` of the equation, and without
    derivatives through the state of the solver. `with_y` adds a state of the equation."""
    dynamic, static = eqx.partition(loop_state.solver_state, eqx.is_array)
    solver_state = eqx.combine(jax.lax.stop_gradient(dynamic), static)
    # `y` becomes an object that is no array, so that using it by mistake is an error.
    return dataclasses.replace(loop_state, y=object(), solver_state=solver_state)


def with_y(loop_state: Any, y: PyTree[Array]) -> Any:
    """A state of Diffrax's loop with this state of the equation."""
    return eqx.tree_at(lambda state: state.y, loop_state, y)


def with_only_ys_differentiable(loop_state: Any) -> Any:
    """A state of Diffrax's loop of which only the saved states can be differentiated. For
    derivatives of anything else an error is raised."""
    ys = loop_state.save_state.ys
    refused = nondifferentiable_backward(loop_state, symbolic=False)
    return eqx.tree_at(lambda state: state.save_state.ys, refused, ys)


def run_steps(adjoint: Any, outer_while_loop: Callable, **kwargs: Any) -> Any:
    """Runs Diffrax's loop over steps for an adjoint. It calls `outer_while_loop` for the
    loop over steps. Inside of it is a loop over the times to save at, without derivatives.
    `kwargs` are the arguments of `adjoint.loop`."""
    return adjoint._loop(
        **kwargs,
        event=None,
        inner_while_loop=lax_while_loop,
        outer_while_loop=outer_while_loop,
    )


def saves_states(sub_saveat: diffrax.SubSaveAt) -> bool:
    """Whether the states themselves are saved, not a function of them."""
    # By default `fn` is a private function of Diffrax, the same object in each instance.
    return sub_saveat.fn is diffrax.SubSaveAt(t1=True).fn


class StepTimes(NamedTuple):
    """The times at which the steps of a solve begin and end, computed by its controller.

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
        # The state of a constant step size begins with the number of steps so far. After
        # `i - 1` steps the controller is asked for the times of the next step, of which
        # only the end is used here.
        _, *other_state = self.init_state.controller_state
        initial_time = self.init_state.tprev
        time_after_first_step = self.init_state.tnext
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
