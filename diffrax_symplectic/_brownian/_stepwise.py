"""Brownian paths that draw every step by itself, as a function of random words."""

import abc
from collections.abc import Callable, Mapping
from typing import Any, cast, TYPE_CHECKING, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree, UInt32

from .._compat import nondifferentiable
from .._custom_types import RealScalarLike
from ._random import AbstractLaw, Gaussian, Place, random_words


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# What a step gets from its path, without and with all of its random variables.
Increment: TypeAlias = PyTree[Array] | diffrax.AbstractBrownianIncrement


class AbstractStepwisePath(diffrax.AbstractBrownianPath):
    """A path whose increment over a step is a function of random words of 32 bits, one for
    each scalar random variable. `evaluate` takes them from a generator. To put others in
    their place, such as those of a low-discrepancy set of points, call `increment`."""

    def evaluate(
        self,
        t0: RealScalarLike,
        t1: RealScalarLike | None = None,
        left: bool = True,
        use_levy: bool = False,
    ) -> Increment:
        """Implements [`diffrax.AbstractBrownianPath.evaluate`][].

        Returns the increment over the step from `t0` to `t1`, or with `use_levy=True` an
        object of type `levy_area`. Without `t1` the step is the one from `0` to `t0`.
        """
        del left
        start, end = (jnp.zeros_like(t0), t0) if t1 is None else (t0, t1)
        ends = jnp.asarray(start), jnp.asarray(end)
        start, end = cast(tuple[Array, Array], nondifferentiable(ends, name="t"))
        return _drawn(self, start, end, use_levy)

    @abc.abstractmethod
    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        """What `evaluate` returns for the step from `t0` to `t1`."""

    @property
    @abc.abstractmethod
    def laws(self) -> Mapping[str, AbstractLaw] | None:
        """The laws of the random variables of a step, all of them independent, by their
        name on the increment and for a step of size 1: over a step of size `h` they are
        `sqrt(h)` times as large. `None` if the increments are not made of such only."""

    @abc.abstractmethod
    def num_words(self, use_levy: bool = False) -> int:
        """How many words `increment` needs."""

    @abc.abstractmethod
    def increment(
        self,
        words: UInt32[Array, " num_words"],
        t0: RealScalarLike,
        t1: RealScalarLike,
        use_levy: bool = False,
    ) -> Increment:
        """What `evaluate` returns for the step from `t0` to `t1`, from given words."""


# Diffrax traces a step three times, and `jax.vmap` what is in a loop more often.
@eqx.filter_jit
def _drawn(path: AbstractStepwisePath, t0: Array, t1: Array, use_levy: bool):
    return path.draw(t0, t1, use_levy)


class AbstractPathWithLaws(AbstractStepwisePath):
    """A path whose steps are made of independent random variables with its `laws`, one
    from each law for each noise."""

    shape: AbstractVar[PyTree[jax.ShapeDtypeStruct]]
    key: AbstractVar[PRNGKeyArray]

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    @property
    @abc.abstractmethod
    def laws(self) -> Mapping[str, AbstractLaw]:
        """The law of the increment, `"W"`, comes first."""

    def _num_sets(self, use_levy: bool) -> int:
        return len(self.laws) if use_levy else 1

    def num_words(self, use_levy: bool = False) -> int:
        return self._num_sets(use_levy) * num_noises(self.shape)

    def words(self, place: Place, use_levy: bool) -> UInt32[Array, " num_words"]:
        """The path's own random words for a place on the axis of time."""
        sets, n = self._num_sets(use_levy), num_noises(self.shape)
        return random_words(self.key, place, sets, n).reshape(-1)

    def increment(
        self,
        words: UInt32[Array, " num_words"],
        t0: RealScalarLike,
        t1: RealScalarLike,
        use_levy: bool = False,
    ) -> Increment:
        n = num_noises(self.shape)
        sets = [words[i * n : (i + 1) * n] for i in range(len(self.laws))]
        draw = lambda law, words: draw_set(law, words, t1 - t0, self.shape)
        if not use_levy:
            return draw(self.laws["W"], sets[0])
        dt = jtu.tree_map(lambda s: jnp.asarray(t1 - t0, s.dtype), self.shape)
        drawn = {k: draw(law, x) for (k, law), x in zip(self.laws.items(), sets)}
        return cast(Any, self.levy_area)(dt=dt, **drawn)


def stepwise(path: diffrax.AbstractBrownianPath) -> AbstractStepwisePath:
    """`path` if its steps can be made from given words, otherwise a `ValueError`."""
    if not isinstance(path, AbstractStepwisePath):
        raise ValueError(
            "The random variables of this path cannot be chosen from outside. Use a "
            "`WeakBrownianPath`, or a `FixedStepBrownianPath` in place of Diffrax's "
            f"Gaussian paths; got `{type(path).__name__}`."
        )
    return path


def laws_of(path: diffrax.AbstractBrownianPath) -> Mapping[str, AbstractLaw] | None:
    """The laws of the random variables of a step, or `None` if they are unknown."""
    if isinstance(path, AbstractStepwisePath):
        return path.laws
    if isinstance(path, diffrax.UnsafeBrownianPath | diffrax.VirtualBrownianTree):
        return GAUSSIAN_LAWS.get(path.levy_area)
    return None


