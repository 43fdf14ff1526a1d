"""Whether a system has the structure that a family of methods relies on."""

from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Bool, PRNGKeyArray, PyTree

from ._compat import ω
from ._custom_types import Args, RealScalarLike, Y
from ._effect_free import evaluate_without_effects
from ._hamiltonian import asserted_structure, check_pair, is_hamiltonian, pair_fault
from ._terms import apply


class Fault(NamedTuple):
    """Why a system does not have a structure, and what may be done about it."""

    reason: str
    advice: str


def check_separable(
    drift: tuple, noise: tuple, t0: RealScalarLike, y0: Y, args: Args, solver: str
) -> None:
    """Raises a `ValueError`, while tracing, unless `H0 = V(p) + U(t, q)` and the noise
    Hamiltonians are functions of `t` and `q` alone."""
    check_pair(y0)
    needs = "needs H0 = V(p) + U(t, q) and noise Hamiltonians H_k = U_k(t, q)"
    _refuse(solver, needs, separable_fault(drift, noise, t0, y0, args))


def check_additive(
    noise: tuple, t0: RealScalarLike, y0: Y, args: Args, solver: str, constant: bool
) -> None:
    """Raises a `ValueError`, while tracing, unless the noise does not depend on the state
    nor, if it has to be `constant`, on time."""
    needs = "needs additive noise, H_k = -sigma_k(t).q + gamma_k(t).p"
    _refuse(solver, needs, additive_fault(noise, t0, y0, args))
    if constant:
        needs = "needs additive noise that is constant in time"
        _refuse(solver, needs, constant_fault(noise, t0, y0, args))


def _refuse(solver: str, needs: str, fault: Fault | None) -> None:
    if fault is not None:
        raise ValueError(f"`{solver}` {needs}, but {fault.reason}. {fault.advice}")


def separable_fault(
    drift: tuple, noise: tuple, t0: RealScalarLike, y0: Y, args: Args
) -> Fault | None:
    """Why the system is not of the form `H0 = V(p) + U(t, q)`, `H_k = U_k(t, q)`; `None`
    if it is of this form."""
    if fault := pair_fault(y0):
        return Fault("the state is not a pair (p, q)", fault)
    for term in _not_asserted(drift, "separable"):
        from_H0 = is_hamiltonian(term) or len(drift) == 1
        for part, of, derivative, dependence in (
            (0, "p", "d(dH0/dq)/dp", "dp/dt depend on p"),
            (1, "q", "d(dH0/dp)/dq", "dq/dt depend on q"),
            (1, "t", "d(dH0/dp)/dt", "dq/dt depend on t"),
        ):
            independent = _independent(part, of, term, t0, y0, args)
            if fault := _fault(independent, derivative):
                if from_H0 or independent is None:
                    return fault
                beside = f"a drift term beside that of H0 makes {dependence}"
                return Fault(beside, f"{FRICTION} {_ADVICE}")
    for term in _not_asserted(noise, "separable"):
        # The change of q is linear in the increment: if it does not depend on the
        # increment, it is zero.
        for part, of in ((1, "control"), (0, "p")):
            independent = _independent(part, of, term, t0, y0, args)
            if fault := _fault(independent, "dH_k/dp"):
                return fault
    return None


def additive_fault(noise: tuple, t0: RealScalarLike, y0: Y, args: Args) -> Fault | None:
    """Why the noise is not additive; `None` if it does not depend on the state."""
    derivative = (
        "db_k/dy, the derivative of the noise b_k = (-dH_k/dq, dH_k/dp) by the state,"
    )
    for term in _not_asserted(noise, "additive"):
        if fault := _fault(_independent(None, "y", term, t0, y0, args), derivative):
            return fault
    return None


def constant_fault(noise: tuple, t0: RealScalarLike, y0: Y, args: Args) -> Fault | None:
    """Why additive noise is not constant; `None` if it does not depend on time."""
    for term in noise:
        fault = _fault(_independent(None, "t", term, t0, y0, args), "db_k/dt")
        if fault is not None:
            return Fault(fault.reason, f"Use `SRKs4`, or else another one. {_ADVICE}")
    return None


def commuting(noise: tuple, t0: RealScalarLike, y0: Y, args: Args) -> bool:
    """Whether the brackets `Db_l b_k - Db_k b_l` of all noises vanish at random states, for
    these `t0` and `args`. False if this cannot be tested.

    The bracket is bilinear. So it is enough to test the bracket of two random linear
    combinations of the noises.
    """
    t0 = jnp.asarray(t0, jnp.result_type(float))
    struct = eqx.filter_eval_shape(lambda: [term.contr(t0, t0) for term in noise])
    control = jtu.tree_map(jnp.zeros_like, struct)

    def brackets(y, x, z):
        along = lambda control: lambda y: apply(noise, control, args, t0, y)
        first = jax.jvp(along(z), (y,), (along(x)(y),))[1]
        second = jax.jvp(along(x), (y,), (along(z)(y),))[1]
        return first, (first**ω - second**ω).ω

    return _small_at_random_points(brackets, (y0, control, control)) is True


def _fault(independent: bool | None, derivative: str) -> Fault | None:
    if independent:
        return None
    if independent is None:
        reason = (
            f"whether {derivative} vanishes could not be tested, because the derivatives "
            "of the Hamiltonians were not finite at any of the points tried"
        )
        return Fault(reason, _UNTESTED)
    return Fault(f"{derivative} does not vanish", _ADVICE)


