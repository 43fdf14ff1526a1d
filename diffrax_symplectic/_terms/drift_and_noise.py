"""The terms of a system one by one: which are drifts, which are noises, and how many noises
there are."""

from typing import Any

import diffrax
import equinox as eqx
import jax
from jaxtyping import PyTree

from .._brownian import num_noises
from .._compat import is_adjoint_term, unwrapped
from .._custom_types import RealScalarLike, Terms
from .constrained_drift import ConstrainedDrift
from .paths import brownian_paths


_BACKSOLVE = (
    "`diffrax.BacksolveAdjoint` cannot be used with the solvers of `diffrax_symplectic`: "
    "its steps backward in time differ from the forward steps, so a weak path has other "
    "increments, and the gradients would be wrong. Pass `adjoint=diffrax_symplectic."
    "ReversingAdjoint()`, whose memory does not grow with the number of steps either, or "
    "`adjoint=diffrax.RecursiveCheckpointAdjoint()`."
)


def split_terms(terms: diffrax.AbstractTerm) -> tuple[Terms, Terms]:
    """Drift terms and noise terms. A term is noise if it has a Brownian path, or if it is
    neither the first term nor an `ODETerm`.

    Raises a `ValueError` for the terms of `diffrax.BacksolveAdjoint`."""
    parts = flattened(terms)
    if any(map(is_adjoint_term, parts)):
        raise ValueError(_BACKSOLVE)
    drift = []
    noise = []
    for place, term in enumerate(parts):
        # A term of another kind after the first may be driven by a path that Diffrax knows
        # nothing of. It must not pass for a drift: most solvers treat noise differently.
        other_kind = place > 0 and not _is_ode(term)
        if len(brownian_paths(term)) > 0 or other_kind:
            noise.append(term)
        else:
            drift.append(term)
    return tuple(drift), tuple(noise)


def _is_ode(term: diffrax.AbstractTerm) -> bool:
    return isinstance(unwrapped(term), diffrax.ODETerm | ConstrainedDrift)


def flattened(terms: diffrax.AbstractTerm) -> Terms:
    """The terms of a `MultiTerm`, including nested ones."""
    if isinstance(terms, diffrax.MultiTerm):
        return tuple(part for term in terms.terms for part in flattened(term))
    return (terms,)


def field_of(term: diffrax.AbstractTerm) -> Any:
    """The vector field of an `ODETerm`, also of one that Diffrax has wrapped; `None` for
    other terms."""
    term = unwrapped(term)
    return term.vector_field if isinstance(term, diffrax.ODETerm) else None


def control_struct(
    term: diffrax.AbstractTerm, t: RealScalarLike = 0.0
) -> PyTree[jax.ShapeDtypeStruct]:
    """The shapes and dtypes of the control of a term, for times with the dtype of `t`."""
    return eqx.filter_eval_shape(term.contr, t, t + 1)


def number_of_noises(terms: diffrax.AbstractTerm) -> int:
    """The number of scalar Brownian motions that drive the noise terms."""
    _, noise = split_terms(terms)
    return num_noises([control_struct(term) for term in noise])
