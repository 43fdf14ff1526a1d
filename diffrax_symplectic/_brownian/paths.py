"""Brownian paths that draw independent random variables in each step: discrete ones for
weak methods, or Gaussian ones."""

import abc
import functools as ft
import math
from collections.abc import Mapping
from typing import Any, cast, ClassVar, TYPE_CHECKING

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._custom_types import BM
from .cells import checked_cell, compose, Segment
from .random import (
    AbstractLaw,
    check_key,
    FOUR_POINT,
    Place,
    place_of,
    random_words,
    THREE_POINT,
    TWO_POINT,
)
from .stepwise import (
    AbstractStepwisePath,
    checked_shape,
    GAUSSIAN_LAWS,
    Increment,
    num_noises,
    step_size,
    variables_from_words,
)


if TYPE_CHECKING:
    # These lines stand in each module that needs them. If one module imported the name from
    # another, Pyright would take the variables for arguments of `__init__`.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class WeakIncrement(diffrax.AbstractBrownianIncrement):
    r"""The random variables of a weak method over a step of size $h$.

    Their low moments agree with Gaussian increments, which is all that a weak method needs.
    They are bounded, so implicit stages remain solvable and moments finite.

    - `dt`: the step size $h$.
    - `W`: the three-point variables $\hat I_k$, $\pm\sqrt{3h}$ with probability $1/6$
        each and $0$ with probability $2/3$, with moments 1 to 5 of $\mathcal N(0, h)$.
        For methods of order 3, the four-point variables, $\pm\sqrt{h (3 + \sqrt 6)}$ with
        probability $(3 - \sqrt 6) / 12$ each and $\pm\sqrt{h (3 - \sqrt 6)}$ with
        probability $(3 + \sqrt 6) / 12$ each, with moments 1 to 7.
    - `second`, `third`: additional independent three-point variables $\hat I_{k+m}$ and
        $\hat I_{k+2m}$, or `None`.
    - `two_point`: the variables $\tilde I_k = \pm\sqrt h$ with probability $1/2$ each,
        independent of the others, or `None`.

    `W`, `second`, `third` and `two_point` have the structure and shapes of the path.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    equations (2.3)-(2.5) and (3.3).
    """

    dt: PyTree[Float[Array, ""], "BM"]
    W: BM
    second: BM | None = None
    two_point: BM | None = None
    third: BM | None = None


class AbstractPathWithLaws(AbstractStepwisePath):
    """A path that draws independent random variables in each step: for each noise, one with
    each of its `laws`. The random words of a step come in sets: one set for each law, in
    the order of `laws`, with one word for each noise.

    The law of the increment, `"W"`, comes first: it can be drawn without the others.

    - `cell`: the length of the cells of which steps are composed; or `None` if each step is
        sampled separately.
    """

    shape: AbstractVar[PyTree[jax.ShapeDtypeStruct]]
    key: AbstractVar[PRNGKeyArray]
    cell: AbstractVar[float | Float[Array | np.ndarray, ""] | None]
    t0: ClassVar[float] = -math.inf
    t1: ClassVar[float] = math.inf

    @property
    @abc.abstractmethod
    def laws(self) -> Mapping[str, AbstractLaw]: ...

    def _drawn_laws(self, use_levy: bool) -> Mapping[str, AbstractLaw]:
        """The laws of the random variables that a step draws: without `use_levy` it draws
        only the increment."""
        return self.laws if use_levy else {"W": self.laws["W"]}

    def num_words(self, use_levy: bool = False) -> int:
        return len(self._drawn_laws(use_levy)) * num_noises(self.shape)

    def increment(self, words, t0, t1, use_levy: bool = False) -> Increment:
        h = t1 - t0
        set_size = num_noises(self.shape)
        variables = {}
        for i, (name, law) in enumerate(self._drawn_laws(use_levy).items()):
            set_of_words = words[i * set_size : (i + 1) * set_size]
            variables[name] = variables_from_words(law, set_of_words, h, self.shape)
        if not use_levy:
            return variables["W"]
        # To a type checker `levy_area` is any class of increments.
        return cast(Any, self.levy_area)(dt=step_size(h, self.shape), **variables)

    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        if self.cell is None:
            return self._drawn_at(place_of(t0, t1), t0, t1, use_levy)
        cell = jnp.asarray(self.cell, t0.dtype)

        def sample(i: Array) -> Segment:
            # The place of a cell is its number `i`, not `place_of` its times: the number is
            # exact, while the times are rounded.
            place = (i.astype(jnp.int32), jnp.array(0))
            # Given the words, only the size of a step matters, not its start. With
            # `use_levy` the increment is an object, as `from_increment` needs.
            increment = self._drawn_at(place, t0=0 * cell, t1=cell, use_levy=True)
            return Segment.from_increment(increment, cell)

        segment = compose(t0, t1, self.cell, sample, type(self).__name__)
        return segment.as_increment(self.levy_area, self.shape, t1 - t0, use_levy)

    def _drawn_at(self, place: Place, t0: Array, t1: Array, use_levy: bool):
        """The increment from `t0` to `t1`, from the random words that belong to `place`."""
        # The first sets of words are the same for any number of sets. So `W` does not
        # depend on `use_levy`.
        num_sets = len(self._drawn_laws(use_levy))
        words = random_words(self.key, place, num_sets, set_size=num_noises(self.shape))
        return self.increment(words.reshape(-1), t0, t1, use_levy)


