"""Checks that a system has the structure that a family of methods needs: by tracing what
the vector fields depend on, or by the user's assertion."""

import functools as ft
from collections.abc import Callable
from typing import get_args, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np

from .._arguments import check_pair, pair_fault
from .._brownian import raveled
from .._compat import unwrapped, ω
from .._custom_types import Args, RealScalarLike, Y
from .._tableau import Structure
from .dependence import Dependence
from .hamiltonian import asserted_structure, has_lifted, is_hamiltonian
from .langevin import friction_apart
from .vector_fields import apply, check_increments, control_struct, split_terms


class Fault(NamedTuple):
    """Why a system does not have a structure, advice, and whether the fault is a force of
    plain terms that depends on the momentum, such as friction."""

    reason: str
    advice: str
    friction: bool = False


def check_structure(
    structure: Structure,
    drift: tuple,
    noise: tuple,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
    solver: str,
) -> None:
    """Raises a `ValueError` unless a system has the structure that a solver needs."""
    check_increments(noise, t0, y0, args)
    if structure not in get_args(Structure):
        raise ValueError(
            f"`structure` of the tableau of `{solver}` must be one of "
            f"{get_args(Structure)}; got {structure!r}."
        )

    def refuse(needs: str, fault: Fault | None) -> None:
        if fault is None:
            return
        advice = fault.advice
        if has_lifted((drift, noise)):
            advice = f"For spins and complex amplitudes {_GENERAL}."
        raise ValueError(f"`{solver}` needs {needs}, but {fault.reason}. {advice}")

    if structure in ("separable", "separable and constant"):
        check_pair(y0)
        needs = "H0 = V(p) + U(t, q) and noise Hamiltonians H_k = U_k(t, q)"
        refuse(needs, separable_fault(drift, noise, t0, y0, args))
    if structure in ("additive", "constant", "separable and constant"):
        needs = "additive noise, H_k = -sigma_k(t).q + gamma_k(t).p"
        refuse(needs, additive_fault(noise, t0, y0, args))
        if structure != "additive":
            needs = "additive noise that is constant in time"
            refuse(needs, constant_fault(noise, t0, y0, args))


def separable_fault(
    drift: tuple, noise: tuple, t0: RealScalarLike, y0: Y, args: Args
) -> Fault | None:
    """Why the system is not of the form `H0 = V(p) + U(t, q)`, `H_k = U_k(t, q)`; `None` if
    it is."""
    if fault := pair_fault(y0):
        return Fault("the state is not a pair (p, q)", fault)
    flows = lambda terms: [
        (term, _flow(term, t0, y0, args)) for term in _not_asserted(terms, "separable")
    ]
    still = ft.partial(_is_zero, t0, y0, args)
    of = flows(sum(friction_apart(drift), ())), flows(noise)
    here = _faults(0, *of, still)
    if not here:
        return None
    exchanged = _faults(1, *of, still)
    only_friction = lambda faults: all(fault.friction for fault in faults)
    reason, advice, _ = here[0]
    friction = only_friction(here)
    if not friction and only_friction(exchanged):
        reason, friction = f"{reason}. {WRONG_WAY_ROUND}", len(exchanged) > 0
    return Fault(reason, f"{FRICTION} {advice}" if friction else advice, friction)


def _faults(
    p: int,
    drift: list[tuple[diffrax.AbstractTerm, Dependence]],
    noise: list[tuple[diffrax.AbstractTerm, Dependence]],
    still: Callable[[diffrax.AbstractTerm, int], bool],
) -> list[Fault]:
    """The faults, if momenta are the first half of the state, `p = 0`, or the second,
    `p = 1`. `still` says whether a noise term leaves a half of the state unchanged."""
    q, faults, advice = 1 - p, [], _advice("separable")
    dp, dq = (lambda out: out[p]), (lambda out: out[q])
    of_p, of_q = (lambda t, y, control: y[p]), (lambda t, y, control: y[q])
    beside = " besides H0" if len(drift) > 1 else ""
    for term, flow in drift:
        for part, of, derivative, rate in (
            (dp, of_p, "dH0/dq depends on p", "dp/dt depend on p"),
            (dq, of_q, "dH0/dp depends on q", "dq/dt depend on q"),
            (dq, _of_t, "dH0/dp depends on t", "dq/dt depend on t"),
        ):
            if not flow.independent(of, part):
                plain = not is_hamiltonian(term)
                reason = f"a drift term{beside} makes {rate}" if plain else derivative
                faults.append(Fault(reason, advice, friction=plain and part is dp))
    for term, flow in noise:
        hamiltonian = is_hamiltonian(term)
        # The change of q is linear in the increment, so it is zero if it does not depend
        # on the increment.
        if not flow.independent(lambda t, y, control: control, dq) and not still(
            term, q
        ):
            plain = "a noise term changes q, the second half of the state"
            reason = "dH_k/dp is not zero" if hamiltonian else plain
            faults.append(Fault(reason, advice))
        elif not flow.independent(of_p, dp):
            plain = "a noise term changes p by an amount that depends on p"
            reason = "dH_k/dq depends on p" if hamiltonian else plain
            faults.append(Fault(reason, advice))
    return faults


def additive_fault(noise: tuple, t0: RealScalarLike, y0: Y, args: Args) -> Fault | None:
    """Why the noise is not additive; `None` if it does not depend on the state."""
    for term in _not_asserted(noise, "additive"):
        if not _flow(term, t0, y0, args).independent(lambda t, y, control: y):
            of = " = (-dH_k/dq, dH_k/dp)" if is_hamiltonian(term) else ""
            reason = f"the noise b_k{of} depends on the state"
            return Fault(reason, _advice("additive"))
    return None


