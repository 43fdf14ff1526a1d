"""Brownian paths that draw each step separately, as a function of random words."""

import abc
import math
from collections.abc import Callable, Mapping
from typing import cast, ClassVar, TYPE_CHECKING, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree, UInt32

from .._compat import nondifferentiable
from .._custom_types import RealScalarLike
from .._programs import once_for_each_signature
from .random import AbstractLaw, Gaussian, is_key


if TYPE_CHECKING:
    # These lines stand in each module that needs them. If one module imported the name from
    # another, Pyright would take the variables for arguments of `__init__`.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# What a path returns for a step: with `use_levy=False` the increment alone, as arrays; with
# `use_levy=True` an object with all random variables of the step.
Increment: TypeAlias = PyTree[Array] | diffrax.AbstractBrownianIncrement


class AbstractStepwisePath(diffrax.AbstractBrownianPath):
    """A path whose increment over a step is a function of random 32-bit words, one for each
    scalar random variable. `evaluate` draws these words from a generator. `increment` takes
    them as an argument, for example from low-discrepancy points."""

    def evaluate(
        self,
        t0: RealScalarLike,
        t1: RealScalarLike | None = None,
        left: bool = True,
        use_levy: bool = False,
    ) -> Increment:
        """The increment over the step from `t0` to `t1` (from `0` to `t0` without `t1`), or
        with `use_levy=True` an object of type `levy_area`."""
        # The increment over a whole step has no limits from the left or right.
        del left
        if t1 is None:
            ends = (jnp.asarray(jnp.zeros_like(t0)), jnp.asarray(t0))
        else:
            ends = (jnp.asarray(t0), jnp.asarray(t1))
        # Random words are integers that are computed from the times. So without
        # `nondifferentiable`, which raises an error, JAX would return a wrong derivative
        # with respect to the times.
        start, end = cast(tuple[Array, Array], nondifferentiable(ends, name="t"))
        return _draw_increment(self, start, end, use_levy)

    @abc.abstractmethod
    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        """The result of `evaluate` for the step from `t0` to `t1`."""

    @property
    @abc.abstractmethod
    def laws(self) -> Mapping[str, AbstractLaw] | None:
        """The laws of the random variables of a step of size 1, by their name in the
        increment, in the order of their random words. The variables are independent, and
        over a step of size `h` they are scaled by `sqrt(h)`. `None` if increments contain
        anything else."""

    @abc.abstractmethod
    def num_words(self, use_levy: bool = False) -> int:
        """The number of random words that `increment` needs."""

    @abc.abstractmethod
    def increment(
        self,
        words: UInt32[Array, " num_words"],
        t0: RealScalarLike,
        t1: RealScalarLike,
        use_levy: bool = False,
    ) -> Increment:
        """The increment over the step from `t0` to `t1`, from given random words."""


# With `filter_jit` a path is traced once for all steps of a solve. Diffrax traces a step
# three times, and `jax.vmap` traces the body of a loop more often.
@eqx.filter_jit
def _draw_increment(path: AbstractStepwisePath, t0: Array, t1: Array, use_levy: bool):
    return path.draw(t0, t1, use_levy)


class AbstractWrappedPath(AbstractStepwisePath):
    """A Brownian path that changes or extends the increments of another one, the wrapped
    `path`. The random words that it draws in addition to those of the wrapped path are
    called its own words."""

    path: AbstractVar[diffrax.AbstractBrownianPath]

    @property
    def t0(self):
        return self.path.t0

    @property
    def t1(self):
        return self.path.t1

    @abc.abstractmethod
    def num_own_words(self, use_levy: bool) -> int:
        """The number of own words that `own_increment` needs."""

    @abc.abstractmethod
    def own_increment(
        self,
        increment: Increment,
        own_words: UInt32[Array, " num_own_words"],
        h: RealScalarLike,
    ) -> Increment:
        """The increment of this path over a step of size `h`, from the `increment` of the
        wrapped path. With `use_levy=False` both are arrays, and there are no own words;
        with `use_levy=True` both are objects with all random variables."""

    def num_words(self, use_levy: bool = False) -> int:
        wrapped = checked_stepwise(self.path)
        return wrapped.num_words(use_levy) + self.num_own_words(use_levy)

    def increment(self, words, t0, t1, use_levy: bool = False) -> Increment:
        # The words of the wrapped path come first. It reads only these, and not the own
        # words behind them.
        wrapped = checked_stepwise(self.path)
        increment = wrapped.increment(words, t0, t1, use_levy)
        own_words = words[wrapped.num_words(use_levy) :]
        return self.own_increment(increment, own_words, t1 - t0)


class GivenPath(diffrax.AbstractBrownianPath):
    """A path whose increment from `t0` to `t1` is `make(t0, t1, use_levy)`."""

    make: Callable[[RealScalarLike, RealScalarLike | None, bool], Increment]
    levy_area: type = eqx.field(static=True)
    t0: ClassVar[float] = -math.inf
    t1: ClassVar[float] = math.inf

    def evaluate(self, t0, t1=None, left=True, use_levy=False) -> Increment:
        del left
        return self.make(t0, t1, use_levy)