class WeakBrownianPath(AbstractPathWithLaws):
    r"""Discrete random variables in place of Brownian increments, for weak methods.

    Each step has its own [`diffrax_symplectic.WeakIncrement`][]. Use this path for
    expectations only: these are not the increments of a Brownian motion, so a step cannot
    be divided into shorter ones. Step sizes must be fixed (`diffrax.ConstantStepSize` or
    `diffrax.StepTo`).

    The increments are a function of `key` and the position of the step, up to a fraction of
    its size, so rounding errors of the times do not matter. A step that is recomputed, as
    in a backward pass, gets the same increments.

    Probabilities are exact up to $2^{-32}$, and odd moments are exactly zero.
    """

    shape: PyTree[jax.ShapeDtypeStruct] = eqx.field(static=True)
    key: PRNGKeyArray
    second: bool = eqx.field(static=True)
    two_point: bool = eqx.field(static=True)
    order: int = eqx.field(static=True)
    levy_area: ClassVar = WeakIncrement  # pyright: ignore
    cell: ClassVar[None] = None  # pyright: ignore

    def __init__(
        self,
        shape: tuple[int, ...] | PyTree[jax.ShapeDtypeStruct],
        key: PRNGKeyArray,
        *,
        second: bool = False,
        two_point: bool = False,
        order: int = 2,
    ):
        r"""**Arguments:**

        - `shape`: the shape of an increment, `(m,)` for `m` noises; or a PyTree of
            `jax.ShapeDtypeStruct`s.
        - `key`: a JAX random key, such as `jax.random.key(seed)`.
        - `second`: whether to draw a second, independent set of three-point variables.
        - `two_point`: whether to draw the two-point variables.
        - `order`: 2 for the three-point variables, which suffice for methods of weak order
            1 and 2; 3 for the four-point variables, with `second` and `third`.

        For the same `key`, `second` and `two_point` do not change `W`.

        **Raises:** a `ValueError` if `key` is not a random key, if a dtype is not real
        floating-point, or if `order` is neither 2 nor 3.
        """
        if order not in (2, 3):
            raise ValueError(f"`order` must be 2 or 3; got {order!r}.")
        check_key(key, type(self).__name__)
        self.shape = checked_shape(shape, type(self).__name__)
        self.key = key
        # Methods of order 3 need three variables for each noise.
        self.second = second or order == 3
        self.two_point = two_point
        self.order = order

    @property
    def laws(self) -> dict[str, AbstractLaw]:
        increment_law = THREE_POINT if self.order == 2 else FOUR_POINT
        laws: dict[str, AbstractLaw] = {"W": increment_law}
        if self.second:
            laws["second"] = THREE_POINT
        if self.order == 3:
            laws["third"] = THREE_POINT
        if self.two_point:
            laws["two_point"] = TWO_POINT
        return laws


