"""Checks that a system has the structure that a family of methods needs: by tracing what
the vector fields depend on, or by the user's assertion.

Here a Hamiltonian term is one from `hamiltonian_terms` or `langevin_terms`. A plain term is
any other, such as a `diffrax.ODETerm` of the user's.

The state is a pair `(p, q)`. Its first element, number 0, holds the momenta, and its second
element, number 1, the positions. They are called the halves of the state.
"""

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
from ..drift_and_noise import (
    control_struct,
    friction_apart,
    split_friction,
    split_terms,
)
from ..lifted import has_lifted
from ..paths import brownian_paths
from ..symplectic_gradients import (
    asserted_structure,
    AssertedStructure,
    is_hamiltonian,
    name_of_maker,
)
from ..vector_fields import check_increments
from .assertion import contradicts_assertion
from .said_twice import check_drifts_differ


# Advice in messages.
_GENERAL = (
    "use a solver for general systems, for example `ImplicitMidpoint` or `StrangGauss`"
)
_GENERAL_BATH = (
    "use `BAOAB(ImplicitMidpoint())`, for any H0 that is quadratic in p, or a solver for "
    "general systems, such as `ImplicitMidpoint`. "
    "A force that is not the gradient of a potential, as of an active particle, is no part "
    "of H0, and no `structure` makes it one: add it as a term of its own, `diffrax."
    "MultiTerm(*terms.terms, diffrax.ODETerm(lambda t, y, args: (force, zeros)))`, which "
    "`BAOAB()` takes for a force of t and q, and `BAOAB(ImplicitMidpoint())` for any."
)
FRICTION = (
    "A decay of the momenta, -p / tau, is another equation than friction on the "
    "velocities, -G dH0/dp, unless H0 is quadratic in p: keep its term, and use a solver "
    "for general systems, for example `ImplicitMidpoint`. Take friction on the velocities "
    "from `langevin_terms(H0, friction, temperature, path)`: solvers for heat baths, such "
    "as `BAOAB()`, or `BAOAB(ImplicitMidpoint())` for masses that depend on positions, "
    "treat it by a step of its own. (All need a kinetic energy that is quadratic in p.)"
)


# Terms, each with what the change of the state by the term depends on.
_TracedTerms = list[tuple[diffrax.AbstractTerm, Dependence]]


