"""Diffrax's own terms for Langevin dynamics, with the velocity in the place of the
momentum."""

import functools as ft

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, PyTree

from ..._arguments import check_pair
from ..._compat import unwrapped, wrapped_like
from ..._custom_types import Args, RealScalarLike
from ..drift_and_noise import flattened
from .friction import in_precision_of, not_negative
from .terms import AbstractFriction, DriftWithFriction


# A half of the state, velocities or positions.
_Half = PyTree[Array]


def momentum_first(
    terms: PyTree[diffrax.AbstractTerm], y: PyTree
) -> tuple[PyTree[diffrax.AbstractTerm], PyTree]:
    """Diffrax's Langevin terms as terms with the velocity in the place of the momentum, and
    the halves of their state `(x, v)` exchanged. Other terms and their states are returned
    as they are."""
    parts = flattened(terms)
    if not any(map(_is_langevin_drift, parts)):
        return terms, y
    check_pair(y)
    x, v = y
    exchanged = [wrapped_like(term, _exchanged(unwrapped(term))) for term in parts]
    return diffrax.MultiTerm(*exchanged), (v, x)


def _is_langevin_drift(term: diffrax.AbstractTerm) -> bool:
    return isinstance(unwrapped(term), diffrax.UnderdampedLangevinDriftTerm)


def _exchanged(term: diffrax.AbstractTerm) -> diffrax.AbstractTerm:
    """A term of the state `(x, v)` as one of `(v, x)`. If it is Diffrax's Langevin drift,
    its friction is made a part that solvers for heat baths find."""
    if isinstance(term, diffrax.UnderdampedLangevinDriftTerm):
        # The `gamma` of Diffrax acts on velocities of mass one, as the friction here does.
        friction = _PrefixFriction(term.gamma)
        return diffrax.ODETerm(DriftWithFriction(_Frictionless(term), friction))
    if isinstance(term, diffrax.ODETerm):
        return diffrax.ODETerm(_ExchangedField(term))
    # All other terms are noise.
    return _ExchangedNoise(term)


class _Frictionless(eqx.Module):
    """The drift of Diffrax's Langevin term without friction, for `(velocity, position)`."""

    term: diffrax.UnderdampedLangevinDriftTerm

    def __call__(self, t: RealScalarLike, y: tuple[_Half, _Half], args: Args):
        v, x = y
        # Without velocity there is no friction, so only the forces are left.
        no_velocity = jtu.tree_map(jnp.zeros_like, v)
        _, dv = self.term.vf(t, (x, no_velocity), args)
        return dv, v


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

        def force_on_array(gamma: ArrayLike, v: Array) -> Array:
            return -not_negative(in_precision_of(gamma, v)) * v

        def force_on_subtree(gamma: ArrayLike, v: _Half) -> _Half:
            return jtu.tree_map(ft.partial(force_on_array, gamma), v)

        # One leaf of `gamma` may be that of several arrays of velocities.
        return jtu.tree_map(force_on_subtree, self.gamma, velocity)


class _ExchangedField(eqx.Module):
    """The vector field of a drift term of `(x, v)`, as one of `(v, x)`."""

    term: diffrax.ODETerm

    def __call__(self, t: RealScalarLike, y: tuple[_Half, _Half], args: Args):
        v, x = y
        dx, dv = self.term.vf(t, (x, v), args)
        return dv, dx


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
