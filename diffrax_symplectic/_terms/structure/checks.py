"""Checks that a system has the structure that a family of methods needs: by tracing what
the vector fields depend on, or by the user's assertion."""

import functools as ft
from collections.abc import Callable
from typing import Any, get_args, NamedTuple

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ..._arguments import check_pair, pair_fault
from ..._brownian import zeros_and_unravel
from ..._compat import at_trace_time, is_traced, unwrapped
from ..._custom_types import Args, RealScalarLike, Terms, Y
from ..._tableau import Structure
from ..constrained_drift import without_constraint
from ..dependence import Dependence
from ..drift_and_noise import control_struct, split_terms
from ..langevin import friction_apart, split_friction
from ..lifted import has_lifted
from ..symplectic_gradients import (
    asserted_structure,
    is_hamiltonian,
    structure_asserted_in,
)
from ..vector_fields import check_increments
from .assertion import is_contradicted
from .said_twice import check_drifts_differ


class Fault(NamedTuple):
    """Why a system does not have a structure.

    - `cause`: what is wrong, as a part of a sentence.
    - `advice`: what to do, in sentences.
    - `friction`: whether all that is wrong is a force of plain terms that depends on the
        momentum, such as friction.
    - `wrong_way_round`: whether nothing else would be wrong with the halves of the state
        exchanged.
    """

    cause: str
    advice: str
    friction: bool = False
    wrong_way_round: bool = False

    @property
    def reason(self) -> str:
        """The cause, and whether the state may be the wrong way round."""
        if not self.wrong_way_round:
            return self.cause
        return (
            f"{self.cause}. With the halves of the state exchanged it would be separable: "
            "is the state the wrong way round? It is `(p, q)`, momentum first, not "
            "(position, velocity)"
        )


def check_structure(
    structure: Structure,
    drift: Terms,
    noise: Terms,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
    solver: str,
) -> None:
    """Raises a `ValueError` unless a system has the structure that a solver needs."""
    check_increments(noise, t0, y0, args)
    check_drifts_differ(drift)
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
            # Their Hamiltonians are functions of both halves of the state, however they
            # are written.
            advice = f"For spins and complex amplitudes {_GENERAL}."
        raise ValueError(f"`{solver}` needs {needs}, but {fault.reason}. {advice}")

    if structure in ("separable", "separable and constant"):
        check_pair(y0)
        needs = "H0 = V(p) + U(t, q) and noise Hamiltonians H_k = U_k(t, q)"
        refuse(needs, separable_fault(drift, noise, t0, y0, args))
    # "constant" is additive, and constant in time.
    if structure in ("additive", "constant", "separable and constant"):
        needs = "additive noise, H_k = -sigma_k(t).q + gamma_k(t).p"
        refuse(needs, additive_fault(noise, t0, y0, args))
        if structure != "additive":
            needs = "additive noise that is constant in time"
            refuse(needs, constant_fault(noise, t0, y0, args))


def separable_fault(
    drift: Terms, noise: Terms, t0: RealScalarLike, y0: Y, args: Args
) -> Fault | None:
    """Why the system is not of the form `H0 = V(p) + U(t, q)`, `H_k = U_k(t, q)`; `None` if
    it is."""
    if advice := pair_fault(y0):
        return Fault("the state is not a pair (p, q)", advice)

    def traced(terms: Terms) -> list["_Traced"]:
        left = _not_asserted(terms, "separable")
        return [_Traced(term, _flow(term, t0, y0, args)) for term in left]

    # Apart from its friction, a drift is still one of a Hamiltonian, whose faults are named
    # by its derivatives.
    rest, friction = friction_apart(drift)
    if fault := _wrong_assertion("separable", rest, noise, t0, y0, args):
        return fault
    drift_flows = traced((*rest, *friction))
    noise_flows = traced(noise)
    unmoved = ft.partial(_is_zero, t0, y0, args)
    here = _faults(0, drift_flows, noise_flows, unmoved)
    if not here:
        return None
    # As it would be for (position, velocity), the order of many other packages.
    exchanged = _faults(1, drift_flows, noise_flows, unmoved)
    first = here[0]
    only_friction = all(fault.friction for fault in here)
    wrong_way_round = not only_friction and all(fault.friction for fault in exchanged)
    if wrong_way_round:
        only_friction = len(exchanged) > 0
    advice = f"{FRICTION} {first.advice}" if only_friction else first.advice
    return Fault(first.cause, advice, only_friction, wrong_way_round)


