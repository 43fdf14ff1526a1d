"""The terms of a system, sorted into drifts and noises, and drifts taken apart into energy,
friction and slow potential."""

import dataclasses
from typing import Any

import diffrax
import equinox as eqx
import jax
from jaxtyping import PyTree

from .._brownian import num_noises
from .._compat import is_adjoint_term, unwrapped, wrapped_like
from .._custom_types import RealScalarLike, Terms
from .constrained_drift import ConstrainedDrift
from .paths import brownian_paths
from .symplectic_gradients import AbstractFriction, Drift


_BACKSOLVE = (
    "`diffrax.BacksolveAdjoint` cannot be used with the solvers of `diffrax_symplectic`: "
    "its steps backward in time differ from the forward steps, so a weak path has other "
    "increments, and the gradients would be wrong. Pass `adjoint=diffrax_symplectic."
    "ReversingAdjoint()`, whose memory does not grow with the number of steps either, or "
    "`adjoint=diffrax.RecursiveCheckpointAdjoint()`."
)


def split_terms(terms: diffrax.AbstractTerm) -> tuple[Terms, Terms]:
    """The drift terms and the noise terms.

    - A term with a Brownian path is noise.
    - An `ODETerm`, constrained or not, is a drift.
    - A term of any other class, such as one of the user's, is a drift if it is the first
        term, as in Diffrax's `MultiTerm(drift, diffusion)`. Otherwise it is noise: it may
        be driven by a path that is not a Brownian path of Diffrax. It must not pass for a
        drift, since most solvers treat noise differently.

    Raises a `ValueError` for the terms of `diffrax.BacksolveAdjoint`."""
    parts = flattened(terms)
    if any(map(is_adjoint_term, parts)):
        raise ValueError(_BACKSOLVE)
    drift = []
    noise = []
    for i, term in enumerate(parts):
        has_path = len(brownian_paths(term)) > 0
        is_ode = isinstance(unwrapped(term), diffrax.ODETerm | ConstrainedDrift)
        if not has_path and (is_ode or i == 0):
            drift.append(term)
        else:
            noise.append(term)
    return tuple(drift), tuple(noise)


def flattened(terms: diffrax.AbstractTerm) -> Terms:
    """The terms of a `MultiTerm`, including nested ones."""
    if isinstance(terms, diffrax.MultiTerm):
        return tuple(part for term in terms.terms for part in flattened(term))
    return (terms,)


def field_of(term: diffrax.AbstractTerm) -> Any:
    """The vector field of an `ODETerm`, which Diffrax may have wrapped to run backward in
    time; `None` for other terms."""
    term = unwrapped(term)
    return term.vector_field if isinstance(term, diffrax.ODETerm) else None


def _with_field(term: diffrax.AbstractTerm, field: Any) -> diffrax.AbstractTerm:
    """An `ODETerm` of this vector field, in the direction of time of `term`."""
    return wrapped_like(term, diffrax.ODETerm(field))


def split_friction(terms: PyTree[diffrax.AbstractTerm]) -> tuple[Terms, Terms, Terms]:
    """The drift without friction, the friction, and the noise."""
    drift, noise = split_terms(terms)
    return *friction_apart(drift), noise


def friction_apart(drift: Terms) -> tuple[Terms, Terms]:
    """The terms of the drift without friction, and the terms of the friction.

    - A drift with friction, as from `langevin_terms`, becomes two terms, one of each.
    - Friction alone, as from `bath_terms`, and a drift without friction stay as they are.
    """
    rest = []
    friction = []
    for term in drift:
        field = field_of(term)
        if isinstance(field, Drift) and field.friction is not None:
            frictionless = dataclasses.replace(field, friction=None)
            rest.append(_with_field(term, frictionless))
            friction.append(_with_field(term, field.friction))
        elif isinstance(field, AbstractFriction):
            friction.append(term)
        else:
            rest.append(term)
    return tuple(rest), tuple(friction)


def slow_apart(drift: Terms) -> tuple[Terms, Terms]:
    """The terms of the drift without slow potentials, and the terms of the slow potentials,
    which are those that users pass as `slow`. The drift must have no friction, which would
    be in both."""
    rest = []
    slow = []
    for term in drift:
        field = field_of(term)
        if isinstance(field, Drift) and field.slow is not None:
            # The energy is `H0 + slow`. Each of the two terms keeps one summand.
            rest.append(_with_field(term, dataclasses.replace(field, slow=None)))
            slow.append(_with_field(term, dataclasses.replace(field, H0=None)))
        else:
            rest.append(term)
    return tuple(rest), tuple(slow)


def control_struct(
    term: diffrax.AbstractTerm, t: RealScalarLike = 0.0
) -> PyTree[jax.ShapeDtypeStruct]:
    """The shapes and dtypes of the control of a term, which is the length of a step or the
    increments of a path, for times with the dtype of `t`."""
    return eqx.filter_eval_shape(term.contr, t, t + 1)


def number_of_noises(terms: diffrax.AbstractTerm) -> int:
    """The number of scalar Brownian motions that drive the noise terms."""
    _, noise = split_terms(terms)
    return num_noises([control_struct(term) for term in noise])
