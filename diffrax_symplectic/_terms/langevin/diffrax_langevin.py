"""Diffrax's own terms for Langevin dynamics, with the velocity in the place of the
momentum."""

import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, PyTree

from ..._arguments import check_pair
from ..._compat import unwrapped, wrapped_like
from ..._custom_types import Args
from ..drift_and_noise import flattened
from ..symplectic_gradients import AbstractFriction
from .friction import in_precision_of, not_negative


# A half of the state, velocities or positions.
_Half = PyTree[Array]


def momentum_first(
    terms: PyTree[diffrax.AbstractTerm], y: PyTree
) -> tuple[PyTree[diffrax.AbstractTerm], PyTree]:
    """Diffrax's Langevin terms as terms with the velocity in the place of the momentum, and
    the halves of their state `(x, v)` exchanged. Other terms and their states are returned
    as they are."""
    parts = flattened(terms)
    own_parts = map(unwrapped, parts)
    if not any(isinstance(x, diffrax.UnderdampedLangevinDriftTerm) for x in own_parts):
        return terms, y
    check_pair(y)
    x, v = y
    exchanged = [
        wrapped_like(term, new) for term in parts for new in _exchanged(unwrapped(term))
    ]
    return diffrax.MultiTerm(*exchanged), (v, x)


def _exchanged(term: diffrax.AbstractTerm) -> list[diffrax.AbstractTerm]:
    """A term of the state `(x, v)` as terms of `(v, x)`. Of Diffrax's Langevin drift, the
    friction becomes a term of its own, which solvers for heat baths find."""
    if isinstance(term, diffrax.UnderdampedLangevinDriftTerm):
        # The `gamma` of Diffrax acts on velocities of mass one, as the friction here does.
        friction = _PrefixFriction(term.gamma)
        frictionless = jtu.Partial(_frictionless_field, term)
        return [diffrax.ODETerm(frictionless), diffrax.ODETerm(friction)]
    if isinstance(term, diffrax.ODETerm):
        return [diffrax.ODETerm(jtu.Partial(_exchanged_field, term))]
    # All other terms are noise.
    return [_ExchangedNoise(term)]


def _frictionless_field(
    term: diffrax.UnderdampedLangevinDriftTerm, t, y: tuple[_Half, _Half], args: Args
) -> tuple[_Half, _Half]:
    v, x = y
    # Without velocity there is no friction, so only the forces are left.
    _, dv = term.vf(t, (x, jtu.tree_map(jnp.zeros_like, v)), args)
    return dv, v


def _exchanged_field(
    term: diffrax.ODETerm, t, y: tuple[_Half, _Half], args: Args
) -> tuple[_Half, _Half]:
    v, x = y
    dx, dv = term.vf(t, (x, v), args)
    return dv, dx


class _PrefixFriction(AbstractFriction):
    """The friction of Diffrax's Langevin term. Its `gamma` may be a prefix of the
    velocity."""

    gamma: PyTree[ArrayLike]

    def called_with(self, t, y, args):
        return {}

    def velocity(self, t, y, args):
        del t, args
        v, _ = y
        return v

    def force(self, t, q, args, velocity):
        del t, q, args

        # One leaf of `gamma` may be that of several arrays of velocities.
        def force_on_subtree(gamma: ArrayLike, subtree: _Half) -> _Half:
            return jtu.tree_map(
                lambda v: -not_negative(in_precision_of(gamma, v)) * v, subtree
            )

        return jtu.tree_map(force_on_subtree, self.gamma, velocity)


class _ExchangedNoise(diffrax.AbstractTerm):
    """A noise term of the state `(x, v)`, as one of `(v, x)`."""

    term: diffrax.AbstractTerm

    def vf(self, t, y, args):
        v, x = y
        return self.term.vf(t, (x, v), args)

    def contr(self, t0, t1, **kwargs):
        return self.term.contr(t0, t1, **kwargs)

    def prod(self, vf, control):
        dx, dv = self.term.prod(vf, control)
        return dv, dx
