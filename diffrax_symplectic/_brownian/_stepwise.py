"""Brownian paths that draw every step by itself, as a function of random words."""

import abc
from collections.abc import Mapping
from typing import Any, cast

import diffrax
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax.internal as lxi
import numpy as np
from jaxtyping import Array, PyTree, UInt32

from .._custom_types import RealScalarLike
from ._laws import AbstractLaw, Gaussian


class AbstractStepwisePath(diffrax.AbstractBrownianPath):
    """A path whose increment over a step is a function of random words of 32 bits, one for
    each scalar random variable. `evaluate` takes them from a generator; whoever has others
    to put in their place, such as a low-discrepancy set of points, calls `increment`."""

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
    ) -> PyTree[Array] | diffrax.AbstractBrownianIncrement:
        """What `evaluate` returns for the step from `t0` to `t1`, from given words."""


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
        return gaussian_laws(path.levy_area)
    return None


def gaussian_laws(levy_area: type) -> Mapping[str, AbstractLaw] | None:
    if levy_area is diffrax.BrownianIncrement:
        return {"W": Gaussian()}
    if levy_area is diffrax.SpaceTimeLevyArea:
        return {"W": Gaussian(), "H": Gaussian(1 / 12)}
    if levy_area is diffrax.SpaceTimeTimeLevyArea:
        return {"W": Gaussian(), "H": Gaussian(1 / 12), "K": Gaussian(1 / 720)}
    return None


def num_noises(shape: PyTree[jax.ShapeDtypeStruct]) -> int:
    return sum(int(np.prod(leaf.shape)) for leaf in jtu.tree_leaves(shape))


def increment_from_words(
    path: AbstractStepwisePath,
    shape: PyTree[jax.ShapeDtypeStruct],
    words: UInt32[Array, " num_words"],
    h: RealScalarLike,
    use_levy: bool,
) -> PyTree[Array] | diffrax.AbstractBrownianIncrement:
    """The increment over a step of size `h` of a path that consists of its laws."""
    assert path.laws is not None
    n = num_noises(shape)
    sets = [words[i * n : (i + 1) * n] for i in range(len(path.laws))]
    draw = lambda law, words: draw_set(law, words, h, shape)
    if not use_levy:
        return draw(path.laws["W"], sets[0])
    dt = jtu.tree_map(lambda s: jnp.asarray(h, s.dtype), shape)
    drawn = {k: draw(law, x) for (k, law), x in zip(path.laws.items(), sets)}
    return cast(Any, path.levy_area)(dt=dt, **drawn)


def draw_set(
    law: AbstractLaw,
    words: UInt32[Array, " n"],
    h: RealScalarLike,
    like: PyTree[jax.ShapeDtypeStruct | Array],
) -> PyTree[Array]:
    """A random variable for each noise, over a step of size `h`, in the structure, shapes
    and dtypes of `like`."""
    leaves, treedef = jtu.tree_flatten(like)
    ends = np.cumsum([int(np.prod(leaf.shape)) for leaf in leaves])
    root = jnp.sqrt(jnp.abs(h))
    out = [
        law.from_words(piece.reshape(leaf.shape), leaf.dtype) * root.astype(leaf.dtype)
        for piece, leaf in zip(jnp.split(words, ends[:-1]), leaves)
    ]
    return jtu.tree_unflatten(treedef, out)


def step_ends(t0: RealScalarLike, t1: RealScalarLike | None) -> tuple[Array, Array]:
    """Start and end of a step: without `t1` the step from `0` to `t0`."""
    start, end = (jnp.zeros_like(t0), t0) if t1 is None else (t0, t1)
    ends = jnp.asarray(start), jnp.asarray(end)
    return cast(tuple[Array, Array], eqxi.nondifferentiable(ends, name="t"))


def checked_shape(
    shape: tuple[int, ...] | PyTree[jax.ShapeDtypeStruct], path_name: str
) -> PyTree[jax.ShapeDtypeStruct]:
    """The shape of the increments of a path, of which a tuple of integers is short for
    one array. Raises a `ValueError` for what is no shape, or not of real numbers."""
    if isinstance(shape, tuple) and all(isinstance(n, int) for n in shape):
        shape = jax.ShapeDtypeStruct(shape, lxi.default_floating_dtype())
    for leaf in jtu.tree_leaves(shape):
        if not isinstance(leaf, jax.ShapeDtypeStruct):
            raise ValueError(
                "`shape` must be a tuple of integers or a PyTree of "
                f"`jax.ShapeDtypeStruct`s; got {shape}."
            )
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"The dtypes of a `{path_name}` must be real floating-point; "
                f"got {leaf.dtype}."
            )
    return shape