class _Traced(NamedTuple):
    """A term, and what the change of the state by it depends on."""

    term: diffrax.AbstractTerm
    flow: Dependence


class _Forbidden(NamedTuple):
    """A dependence that no drift of a separable system has.

    - `part`: selects a half of the change of the state.
    - `of`: selects, of the inputs `(t, y, control)`, what it must not depend on.
    - `derivative`: says so of a Hamiltonian.
    - `rate`: says so of a plain term.
    - `by_friction`: whether friction in a plain term does this.
    """

    part: Callable
    of: Callable
    derivative: str
    rate: str
    by_friction: bool = False


def _faults(
    p: int,
    drift: list[_Traced],
    noise: list[_Traced],
    unmoved: Callable[[diffrax.AbstractTerm, int], bool],
) -> list[Fault]:
    """All faults, if momenta are the first half of the state, `p = 0`, or the second,
    `p = 1`. `unmoved` says whether a noise term leaves a half of the state unchanged."""
    q = 1 - p

    def momenta(t: Any, y: Y, control: Any) -> PyTree:
        return y[p]

    def positions(t: Any, y: Y, control: Any) -> PyTree:
        return y[q]

    def of_momenta(change: Y) -> PyTree:
        return change[p]

    def of_positions(change: Y) -> PyTree:
        return change[q]

    forbidden = (
        _Forbidden(
            of_momenta, momenta, "dH0/dq depends on p", "dp/dt depend on p", True
        ),
        _Forbidden(of_positions, positions, "dH0/dp depends on q", "dq/dt depend on q"),
        _Forbidden(of_positions, _times, "dH0/dp depends on t", "dq/dt depend on t"),
    )
    faults = []
    beside = " besides H0" if len(drift) > 1 else ""
    for term, flow in drift:
        plain = not is_hamiltonian(term)
        advice = _advice("separable", term)
        for rule in forbidden:
            if not flow.independent(rule.of, rule.part):
                of_plain = f"a drift term{beside} makes {rule.rate}"
                cause = of_plain if plain else rule.derivative
                faults.append(Fault(cause, advice, plain and rule.by_friction))
    for term, flow in noise:
        plain = not is_hamiltonian(term)
        advice = _advice("separable", term)
        # The change of q is linear in the increment, so it is zero if it does not depend
        # on the increment.
        moves_q = not flow.independent(_increments, of_positions) and not unmoved(
            term, q
        )
        if moves_q:
            of_plain = "a noise term changes q, the second half of the state"
            faults.append(Fault(of_plain if plain else "dH_k/dp is not zero", advice))
        elif not flow.independent(momenta, of_momenta):
            of_plain = "a noise term changes p by an amount that depends on p"
            faults.append(Fault(of_plain if plain else "dH_k/dq depends on p", advice))
    return faults


def additive_fault(noise: Terms, t0: RealScalarLike, y0: Y, args: Args) -> Fault | None:
    """Why the noise is not additive; `None` if it does not depend on the state."""
    if fault := _wrong_assertion("additive", (), noise, t0, y0, args):
        return fault
    for term in _not_asserted(noise, "additive"):
        if not _flow(term, t0, y0, args).independent(_states):
            of = " = (-dH_k/dq, dH_k/dp)" if is_hamiltonian(term) else ""
            reason = f"the noise b_k{of} depends on the state"
            return Fault(reason, _advice("additive", term))
    return None


def constant_fault(noise: Terms, t0: RealScalarLike, y0: Y, args: Args) -> Fault | None:
    """Why additive noise is not constant; `None` if it does not depend on time."""
    for term in noise:
        if not _flow(term, t0, y0, args).independent(_times):
            return Fault("it depends on time", "Use `SRKs4`, which accepts such noise.")
    return None


