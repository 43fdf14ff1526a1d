"""Diffrax's own terms for Langevin dynamics, as terms of this package.

Diffrax's state is `(x, v)`: positions and velocities. Here the velocities take the place of
the momenta, which come first: `(v, x)`.
"""

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
    """Diffrax's Langevin terms as terms of the state `(v, x)`, and this state for
    `y = (x, v)`. Terms without Diffrax's Langevin drift are returned as they are, with
    their state."""
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
    """A term of the state `(x, v)` as terms of the state `(v, x)`: two terms for Diffrax's
    Langevin drift, whose friction becomes a term of its own, which solvers for heat baths
    find; and one for any other term."""
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
    """The vector field of Diffrax's Langevin drift without friction, for `y = (v, x)`."""
    v, x = y
    # Without velocity there is no friction, so `dv` is the force alone.
    _, dv = term.vf(t, (x, jtu.tree_map(jnp.zeros_like, v)), args)
    return dv, v


def _exchanged_field(
    term: diffrax.ODETerm, t, y: tuple[_Half, _Half], args: Args
) -> tuple[_Half, _Half]:
    """The vector field of `term`, a term of `(x, v)`, for `y = (v, x)`."""
    v, x = y
    dx, dv = term.vf(t, (x, v), args)
    return dv, dx


class _PrefixFriction(AbstractFriction):
    """The friction of Diffrax's Langevin term. The structure of its `gamma` may be a prefix
    of that of the velocities, as for `jax.vmap`."""

    gamma: PyTree[ArrayLike]

    def called_with(self, t, y, args):
        return {}

    def velocity(self, t, y, args):
        del t, args
        v, _ = y
        return v

    def force(self, t, q, args, velocity):
        del t, q, args

        # `tree_map` below pairs each leaf of `gamma` with the velocities that it stands
        # for: an array, or a subtree of several arrays.
        def force_on_subtree(gamma: ArrayLike, subtree: _Half) -> _Half:
            return jtu.tree_map(
                lambda v: -not_negative(in_precision_of(gamma, v)) * v, subtree
            )

        return jtu.tree_map(force_on_subtree, self.gamma, velocity)


class _ExchangedNoise(diffrax.AbstractTerm):
    """A noise term of the state `(x, v)`, as a noise term of the state `(v, x)`."""

    term: diffrax.AbstractTerm

    def vf(self, t, y, args):
        v, x = y
        return self.term.vf(t, (x, v), args)

    def contr(self, t0, t1, **kwargs):
        return self.term.contr(t0, t1, **kwargs)

    def prod(self, vf, control):
        dx, dv = self.term.prod(vf, control)
        return dv, dx