ONLY_A_SHAPE = (
    "These terms have the shape of a Brownian path instead of the path itself, which "
    "suffices for `suggest_solver`, `compare_solvers`, `expectation` and `ensemble`."
)


class UnspecifiedPath(diffrax.AbstractBrownianPath):
    """The shape of a Brownian path to be chosen later, once the solver is known."""

    shape: PyTree[jax.ShapeDtypeStruct] = eqx.field(static=True)
    levy_area: ClassVar[type] = diffrax.AbstractBrownianIncrement
    t0: ClassVar[float] = -math.inf
    t1: ClassVar[float] = math.inf

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        raise ValueError(
            f"{ONLY_A_SHAPE} To solve them, pass `path=solver.path(shape, key)` to the "
            "function that makes the terms."
        )


def checked_stepwise(path: diffrax.AbstractBrownianPath) -> AbstractStepwisePath:
    """Returns the path, if its increments can be computed from given random words. Raises a
    `ValueError` otherwise."""
    if not isinstance(path, AbstractStepwisePath):
        raise ValueError(
            "The random variables of this path cannot be set from outside. Use a "
            "`WeakBrownianPath`, or a `FixedStepBrownianPath` instead of Diffrax's "
            f"Gaussian paths; got `{type(path).__name__}`."
        )
    return path


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


def laws_of(path: diffrax.AbstractBrownianPath) -> Mapping[str, AbstractLaw] | None:
    """The laws of the random variables of a step of any path, as in
    `AbstractStepwisePath.laws`; or `None` if they are unknown."""
    if isinstance(path, AbstractStepwisePath):
        return path.laws
    # Diffrax's paths do not state their laws. Paths of other classes may have any law.
    if isinstance(path, diffrax.UnsafeBrownianPath | diffrax.VirtualBrownianTree):
        return GAUSSIAN_LAWS.get(path.levy_area)
    return None


def is_random(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether a path draws its noise from a random key. Other paths hold given noise, such
    as a record."""
    holds_a_key = any(is_key(leaf) for leaf in jtu.tree_leaves(path))
    return holds_a_key or isinstance(path, UnspecifiedPath)


@once_for_each_signature
def increment_struct(
    path: diffrax.AbstractBrownianPath,
) -> PyTree[jax.ShapeDtypeStruct]:
    """The structure, shapes and dtypes of the increments `W` of a path."""
    if isinstance(path, UnspecifiedPath):
        return path.shape
    # Times of a solve have JAX's default dtype. With the same dtype here, the solve uses
    # the trace of the path that is made here.
    time = jax.ShapeDtypeStruct((), jnp.result_type(float))
    return jax.eval_shape(lambda *ends: path.evaluate(*ends), time, time)


def num_noises(shape: PyTree[jax.ShapeDtypeStruct]) -> int:
    """The number of scalar noises of a path of this shape."""
    return sum(leaf.size for leaf in jtu.tree_leaves(shape))


def zeros_and_unravel(like: PyTree) -> tuple[Array, Callable]:
    """Zeros in the structure, shapes and dtypes of `like` as one vector, and the function
    that restores this structure from a vector."""
    zeros = jtu.tree_map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), like)
    return jfu.ravel_pytree(zeros)


def step_size(h: RealScalarLike, shape: PyTree[jax.ShapeDtypeStruct]) -> PyTree[Array]:
    """The step size `h` as the field `dt` of an increment of this shape: Diffrax has one
    step size for each leaf, in the dtype of the leaf."""
    return jtu.tree_map(lambda leaf: jnp.asarray(h, leaf.dtype), shape)


def variables_from_words(
    law: AbstractLaw,
    words: UInt32[Array, " n"],
    h: RealScalarLike,
    like: PyTree[jax.ShapeDtypeStruct | Array],
) -> PyTree[Array]:
    """Random variables over a step of size `h`, one for each noise. Each is `sqrt(h)` times
    the sample of the `law` for its word. They have the structure, shapes and dtypes of
    `like`."""
    leaves, treedef = jtu.tree_flatten(like)
    ends = np.cumsum([leaf.size for leaf in leaves])
    # `h` is negative backward in time. Diffrax itself negates the increments.
    sqrt_h = jnp.sqrt(jnp.abs(h))
    variables = []
    for leaf_words, leaf in zip(jnp.split(words, ends[:-1]), leaves):
        sample = law.from_words(leaf_words.reshape(leaf.shape), leaf.dtype)
        # Times may have a higher precision than the leaf.
        variables.append(sample * sqrt_h.astype(leaf.dtype))
    return jtu.tree_unflatten(treedef, variables)


def checked_shape(
    shape: tuple[int, ...] | PyTree[jax.ShapeDtypeStruct], path_name: str
) -> PyTree[jax.ShapeDtypeStruct]:
    """The argument `shape` of a path as a PyTree of `jax.ShapeDtypeStruct`s. A tuple of
    integers, the shape of a single array, is converted to one. Raises a `ValueError` for
    anything else, and for dtypes that are not real floating-point."""
    if isinstance(shape, tuple) and all(isinstance(size, int) for size in shape):
        # JAX's default dtype is fixed now, since the user may change it before a step is
        # drawn.
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