def constant_fault(noise: tuple, t0: RealScalarLike, y0: Y, args: Args) -> Fault | None:
    """Why additive noise is not constant; `None` if it does not depend on time."""
    for term in noise:
        if not _flow(term, t0, y0, args).independent(_of_t):
            return Fault("it depends on time", "Use `SRKs4`, which accepts such noise.")
    return None


def check_stratonovich(
    terms: diffrax.AbstractTerm,
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
    *,
    all_terms: bool = False,
) -> None:
    """Raises a `ValueError` if an Ito solver gets terms in the sense of Stratonovich: those
    from Hamiltonians, and in `expectation` `all_terms`. Both senses agree for additive
    noise, and for noise that changes only `p` and depends only on `q`."""
    if not isinstance(solver, diffrax.AbstractItoSolver):
        return
    drift, noise = split_terms(terms)
    these, instead = "`expectation` takes all terms", ", or use `monte_carlo`"
    if not all_terms:
        # A drift beside `H0` may be the correction from one sense to the other.
        if not all(map(is_hamiltonian, drift)):
            return
        noise = tuple(filter(is_hamiltonian, noise))
        these, instead = "The terms of `hamiltonian_terms` are", ""
    if additive_fault(noise, t0, y0, args) and separable_fault((), noise, t0, y0, args):
        raise ValueError(
            f"`{type(solver).__name__}` solves equations in the sense of Ito. {these} in "
            "the sense of Stratonovich, and here the two differ. Use a solver of this "
            "package, or a Stratonovich solver of Diffrax such as `diffrax.Heun`. If you "
            f"mean the Ito equation, add its drift correction{instead}."
        )


def _flow(term: diffrax.AbstractTerm, t0, y0: Y, args: Args) -> Dependence:
    """The dependencies of the change by a term on time, state and control."""
    t0 = jnp.asarray(t0, jnp.result_type(float))
    control = control_struct(term, t0)
    change = lambda t, y, control: term.vf_prod(t, y, args, control)
    return Dependence(change, t0, y0, control)


def _is_zero(t0, y0: Y, args: Args, term: diffrax.AbstractTerm, half: int) -> bool:
    """Whether a plain noise term leaves one half of the state unchanged because its matrix
    has a block of zeros that is known while tracing."""
    if is_hamiltonian(term):
        return False
    struct = control_struct(term, t0)
    with jax.ensure_compile_time_eval():
        flat, unravel = raveled(struct)
        changes = [
            unwrapped(term).vf_prod(t0, y0, args, unravel(unit))[half]
            for unit in jnp.eye(flat.size, dtype=flat.dtype)
        ]
    known = lambda x: not isinstance(x, jax.core.Tracer)
    return all(known(x) and not np.asarray(x).any() for x in jtu.tree_leaves(changes))


def _of_t(t, y, control):
    return t


def _not_asserted(terms: tuple, structure: str) -> list:
    return [term for term in terms if asserted_structure(term) != structure]


def _advice(structure: str) -> str:
    how = {
        "separable": "H0 as a sum `V(p) + U(t, q)`, each summand of p or q alone",
        "additive": "each H_k as a function linear in p and q, such as `-sigma * q`",
    }[structure]
    return (
        "Variables also count if they cancel, are multiplied by zero, are printed, or "
        f"share an array with others: in that case write {how}, or pass "
        f'`structure="{structure}"` to `hamiltonian_terms`. Otherwise {_GENERAL}.'
    )


_GENERAL = (
    "use a solver for general systems, for example `ImplicitMidpoint` or `StrangGauss`"
)


WRONG_WAY_ROUND = (
    "With the halves of the state exchanged it would be separable: is the state the wrong "
    "way round? It is `(p, q)`, momentum first, not (position, velocity)"
)
FRICTION = (
    "Take friction from `langevin_terms(H0, friction, temperature, path)`: `BAOAB()`, "
    "`LangevinMiddle()` and `Damped(solver)` treat it by a step of its own."
)


def commuting(noise: tuple, t0: RealScalarLike, y0: Y, args: Args) -> bool:
    """Whether the brackets `Db_l b_k - Db_k b_l` of all noises vanish at random states, for
    these `t0` and `args`; false if this cannot be tested. This is not a proof.

    The bracket is bilinear, so it is tested for two random combinations of the noises.
    """
    t0 = jnp.asarray(t0, jnp.result_type(float))
    struct = [control_struct(term, t0) for term in noise]
    flat, unravel = raveled((jtu.tree_map(jnp.asarray, y0), struct, struct))
    largest = lambda y: jnp.max(jnp.abs(jfu.ravel_pytree(y)[0]))

    @eqx.filter_jit
    @jax.vmap
    def sizes(point):
        y, x, z = unravel(point)
        b = lambda control: lambda y: apply(noise, control, args, t0, y)
        first = jax.jvp(b(z), (y,), (b(x)(y),))[1]
        second = jax.jvp(b(x), (y,), (b(z)(y),))[1]
        bracket = (first**ω - second**ω).ω
        return largest(first), largest(bracket)

    try:
        with jax.disable_jit(False):
            # Most functions are defined between 0 and 1.
            draw = lambda law: law(jr.key(0), (4, *flat.shape), flat.dtype)
            points = jnp.concatenate([draw(jr.normal), draw(jr.uniform)])
            size, bracket = sizes(points)
            finite = jnp.isfinite(size) & jnp.isfinite(bracket)
            small = bracket <= 1e3 * jnp.finfo(size.dtype).eps * size
            found = jax.block_until_ready(jnp.any(finite) & jnp.all(small | ~finite))
    except RuntimeError:
        # From a user's `equinox.error_if`, at states that the user did not choose.
        return False
    # Inside `jax.jit` the result is not known.
    return not isinstance(found, jax.core.Tracer) and bool(found)