def check_assertions(
    terms: diffrax.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args
) -> None:
    """Raises a `ValueError` if the values at `y0` contradict a `structure` that the user
    asserted. Programs of a solve, in which values are traced, cannot tell."""
    drift, _, noise = split_friction(without_constraint(terms))
    for structure, checked in (("separable", drift), ("additive", ())):
        if fault := _wrong_assertion(structure, checked, noise, t0, y0, args):
            raise ValueError(
                f'`structure="{structure}"` is wrong: {fault.cause}. {fault.advice}'
            )


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
    if all_terms:
        these = "`expectation` takes all terms"
        instead = ", or use `monte_carlo`"
    else:
        # A drift beside `H0` may be the correction from one sense to the other.
        if not all(map(is_hamiltonian, drift)):
            return
        noise = tuple(filter(is_hamiltonian, noise))
        these = "The terms of `hamiltonian_terms` are"
        instead = ""
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

    def change(t: RealScalarLike, y: Y, control: Any) -> Y:
        return term.vf_prod(t, y, args, control)

    return Dependence(change, t0, y0, control_struct(term, t0))


def _is_zero(
    t0: RealScalarLike, y0: Y, args: Args, term: diffrax.AbstractTerm, half: int
) -> bool:
    """Whether a plain noise term leaves one half of the state unchanged because its matrix
    has a block of zeros that is known while tracing."""
    if is_hamiltonian(term):
        return False
    struct = control_struct(term, t0)
    with at_trace_time():
        flat, unravel = zeros_and_unravel(struct)
        changes = [
            unwrapped(term).vf_prod(t0, y0, args, unravel(unit))[half]
            for unit in jnp.eye(flat.size, dtype=flat.dtype)
        ]
    leaves = jtu.tree_leaves(changes)
    return not any(is_traced(leaf) or np.asarray(leaf).any() for leaf in leaves)


# Parts of the inputs of `_flow`.
def _times(t: Any, y: Y, control: Any) -> Any:
    return t


def _states(t: Any, y: Y, control: Any) -> Y:
    return y


def _increments(t: Any, y: Y, control: Any) -> Any:
    return control


def _not_asserted(terms: Terms, structure: str) -> list[diffrax.AbstractTerm]:
    """The terms of which the user has not asserted the structure."""
    return [term for term in terms if asserted_structure(term) != structure]


def _wrong_assertion(
    structure: str,
    drift: Terms,
    noise: Terms,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
) -> Fault | None:
    """The fault of the first term that the user asserted to have this structure, and that
    does not have it at `y0`; `None` if there is none, or if values are traced. For
    "additive" pass no drift: only noise can break it."""
    causes = {
        (
            "separable",
            False,
        ): "at or near `y0` H0 mixes p and q, or dH0/dp depends on t",
        ("separable", True): "at or near `y0` a noise Hamiltonian depends on p",
        ("additive", True): "at or near `y0` the noise depends on the state",
    }
    for is_noise, terms in ((False, drift), (True, noise)):
        for term in terms:
            if asserted_structure(term) != structure:
                continue
            if is_contradicted(structure, is_noise, term, t0, y0, args):
                advice = (
                    f'Leave `structure="{structure}"`, which is wrong here, out of '
                    f"`{structure_asserted_in(term)}`, and {_GENERAL}."
                )
                return Fault(causes[structure, is_noise], advice)
    return None


def _advice(structure: str, term: diffrax.AbstractTerm) -> str:
    """How to write a term with this structure so that tracing shows it."""
    how = {
        "separable": "H0 as a sum `V(p) + U(t, q)`, each summand of p or q alone",
        "additive": "each H_k as a function linear in p and q, such as `-sigma * q`",
    }[structure]
    maker = structure_asserted_in(term)
    # The structure of plain terms, and of the noise of a bath, cannot be asserted.
    instead = (
        "" if maker is None else f', or pass `structure="{structure}"` to `{maker}`'
    )
    general = _GENERAL_BATH if maker == "langevin_terms" else _GENERAL
    return (
        "Variables also count if they cancel, are multiplied by zero, are printed, or "
        f"share an array with others: in that case write {how}{instead}. Otherwise "
        f"{general}."
    )


_GENERAL = (
    "use a solver for general systems, for example `ImplicitMidpoint` or `StrangGauss`"
)
_GENERAL_BATH = (
    "use `BAOAB(ImplicitMidpoint())`, for any H0 that is quadratic in p, or a solver for "
    "general systems, such as `ImplicitMidpoint`"
)


FRICTION = (
    "Take friction from `langevin_terms(H0, friction, temperature, path)`: solvers for "
    "heat baths, such as `BAOAB()`, or `BAOAB(ImplicitMidpoint())` for masses that depend "
    "on positions, treat it by a step of its own. (All need a kinetic energy that is "
    "quadratic in p.)"
)