class AbstractWrappedPath(AbstractStepwisePath):
    """A Brownian path that changes the increments of another, or adds to them."""

    path: AbstractVar[diffrax.AbstractBrownianPath]

    @property
    def t0(self):
        return self.path.t0

    @property
    def t1(self):
        return self.path.t1

    @abc.abstractmethod
    def num_own_words(self, use_levy: bool) -> int:
        """How many random words `changed` needs."""

    @abc.abstractmethod
    def changed(
        self,
        increment: Increment,
        own_words: UInt32[Array, " num_own_words"],
        h: RealScalarLike,
        use_levy: bool,
    ) -> Increment:
        """What this path makes of an increment of the other, over a step of size `h`."""

    def num_words(self, use_levy: bool = False) -> int:
        return stepwise(self.path).num_words(use_levy) + self.num_own_words(use_levy)

    def increment(
        self,
        words: UInt32[Array, " num_words"],
        t0: RealScalarLike,
        t1: RealScalarLike,
        use_levy: bool = False,
    ) -> Increment:
        path = stepwise(self.path)
        increment = path.increment(words, t0, t1, use_levy)
        own_words = words[path.num_words(use_levy) :]
        return self.changed(increment, own_words, t1 - t0, use_levy)


def increment_struct(
    path: diffrax.AbstractBrownianPath,
) -> PyTree[jax.ShapeDtypeStruct]:
    """Shapes, dtypes and structure of an increment."""
    if isinstance(path, UnspecifiedPath):
        return path.shape
    # Times of this kind are those of a solve, for which it is not traced once more.
    time = jax.ShapeDtypeStruct((), jnp.result_type(float))
    return jax.eval_shape(lambda *ends: path.evaluate(*ends), time, time)


# The laws of Gaussian paths, by the type of their increments.
GAUSSIAN_LAWS: Mapping[type, Mapping[str, AbstractLaw]] = {
    diffrax.BrownianIncrement: {"W": Gaussian()},
    diffrax.SpaceTimeLevyArea: {"W": Gaussian(), "H": Gaussian(1 / 12)},
    diffrax.SpaceTimeTimeLevyArea: {
        "W": Gaussian(),
        "H": Gaussian(1 / 12),
        "K": Gaussian(1 / 720),
    },
}


def num_noises(shape: PyTree[jax.ShapeDtypeStruct]) -> int:
    return sum(leaf.size for leaf in jtu.tree_leaves(shape))


def draw_set(
    law: AbstractLaw,
    words: UInt32[Array, " n"],
    h: RealScalarLike,
    like: PyTree[jax.ShapeDtypeStruct | Array],
) -> PyTree[Array]:
    """A random variable for each noise, over a step of size `h`, in the structure, shapes
    and dtypes of `like`."""
    leaves, treedef = jtu.tree_flatten(like)
    ends = np.cumsum([leaf.size for leaf in leaves])
    root = jnp.sqrt(jnp.abs(h))
    out = [
        law.from_words(piece.reshape(leaf.shape), leaf.dtype) * root.astype(leaf.dtype)
        for piece, leaf in zip(jnp.split(words, ends[:-1]), leaves)
    ]
    return jtu.tree_unflatten(treedef, out)


def checked_shape(
    shape: tuple[int, ...] | PyTree[jax.ShapeDtypeStruct], path_name: str
) -> PyTree[jax.ShapeDtypeStruct]:
    """The shape of the increments of a path, of which a tuple of integers is short for
    one array. Raises a `ValueError` for what is no shape, or not of real numbers."""
    if isinstance(shape, tuple) and all(isinstance(n, int) for n in shape):
        shape = jax.ShapeDtypeStruct(shape, jnp.result_type(float))
    for leaf in jtu.tree_leaves(shape):
        if not isinstance(leaf, jax.ShapeDtypeStruct) or min(leaf.shape, default=0) < 0:
            raise ValueError(
                "`shape` must be a tuple of integers, `(m,)` for `m` noises, or a PyTree "
                "of `jax.ShapeDtypeStruct`s; got "
                f"{eqx.tree_pformat(shape, struct_as_array=True)}."
            )
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"The dtypes of a `{path_name}` must be real floating-point; "
                f"got {leaf.dtype}."
            )
    return shape


def covers_all_times(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether it is known while tracing that a path has no beginning and no end."""
    known = lambda x: isinstance(x, int | float | np.number)
    return all(known(x) and abs(x) == np.inf for x in (path.t0, path.t1))


def is_random(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether a path draws its noise, by a random key within it. Others hold noise that is
    given: recorded, or made by a rule."""
    if isinstance(path, UnspecifiedPath):
        return True

    def is_key(x) -> bool:
        if not eqx.is_array(x):
            return False
        typed = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
        return typed or x.dtype == jnp.uint32 and x.shape[-1:] in ((2,), (4,))

    return any(map(is_key, jtu.tree_leaves(path)))


class UnspecifiedPath(diffrax.AbstractBrownianPath):
    """The shape of a Brownian path that is chosen later, when the solver is known."""

    shape: PyTree[jax.ShapeDtypeStruct] = eqx.field(static=True)
    levy_area: type = eqx.field(static=True, default=diffrax.AbstractBrownianIncrement)

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del t0, t1, left, use_levy
        raise ValueError(
            "These terms have the shape of a Brownian path in place of the path itself, "
            "which is enough for `suggest_solver`, `compare_solvers` and `expectation`. To "
            "solve them, pass `path=solver.path(shape, key)` to the function that makes "
            "the terms."
        )


class GivenPath(diffrax.AbstractBrownianPath):
    """A path whose increments come from elsewhere: that of the step from `t0` to `t1` is
    `make(t0, t1, use_levy)`."""

    make: Callable[[RealScalarLike, RealScalarLike | None, bool], Increment]
    levy_area: type = eqx.field(static=True)

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del left
        return self.make(t0, t1, use_levy)