class FixedStepBrownianPath(AbstractPathWithLaws):
    r"""Gaussian increments of a Brownian motion, for fixed steps.

    Over a step of size $h$ the increment is $W \sim \mathcal N(0, h)$, and with space-time
    Lévy area there is an independent $H \sim \mathcal N(0, h / 12)$. As for
    [`diffrax_symplectic.WeakBrownianPath`][], they are a function of `key` and the position
    of the step. So reverse-mode gradients work and noise does not repeat late in a run,
    unlike with `diffrax.UnsafeBrownianPath`, and a step costs no more than its random
    numbers, unlike with `diffrax.VirtualBrownianTree`.

    Without `cell`, steps of another size belong to another Brownian motion. With `cell`,
    one Brownian motion is sampled over cells of this size, and the increment over a step is
    the sum over its cells. So solutions whose steps are multiples of `cell` follow the same
    path, as needed for strong errors against a fine solution. A step then costs as much as
    all cells in it.

    Each number is the inverse of the normal distribution function at a random 32-bit word,
    with a relative error below $10^{-8}$ in float64: $2^{32}$ different values, up to 6.3
    standard deviations. The relative error of the variance is $10^{-7}$, and of even
    moments up to the eighth $10^{-5}$; odd moments vanish up to rounding.
    """

    shape: PyTree[jax.ShapeDtypeStruct] = eqx.field(static=True)
    key: PRNGKeyArray
    levy_area: type[diffrax.BrownianIncrement | diffrax.SpaceTimeLevyArea] = eqx.field(
        static=True
    )
    cell: float | None = eqx.field(static=True)

    def __init__(
        self,
        shape: tuple[int, ...] | PyTree[jax.ShapeDtypeStruct],
        key: PRNGKeyArray,
        levy_area: type[
            diffrax.BrownianIncrement | diffrax.SpaceTimeLevyArea
        ] = diffrax.BrownianIncrement,
        *,
        cell: float | None = None,
    ):
        """**Arguments:**

        - `shape`, `key`: as for [`diffrax_symplectic.WeakBrownianPath`][].
        - `levy_area`: `diffrax.BrownianIncrement` or `diffrax.SpaceTimeLevyArea`.
        - `cell`: the length of the cells, of which every step must be a multiple; or `None`
            to sample each step separately.

        **Raises:** a `ValueError` if `key` is not a random key, if a dtype is not real
        floating-point, for another `levy_area`, or if `cell` is not positive; an error
        when run if a step does not consist of whole cells.
        """
        if levy_area not in (diffrax.BrownianIncrement, diffrax.SpaceTimeLevyArea):
            raise ValueError(
                "`levy_area` must be `diffrax.BrownianIncrement` or "
                f"`diffrax.SpaceTimeLevyArea`; got {levy_area!r}."
            )
        check_key(key, type(self).__name__)
        self.shape = checked_shape(shape, type(self).__name__)
        self.key = key
        self.levy_area = levy_area
        self.cell = checked_cell(cell)

    @property
    def laws(self) -> Mapping[str, AbstractLaw]:
        return GAUSSIAN_LAWS[self.levy_area]


class CommonBrownianPath(AbstractPathWithLaws):
    """The same Brownian motion as a `FixedStepBrownianPath` with space-time Lévy area and
    the same `cell`. Here the `cell` may be traced, so that paths with different cells share
    one compiled program."""

    shape: PyTree[jax.ShapeDtypeStruct] = eqx.field(
        static=True,
        converter=ft.partial(checked_shape, path_name="CommonBrownianPath"),
    )
    key: PRNGKeyArray
    cell: Float[Array | np.ndarray, ""]
    levy_area: ClassVar = diffrax.SpaceTimeLevyArea  # pyright: ignore
    laws: ClassVar = GAUSSIAN_LAWS[diffrax.SpaceTimeLevyArea]  # pyright: ignore
