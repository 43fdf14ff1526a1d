"""Paths that change or extend the increments of another path: truncation, and plateaus."""

import dataclasses
import math
from typing import ClassVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._arguments import whole_number
from .._compat import is_traced
from .._custom_types import BM, RealScalarLike
from .paths import WeakBrownianPath
from .random import (
    AbstractLaw,
    check_key,
    Discrete,
    place_of,
    PLATEAU_WORDS,
    random_words,
    TWO_POINT,
)
from .stepwise import (
    AbstractWrappedPath,
    Increment,
    increment_struct,
    laws_of,
    num_noises,
    variables_from_words,
)


# What to do where a truncated path loses too much.
TRUNCATE_LESS = (
    "Pass `TruncatedBrownianPath(path, unit=32 * (t1 - t0))`, which loses at most 0.04% in "
    "any unit of time; or to `expectation` or `ensemble` the shape of the path, which does "
    "the same; or take smaller steps."
)
STEP_BEYOND_UNIT = (
    "Nothing is left of the increments of a `TruncatedBrownianPath`: it bounds them by "
    "sqrt(2 k h |ln(h / unit)|), and the step h is as long as its `unit` of time (1 by "
    f"default), or longer. {TRUNCATE_LESS}"
)


def check_space_time_area(
    path: diffrax.AbstractBrownianPath, wrapper_name: str
) -> None:
    """Raises a `ValueError` unless the increments of `path` have space-time Lévy area."""
    # An object that is no path has no `levy_area`. `NoneType` in its place fails the test.
    area = getattr(path, "levy_area", type(None))
    if not issubclass(area, diffrax.AbstractSpaceTimeLevyArea):
        raise ValueError(
            f"`{wrapper_name}` needs a path with space-time Lévy area, for example "
            "`FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)`; got "
            f"{type(path).__name__} with {area.__name__}."
        )


def has_bounded_increments(path: diffrax.AbstractBrownianPath) -> bool:
    """Whether the increments of a path are known to be bounded."""
    if isinstance(path, TruncatedBrownianPath):
        return True
    laws = laws_of(path)
    return laws is not None and all(isinstance(law, Discrete) for law in laws.values())