_ADVICE = (
    "Use a solver for the general structure, for example `ImplicitMidpoint` or `SRKw1`. "
    "(An array in `args` stands for any value. If the derivative vanishes for yours, pass "
    "`structure=` to `hamiltonian_terms`.)"
)
_UNTESTED = (
    "Pass `structure=` to `hamiltonian_terms`, write the Hamiltonians so that variables "
    "that cancel do not enter at all, or use a solver for the general structure, for "
    "example `ImplicitMidpoint` or `SRKw1`."
)
FRICTION = "Friction -gamma p is what `Damped(solver, gamma)` is for."


def _not_asserted(terms: tuple, structure: str) -> list:
    return [term for term in terms if asserted_structure(term) != structure]


def _independent(
    part: int | None, of: str, term: diffrax.AbstractTerm, t0, y0: Y, args: Args
) -> bool | None:
    """Whether the change of the state by `term` does not depend on `t`, `y`, `p`, `q`, or
    `control`, whichever `of` names. With `part` only its first or second half counts.

    First JAX traces the derivative. If the variable does not enter the result at all, JAX
    finds that the derivative is zero from the rules of differentiation alone. If it does
    enter, it may still cancel. Then the derivative is evaluated at random points; the
    result is `None` if it is finite at none of them.
    """
    t0 = jnp.asarray(t0, jnp.result_type(float))
    control = jtu.tree_map(jnp.zeros_like, eqx.filter_eval_shape(term.contr, t0, t0))
    variable = _VARIABLES[of]

    def change(x, *inputs):
        term, t, y, args, control = eqx.tree_at(variable, inputs, x)
        return term.vf_prod(t, y, args, control)

    inputs = (term, t0, y0, args, control)
    x = variable(inputs)
    select = lambda out: out if part is None else out[part]
    if _flows_nowhere(lambda x: select(change(x, *inputs)), x):
        return True

    def derivative(x, tangent, *inputs):
        value, rate = jax.jvp(lambda x: change(x, *inputs), (x,), (tangent,))
        if of == "control":
            # One half of the rate is compared with both halves of the noise.
            return value, tuple(r if i == part else 0 * r for i, r in enumerate(rate))
        return select(value), select(rate)

    return _small_at_random_points(derivative, (x, x, *inputs))


# Where each variable stands among a term and the inputs of its vector field.
_VARIABLES = {
    "t": lambda inputs: inputs[1],
    "y": lambda inputs: inputs[2],
    "p": lambda inputs: inputs[2][0],
    "q": lambda inputs: inputs[2][1],
    "control": lambda inputs: inputs[4],
}


def _flows_nowhere(fn: Callable, x: PyTree) -> bool:
    """Whether the derivative of `fn` is zero by the rules of differentiation alone."""
    zero = []

    @jax.custom_jvp
    def observe(*leaves):
        return leaves

    def rule(primals, tangents):
        zero.append(all(isinstance(t, SymbolicZero) for t in tangents))
        return primals, tuple(jnp.zeros(p.shape, p.dtype) for p in primals)

    observe.defjvp(rule, symbolic_zeros=True)
    observed = lambda x: observe(*map(jnp.asarray, jtu.tree_leaves(fn(x))))
    jax.eval_shape(lambda x: jax.jvp(observed, (x,), (x,)), x)
    return all(zero)


def _small_at_random_points(fn: Callable, inputs: PyTree) -> bool | None:
    """Whether, of `fn(*inputs) -> (reference, value)`, the value is rounding error next
    to the reference, with every floating-point array that enters drawn at random; `None`
    if they were finite at no point."""
    dynamic, static = eqx.partition(inputs, eqx.is_array)
    flat, treedef = jtu.tree_flatten(dynamic)

    def flat_fn(*flat):
        return fn(*eqx.combine(jtu.tree_unflatten(treedef, flat), static))

    closed = jax.make_jaxpr(flat_fn)(*flat)
    # Arrays that the user's functions capture keep their values, unless they are traced.
    is_traced = [isinstance(c, jax.core.Tracer) for c in closed.consts]

    def sizes(seed, positive):
        # Inputs are drawn within the program, so that those that it does not read are
        # never made.
        keys = iter(jr.split(jr.key(seed), len(closed.consts) + len(flat)))
        draw = lambda x: _draw(x, next(keys), positive)
        consts = [draw(c) if new else c for c, new in zip(closed.consts, is_traced)]
        out = evaluate_without_effects(closed.jaxpr, consts, [draw(x) for x in flat])
        half = len(out) // 2
        reference, value = (
            jnp.concatenate([jnp.ravel(x) for x in part])
            for part in (out[:half], out[half:])
        )
        finite = jnp.isfinite(reference) & jnp.isfinite(value)
        largest = lambda x: jnp.max(jnp.abs(x), initial=0, where=finite)
        return largest(reference), largest(value), jnp.any(finite)

    tested = False
    with jax.disable_jit(False):
        # Once it is compiled it runs at once, also while JAX traces what surrounds it.
        program = jax.jit(sizes).lower(np.uint32(0), np.bool_(False)).compile()
        # Every other time the points lie between 0 and 1, where most functions are defined
        # even if they are not defined everywhere.
        for i in range(8):
            out = program(np.uint32(i), np.bool_(i % 2 == 1))
            size, error, finite = map(np.asarray, out)
            tested = tested or bool(finite)
            if error > 1e3 * np.finfo(size.dtype).eps * size:
                return False
    return True if tested else None


def _draw(x: Array, key: PRNGKeyArray, positive: Bool[Array, ""]) -> Array:
    if jnp.issubdtype(x.dtype, jnp.floating):
        draw = lambda law: law(key, x.shape, x.dtype)
        return jnp.where(positive, draw(jr.uniform), draw(jr.normal))
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jr.key(0, impl=jr.key_impl(x)), x.shape)
    return jnp.ones(x.shape, x.dtype)