class Fault(NamedTuple):
    """Why a system does not have a structure.

    - `cause`: what is wrong, as a part of a sentence.
    - `advice`: what to do, in sentences.
    - `friction`: whether all that is wrong is what a friction would cause: in plain terms,
        the change of the momenta depends on the momenta.
    - `wrong_way_round`: whether the state seems to be `(q, p)`: with its halves exchanged
        nothing is wrong, or only what a friction would cause. Then `friction` holds for the
        exchanged halves.
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
    solver_name: str,
) -> None:
    """Raises a `ValueError` unless a system has the `structure` that a solver needs. Also
    raises one if increments do not fit a vector field, or if two drifts are the same."""
    check_increments(noise, t0, y0, args)
    check_drifts_differ(drift)
    if structure not in get_args(Structure):
        raise ValueError(
            f"`structure` of the tableau of `{solver_name}` must be one of "
            f"{get_args(Structure)}; got {structure!r}."
        )

    def raise_if(fault: Fault | None, needs: str) -> None:
        """Raises the error for a fault, if there is one. `needs` is the form of a system
        that the solver needs, in words."""
        if fault is None:
            return
        advice = fault.advice
        if has_lifted((drift, noise)):
            # Hamiltonians of spins or complex amplitudes are functions of both halves of
            # the state, however they are written.
            advice = f"For spins and complex amplitudes {_GENERAL}."
        raise ValueError(f"`{solver_name}` needs {needs}, but {fault.reason}. {advice}")

    if structure in ("separable", "separable and constant"):
        check_pair(y0)
        fault = separable_fault(drift, noise, t0, y0, args)
        raise_if(fault, "H0 = V(p) + U(t, q) and noise Hamiltonians H_k = U_k(t, q)")
    # A "constant" structure is additive, and constant in time.
    if structure in ("additive", "constant", "separable and constant"):
        fault = additive_fault(noise, t0, y0, args)
        raise_if(fault, "additive noise, H_k = -sigma_k(t).q + gamma_k(t).p")
    if structure in ("constant", "separable and constant"):
        fault = constant_fault(noise, t0, y0, args)
        raise_if(fault, "additive noise that is constant in time")


def separable_fault(
    drift: Terms, noise: Terms, t0: RealScalarLike, y0: Y, args: Args
) -> Fault | None:
    """Why the system is not of the form `H0 = V(p) + U(t, q)`, `H_k = U_k(t, q)`; `None` if
    it is.

    If something other than friction is wrong with the state `(p, q)`, the state may be
    (position, velocity), in the order of many other packages. So the system is also checked
    with the halves of the state exchanged. The flags of the fault follow from what is wrong
    in each order:

    | as `(p, q)`   | with exchanged halves | `friction` | `wrong_way_round` |
    | ------------- | --------------------- | ---------- | ----------------- |
    | only friction | (not checked)         | true       | false             |
    | anything else | nothing               | false      | true              |
    | anything else | only friction         | true       | true              |
    | anything else | anything else         | false      | false             |
    """
    if advice := pair_fault(y0):
        return Fault("the state is not a pair (p, q)", advice)
    # The friction of `langevin_terms` becomes a term of its own. Then the faults of the
    # rest of the drift are those of its Hamiltonian, and messages name derivatives of H0.
    frictionless, friction = friction_apart(drift)
    if fault := _wrong_assertion("separable", frictionless, noise, t0, y0, args):
        return fault

    def traced(terms: Terms) -> _TracedTerms:
        """The terms whose structure the user has not asserted, and which so are checked,
        each with what it depends on."""
        to_trace = [term for term in terms if asserted_structure(term) != "separable"]
        return [(term, _dependence(term, t0, y0, args)) for term in to_trace]

    traced_drift = traced((*frictionless, *friction))
    traced_noise = traced(noise)

    def faults_if(momenta: int) -> list[Fault]:
        """All reasons why the system is not separable, if the half of the state with the
        number `momenta`, 0 or 1, holds the momenta."""
        drift_faults = _drift_faults(traced_drift, momenta)
        return drift_faults + _noise_faults(traced_noise, momenta, t0, y0, args)

    faults = faults_if(momenta=0)
    if len(faults) == 0:
        return None
    # Of several faults the first one is reported.
    cause = faults[0].cause
    advice = faults[0].advice
    advice_on_friction = f"{FRICTION} {advice}"
    # The rows of the table, from the first to the last.
    if all(fault.friction for fault in faults):
        return Fault(cause, advice_on_friction, friction=True)
    if_exchanged = faults_if(momenta=1)
    if len(if_exchanged) == 0:
        return Fault(cause, advice, wrong_way_round=True)
    if all(fault.friction for fault in if_exchanged):
        return Fault(cause, advice_on_friction, friction=True, wrong_way_round=True)
    return Fault(cause, advice)


def _drift_faults(traced_drift: _TracedTerms, momenta: int) -> list[Fault]:
    """The reasons why drift terms are not those of a separable system, if the half of the
    state with the number `momenta`, 0 or 1, holds the momenta."""
    positions = 1 - momenta
    # Each rule, `(half, on, ...)`: the change of this half of the state must not depend on
    # this input. Then what is wrong otherwise, as said of a Hamiltonian and a plain term.
    rules = (
        (momenta, momenta, "dH0/dq depends on p", "dp/dt depend on p"),
        (positions, positions, "dH0/dp depends on q", "dq/dt depend on q"),
        (positions, "t", "dH0/dp depends on t", "dq/dt depend on t"),
    )
    beside = " besides H0" if len(traced_drift) > 1 else ""
    faults = []
    for term, dependence in traced_drift:
        advice = _advice("separable", term)
        for half, on, in_hamiltonian, in_plain in rules:
            if not _depends(dependence, half, on):
                continue
            if is_hamiltonian(term):
                faults.append(Fault(in_hamiltonian, advice))
            else:
                cause = f"a drift term{beside} makes {in_plain}"
                # A friction breaks only the first rule, that of the momenta.
                faults.append(Fault(cause, advice, friction=half == momenta))
    return faults


def _noise_faults(
    traced_noise: _TracedTerms, momenta: int, t0: RealScalarLike, y0: Y, args: Args
) -> list[Fault]:
    """The reasons why noise terms are not those of a separable system, if the half of the
    state with the number `momenta`, 0 or 1, holds the momenta. At most one for each term.
    """
    positions = 1 - momenta
    faults = []
    for term, dependence in traced_noise:
        # The change of q is linear in the increment of the noise, the control. So it is
        # zero if it does not depend on the increment.
        may_move_q = _depends(dependence, positions, on="control")
        if may_move_q and not _keeps_half(term, positions, t0, y0, args):
            in_hamiltonian = "dH_k/dp is not zero"
            in_plain = "a noise term changes q, the second half of the state"
        elif _depends(dependence, momenta, on=momenta):
            in_hamiltonian = "dH_k/dq depends on p"
            in_plain = "a noise term changes p by an amount that depends on p"
        else:
            continue
        cause = in_hamiltonian if is_hamiltonian(term) else in_plain
        faults.append(Fault(cause, _advice("separable", term)))
    return faults


def _depends(dependence: Dependence, half: int, on: int | str) -> bool:
    """Whether the change of one half of the state, 0 or 1, depends on an input: on a half
    of the state, 0 or 1, on the time `"t"`, or on the `"control"`."""

    def read(t: Any, y: Y, control: Any) -> PyTree:
        return {0: y[0], 1: y[1], "t": t, "control": control}[on]

    return not dependence.independent(read, lambda change: change[half])


def additive_fault(noise: Terms, t0: RealScalarLike, y0: Y, args: Args) -> Fault | None:
    """Why the noise is not additive; `None` if it is additive: if it does not depend on the
    state."""
    if fault := _wrong_assertion("additive", (), noise, t0, y0, args):
        return fault
    for term in noise:
        if asserted_structure(term) == "additive":
            continue
        if not _dependence(term, t0, y0, args).independent(lambda t, y, control: y):
            gradient = " = (-dH_k/dq, dH_k/dp)" if is_hamiltonian(term) else ""
            cause = f"the noise b_k{gradient} depends on the state"
            return Fault(cause, _advice("additive", term))
    return None


def constant_fault(noise: Terms, t0: RealScalarLike, y0: Y, args: Args) -> Fault | None:
    """Why additive noise is not constant in time; `None` if it does not depend on time."""
    for term in noise:
        if not _dependence(term, t0, y0, args).independent(lambda t, y, control: t):
            return Fault("it depends on time", "Use `SRKs4`, which accepts such noise.")
    return None


def check_assertions(
    terms: diffrax.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args
) -> None:
    """Raises a `ValueError` if the values at `y0` contradict a `structure` that the user
    asserted. Raises nothing if the values are traced, as in the program of a solve."""
    drift, _, noise = split_friction(without_constraint(terms))
    # Only noise can break an additive structure.
    drifts = {"separable": drift, "additive": ()}
    for structure in get_args(AssertedStructure):
        fault = _wrong_assertion(structure, drifts[structure], noise, t0, y0, args)
        if fault is not None:
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
    """Raises a `ValueError` if an Ito solver gets noise that is meant in the sense of
    Stratonovich, and the two senses differ.

    - The noise of Hamiltonians is meant in the sense of Stratonovich. With `all_terms`, as
        in `expectation`, all noise is.
    - The two senses agree for additive noise, and for noise that changes only `p` and
        depends only on `q`.
    """
    if not isinstance(solver, diffrax.AbstractItoSolver):
        return
    drift, noise = split_terms(terms)
    # Only noise that is meant in the sense of Stratonovich is kept in `noise`.
    if all_terms:
        whose = "`expectation` takes all terms"
        instead = ", or use `monte_carlo`"
    else:
        # A plain drift term may be the correction from one sense to the other.
        if not all(map(is_hamiltonian, drift)):
            return
        noise = tuple(filter(is_hamiltonian, noise))
        whose = "The terms of `hamiltonian_terms` are"
        instead = ""
    # Without a drift, `separable_fault` finds noise that is not of the form that changes
    # only `p` and depends only on `q`.
    if additive_fault(noise, t0, y0, args) and separable_fault((), noise, t0, y0, args):
        raise ValueError(
            f"`{type(solver).__name__}` solves equations in the sense of Ito. {whose} in "
            "the sense of Stratonovich, and here the two differ. Use a solver of this "
            "package, or a Stratonovich solver of Diffrax such as `diffrax.Heun`. If you "
            f"mean the Ito equation, add its drift correction{instead}."
        )


def _dependence(
    term: diffrax.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args
) -> Dependence:
    """What the change of the state by a term depends on, of time, state and control."""
    t0 = jnp.asarray(t0, jnp.result_type(float))

    def change_of_state(t: RealScalarLike, y: Y, control: Any) -> Y:
        return term.vf_prod(t, y, args, control)

    return Dependence(change_of_state, t0, y0, control_struct(term, t0))


def _keeps_half(
    term: diffrax.AbstractTerm, half: int, t0: RealScalarLike, y0: Y, args: Args
) -> bool:
    """Whether a plain noise term is known, while tracing, to leave a half of the state, 0
    or 1, unchanged: whether each of its noises changes the half by a known zero, as for a
    constant matrix with zeros in the rows of this half.

    Always false for Hamiltonian terms, for which `_dependence` is enough: a Hamiltonian
    that does not depend on one half does not change the other half."""
    if is_hamiltonian(term):
        return False
    # Outside of this context the entries of a known matrix would be traced under `jit`.
    with at_trace_time():
        zeros, unravel = zeros_and_unravel(control_struct(term, t0))
        # The change of the half by each noise, for the increment 1 of this noise alone.
        changes = [
            unwrapped(term).vf_prod(t0, y0, args, unravel(unit))[half]
            for unit in jnp.eye(zeros.size, dtype=zeros.dtype)
        ]
    leaves = jtu.tree_leaves(changes)
    return not any(is_traced(leaf) or np.asarray(leaf).any() for leaf in leaves)


def _wrong_assertion(
    structure: AssertedStructure,
    drift: Terms,
    noise: Terms,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
) -> Fault | None:
    """The fault of the first term that the user asserted to have this structure, but that
    does not have it at or near `y0`; `None` if no term is wrong, or if values are traced.
    For "additive" pass no drift: only noise can break this structure."""
    for i, term in enumerate((*drift, *noise)):
        is_noise = i >= len(drift)
        if asserted_structure(term) != structure:
            continue
        if not contradicts_assertion(term, structure, is_noise, t0, y0, args):
            continue
        if structure == "additive":
            cause = "at or near `y0` the noise depends on the state"
        elif is_noise:
            cause = "at or near `y0` a noise Hamiltonian depends on p"
        else:
            cause = "at or near `y0` H0 mixes p and q, or dH0/dp depends on t"
        advice = (
            f'Leave `structure="{structure}"`, which is wrong here, out of '
            f"`{name_of_maker(term)}`, and {_GENERAL}."
        )
        return Fault(cause, advice)
    return None


def _advice(structure: AssertedStructure, term: diffrax.AbstractTerm) -> str:
    """What to do about a term that does not have this structure by tracing, in sentences:
    how to write the term so that tracing shows the structure, or which solver to use."""
    is_drift = len(brownian_paths(term)) == 0
    if is_drift and not is_hamiltonian(term):
        return (
            "Variables also count if they cancel or are multiplied by zero: write zeros as "
            "`jnp.zeros_like(q)`. `ImplicitMidpoint` takes such a term, and so does "
            "`BAOAB(ImplicitMidpoint())` beside the friction of `langevin_terms`."
        )
    form = {
        "separable": "H0 as a sum `V(p) + U(t, q)`, each summand of p or q alone",
        "additive": "each H_k as a function linear in p and q, such as `-sigma * q`",
    }[structure]
    maker_name = name_of_maker(term)
    # The structure of plain noise, and of the noise of a bath, cannot be asserted.
    assertion = ""
    if maker_name is not None:
        assertion = f', or pass `structure="{structure}"` to `{maker_name}`'
    otherwise = _GENERAL_BATH if maker_name == "langevin_terms" else f"{_GENERAL}."
    return (
        "Variables also count if they cancel, are multiplied by zero, are printed, or "
        f"share an array with others: in that case write {form}{assertion}. Otherwise "
        f"{otherwise}"
    )