class TruncatedBrownianPath(AbstractWrappedPath):
    r"""Truncates the increments of a Brownian path, for implicit strong methods.

    Over a step of size $h < u$ an increment $\sqrt h\,\xi$ becomes
    $\sqrt h\,\max(-A_h, \min(\xi, A_h))$ with $A_h = \sqrt{2 k |\ln (h / u)|}$, where
    $u$ is the `unit` of time, 1 in the paper. With unbounded Gaussian increments, the stage
    equations of an implicit method whose noise depends on the state have no solution with
    positive probability, at any step size.

    The cost of truncation is a mean-square error $\mathbb E[(\xi - \xi_h)^2] \leq
    e^{-A_h^2 / 2} = (h / u)^k$. For a fixed `unit` this is $C h^k$, so the order of
    convergence is that of the paper: choose $k$ at least twice the strong order of the
    method.

    It is for steps that are short in the `unit`: for `k=2` an increment loses 0.1% of its
    variance at $h = u/20$, 3% at $u/4$, 16% at $u/2$, 72% at $0.9 u$, and all of it at $u$.
    Where [`diffrax_symplectic.expectation`][] and [`diffrax_symplectic.ensemble`][] make
    the path, the `unit` is 32 times the interval from `t0` to `t1`: even one step over all
    of it loses only 0.04%, and results do not depend on the unit in which times are given.

    Additive noise needs no truncation, and the terms of
    [`diffrax_symplectic.langevin_terms`][] and [`diffrax_symplectic.bath_terms`][] take the
    path within: a bath has its temperature at every step. Lévy areas are not changed. Step
    sizes must be fixed.

    **Source:** [Milstein, Repin and Tretyakov
    (2002)](https://doi.org/10.1137/S0036142901395588).
    """

    path: diffrax.AbstractBrownianPath
    k: int = eqx.field(static=True)
    # `None` means 1. (The number 1 would be one more leaf of the path.)
    unit: RealScalarLike | None
    # A truncated law is not the law for a step of size 1, scaled by `sqrt(h)`.
    laws: ClassVar[None] = None  # pyright: ignore

    def __init__(
        self,
        path: diffrax.AbstractBrownianPath,
        *,
        k: int = 2,
        unit: RealScalarLike | None = None,
    ):
        """**Arguments:**

        - `path`: any Diffrax Brownian path.
        - `k`: the integer $k \\geq 1$ above.
        - `unit`: the unit of time $u$ above, the same for all steps of a solve. Take one
            that follows from the problem and is much longer than a step, such as 32 times
            the interval. `None` means 1.

        **Raises:** a `ValueError` if `k` is not a positive integer, if `unit` is not a
        positive number, or if `path` is not a Brownian path or already has bounded
        increments; an error when run if a step is so long, $h \\geq u$, that nothing is
        left of its increment.
        """
        if not isinstance(path, diffrax.AbstractBrownianPath):
            raise ValueError(
                "`TruncatedBrownianPath` wraps a Brownian path, for example "
                f"`FixedStepBrownianPath(shape, key)`; got {type(path).__name__}."
            )
        if isinstance(path, WeakBrownianPath):
            raise ValueError(
                "The increments of a `WeakBrownianPath` are already bounded, and "
                "truncation would change their moments. Pass it without truncation."
            )
        if unit is not None:
            is_number = eqx.is_array_like(unit) and jnp.shape(unit) == ()
            # The value of a traced number is not known, and is not checked.
            if not is_number or not (is_traced(unit) or 0 < float(unit) < math.inf):
                raise ValueError(f"`unit` must be a positive number; got {unit!r}.")
        self.path = path
        self.k = whole_number("k", k)
        self.unit = unit

    @property
    def levy_area(self):
        return self.path.levy_area

    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        increment = self.path.evaluate(t0, t1, use_levy=use_levy)
        no_words = jnp.zeros(0, jnp.uint32)
        return self.own_increment(increment, no_words, t1 - t0)

    def num_own_words(self, use_levy: bool) -> int:
        return 0

    def own_increment(self, increment, own_words, h) -> Increment:
        """Truncates the increment `W` of the wrapped path to the interval from `-bound` to
        `bound`, with `bound = sqrt(2 k |h| |ln(|h| / unit)|)`. There are no own words."""
        length = jnp.abs(h)
        in_units = length
        if self.unit is not None:
            in_units = length / jnp.asarray(self.unit, length.dtype)
        in_units = eqx.error_if(in_units, in_units >= 1, STEP_BEYOND_UNIT)
        # For an empty step, the logarithm of 1 instead of 0 keeps the bound at zero.
        log_in_units = jnp.log(jnp.where(in_units > 0, in_units, 1))
        bound = jnp.sqrt(2 * self.k * length * jnp.abs(log_in_units))

        def clip(w: Array) -> Array:
            return jnp.clip(w, -bound.astype(w.dtype), bound.astype(w.dtype))

        if isinstance(increment, diffrax.AbstractBrownianIncrement):
            return dataclasses.replace(increment, W=jtu.tree_map(clip, increment.W))
        return jtu.tree_map(clip, increment)


def lost_variance(path: diffrax.AbstractBrownianPath, h: float) -> float:
    """The variance that an increment over a step of size `h` loses by truncation, as a
    fraction of its variance; 0 if nothing truncates the path. If several wrappers truncate
    it, this is the largest of their fractions."""
    lost = 0.0
    while isinstance(path, AbstractWrappedPath):
        if isinstance(path, TruncatedBrownianPath):
            # The bound in standard deviations is `A_h` in the docstring of the class. It is
            # zero for steps of at least one `unit`, of which nothing is left.
            unit = 1.0 if path.unit is None else float(path.unit)
            bound = math.sqrt(2 * path.k * max(-math.log(h / unit), 0))
            lost = max(lost, _variance_beyond(bound))
        # Next comes the path inside the wrapper.
        path = path.path
    return lost


