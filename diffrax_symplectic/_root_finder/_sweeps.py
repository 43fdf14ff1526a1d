"""The iteration that normally solves a step, for all paths of a batch together."""

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
import jax.tree_util as jtu
from jax import lax
from jaxtyping import Array, Bool, PyTree, Scalar

from .._batch import batched_together, most_of_batch
from .._compat import materialize, ω
from .._custom_types import IntScalarLike
from ._tolerance import converged, largest, Limits, log2, MARGIN


_Map: TypeAlias = Callable[[PyTree[Array]], PyTree[Array]]

# Sweeps before the first look at the error, in double and in single precision: those that
# a short step needs. A sweep with copies evaluates everything twice, so that fewer will do.
_FIRST, _FIRST_WITH_COPIES = (9, 6), (6, 5)
# The most sweeps between two looks. A rate that is near one is not known well.
_MOST = 32
# The same where corrections are as small as rounding errors.
_LAST = 3
# Above this rate of convergence sweeps are damped. Below, that saves less than a sweep.
_SLOW = 0.3
# How much they are damped where they led away from the solution. It is the best for a rate
# of 8.
_MOST_DAMPED = 0.5
# The logarithm of the rate that is expected once they are damped. By the formula it is 0.17
# or better for rates up to one, but later than in the first few sweeps.
_DAMPED = -2.0
# The logarithm of the rate of 0.87, above which sweeps are not taken to converge.
_STALLED = -0.2


class Found(NamedTuple):
    """Where iteration ended.

    - `y`: the last iterate.
    - `solved`: whether the next correction would be below the tolerance.
    - `near`: whether `y` is solved, or a better first guess than where it began.
    """

    y: PyTree[Array]
    solved: Bool[Array, ""]
    near: Bool[Array, ""]


class _Rounds(NamedTuple):
    """The iterate, how much sweeps are damped, the logarithm of the size of the last
    correction, whether that was small enough, whether iteration comes nearer, whether it
    goes on, how many sweeps there were, and how many there are before the next look."""

    y: PyTree[Array]
    damping: Scalar
    level: Scalar
    solved: Bool[Array, ""]
    near: Bool[Array, ""]
    going: Bool[Array, ""]
    step: IntScalarLike
    ahead: IntScalarLike


def sweep(limits: Limits, image: _Map, begin: Found) -> Found:
    r"""From where it `begin`s, solves $y = \Phi(y)$ by sweeps for all paths of a batch
    together, until each is solved or has left.

    In a sweep $q$ reads what $p$ has become (Gauss--Seidel). Where a Hamiltonian system
    oscillates, the error after that is the one after two evaluations of both, for the price
    of one where $H = T(p) + V(q)$. For values that are no pairs, two copies of them stand
    in place of $p$ and $q$, and read each other.

    Each look at the error shows the rate at which it shrinks, and from that, how many
    sweeps the slowest path needs before the next look. For an oscillation the rate $a$ is
    that of an eigenvalue $-a$: then sweeps in which values stay behind by a fraction
    $v = 1 - 2 / (1 + \sqrt{1 + a})$ of their change converge at the rate $v$ (D. M. Young,
    Transactions of the American Mathematical Society 76, 1954, 92-111; for copies G. H.
    Golub and R. S. Varga, Numerische Mathematik 3, 1961, 147-156). Where sweeps led away,
    they begin once more, damped like this.
    """
    is_pair = lambda x: type(x) is tuple and len(x) == 2
    if pairs := type(begin.y) is list and all(map(is_pair, begin.y)):
        join = lambda p, q: list(zip(p, q))
        halves = lambda y: tuple(list(half) for half in zip(*y))
        first = lambda p, q: halves(image(join(p, q)))[0]
        second = lambda p, q: halves(image(join(p, q)))[1]
        change = lambda before, y: join(*(y**ω - before**ω).ω)
    else:
        join, halves = lambda a, b: b, lambda y: (y, y)
        first, second = lambda a, b: image(b), lambda a, b: image(a)
        # Where both are solutions of y = \Phi(\Phi(y)), only their difference shows it.
        change = lambda _, y: (y[1] ** ω - y[0] ** ω).ω
    dtype = jnp.result_type(*jtu.tree_leaves(begin.y))
    single = jnp.finfo(dtype).bits < 64
    num_first = (_FIRST if pairs else _FIRST_WITH_COPIES)[single]

    def advance(last: _Rounds) -> _Rounds:
        def behind(new: PyTree[Array], old: PyTree[Array]) -> PyTree[Array]:
            # Of what is infinite this makes NaN, which passes for no rounding error.
            stay = lambda x, y: x + last.damping.astype(x.dtype) * (y - x)
            return jtu.tree_map(stay, new, old)

        def once(_, y):
            p, q = y
            new = behind(first(p, q), p)
            return new, behind(second(new, q), q)

        # A loop that also kept the iterate before would copy it in each sweep.
        before = lax.fori_loop(0, last.ahead - 1, once, last.y)
        y = once(None, before)
        scales = limits.scales(join(*y))
        size, rounded, close = limits.compare(change(before, y), scales)
        whole = limits.in_units([largest(scales)], [largest(scales)])
        # The first of the sweeps changed the values by no more than the state is.
        level, earlier = log2(size), jnp.minimum(last.level, log2(whole))

        def decided() -> _Rounds:
            rate = (level - earlier) / last.ahead
            stalled, step = rate >= _STALLED, last.step + last.ahead
            solved = converged(level, rate, rounded, stalled)
            a = jnp.exp2(rate)
            tuned = (last.step == 0) & (a > _SLOW) & ~stalled
            further = (level + MARGIN) / jnp.where(tuned, -_DAMPED, -rate)
            again = stalled & (last.damping < _MOST_DAMPED)
            on = again | (~stalled & (step + further < limits.steps))
            going = last.going & ~solved & on & (step < limits.steps)
            near = ~stalled & (close | going)
            count = jnp.where(again, num_first, further)
            # What is as small as rounding errors shows no rate.
            count = jnp.where(rounded, jnp.minimum(count, _LAST), count)
            count = jnp.ceil(jnp.where(going, count, 0)).astype(int)
            damping = jnp.where(tuned, 1 - 2 / (1 + jnp.sqrt(1 + a)), last.damping)
            return _Rounds(
                y=(),
                damping=jnp.where(again, _MOST_DAMPED, damping),
                level=jnp.where(again, jnp.inf, level),
                solved=jnp.where(last.going, solved, last.solved),
                near=jnp.where(last.going, near, last.near),
                going=going,
                step=step,
                ahead=jnp.minimum(most_of_batch(count), _MOST),
            )

        # What follows reads it several times, and would compute it as often.
        new = materialize(decided)
        again = new.going & ~new.near
        # The sweeps of all paths of a batch are the same, but each path has only its own.
        own = lambda y, old: jnp.where(last.going, jnp.where(again, 0, y), old)
        return new._replace(y=jtu.tree_map(own, y, last.y))

    none, level = jnp.zeros((), dtype), jnp.full((), jnp.inf, dtype)
    y, solved, near = halves(begin.y), begin.solved, begin.near
    begun = _Rounds(y, none, level, solved, near, ~solved, step=0, ahead=0)
    # All but the numbers of sweeps, which all paths have in common.
    begun = batched_together(begun)._replace(step=0, ahead=num_first)
    last = lax.while_loop(lambda rounds: rounds.ahead > 0, advance, begun)
    return Found(join(*last.y), last.solved, last.solved | last.near)