def _variance_beyond(bound: float) -> float:
    """The variance `1 - E[min(|x|, bound)^2]` that a standard normal variable `x` loses if
    it is clipped to the interval from `-bound` to `bound`."""
    # This is the integral of `(x^2 - bound^2) density(x)` over both tails, by parts.
    density_at_bound = math.exp(-(bound**2) / 2) / math.sqrt(2 * math.pi)
    tail_probability = math.erfc(bound / math.sqrt(2)) / 2
    return 2 * (bound * density_at_bound + (1 - bound**2) * tail_probability)


class PlateauIncrement(diffrax.AbstractSpaceTimeLevyArea):
    r"""Increment, space-time Lévy area and plateaus over a step of size $h$.

    The Brownian path is replaced by two plateaus, of height $M - C$ over the first half of
    the step and $M + C$ over the second, where $M = W / 2 + H$ is its mean over the step,
    and

    $$C = \pm\sqrt{\tfrac{1}{15} h + \tfrac{1}{12} W^2 + \tfrac15 H^2}$$

    with a fair sign. In expectation given $W$ and $H$, $M^2 + C^2$ is the mean square of
    the Brownian path over the step. The mean of $C^2$ is $h / 6$.

    - `dt`, `W`, `H`: as in Diffrax.
    - `sign`: the signs of $C$, times $\sqrt h$.
    - `C`: the variables $C_k$.
    """

    dt: PyTree[Float[Array, ""], "BM"]
    W: BM
    H: BM
    sign: BM

    @property
    def C(self) -> BM:
        def half_difference(h: Array, W: Array, H: Array, sign: Array) -> Array:
            # In a solve backward in time Diffrax negates all fields, including the step
            # size.
            h = jnp.abs(h).astype(W.dtype)
            size = jnp.sqrt(h / 15 + W**2 / 12 + H**2 / 5)
            return jnp.copysign(size, sign)

        return jtu.tree_map(half_difference, self.dt, self.W, self.H, self.sign)


class PlateauBrownianPath(AbstractWrappedPath):
    """Adds the plateaus of a [`diffrax_symplectic.PlateauIncrement`][] to the increments of
    a Brownian path with space-time Lévy area. Step sizes must be fixed."""

    path: diffrax.AbstractBrownianPath
    key: PRNGKeyArray
    levy_area: ClassVar = PlateauIncrement  # pyright: ignore

    def __init__(self, path: diffrax.AbstractBrownianPath, key: PRNGKeyArray):
        """**Arguments:**

        - `path`: a Brownian path with space-time Lévy area, for example
            `FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)`.
        - `key`: a JAX random key for the signs, which may be the key of the path.

        **Raises:** a `ValueError` if `path` has no space-time Lévy area.
        """
        check_space_time_area(path, type(self).__name__)
        check_key(key, type(self).__name__)
        self.path = path
        self.key = key

    @property
    def laws(self) -> dict[str, AbstractLaw] | None:
        laws = laws_of(self.path)
        if laws is None:
            return None
        # The space-time-time area that a wrapped path may have is left out. The own random
        # words, which are for the signs, come last.
        return {"W": laws["W"], "H": laws["H"], "sign": TWO_POINT}

    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        increment = self.path.evaluate(t0, t1, use_levy=use_levy)
        if not use_levy:
            return increment
        place = place_of(t0, t1)
        size = self.num_own_words(use_levy)
        words = random_words(
            self.key, place, num_sets=1, set_size=size, first_pair=PLATEAU_WORDS
        )
        return self.own_increment(increment, words[0], t1 - t0)

    def num_own_words(self, use_levy: bool) -> int:
        return num_noises(increment_struct(self.path)) if use_levy else 0

    def own_increment(self, increment, own_words, h) -> Increment:
        """Adds signs to the increment of the wrapped path, one from each own word."""
        # With `use_levy=False` an increment is `W` alone.
        if not isinstance(increment, diffrax.AbstractSpaceTimeLevyArea):
            return increment
        sign = variables_from_words(TWO_POINT, own_words, h, increment.W)
        return PlateauIncrement(increment.dt, increment.W, increment.H, sign)
