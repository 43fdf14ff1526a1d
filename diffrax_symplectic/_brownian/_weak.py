from typing import Any

import diffrax
import equinox as eqx
import jax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._custom_types import BM
from ._laws import AbstractLaw, FOUR_POINT, THREE_POINT, two_point
from ._random_words import check_key, place_of
from ._stepwise import AbstractPathWithLaws, checked_shape, Increment


class WeakIncrement(diffrax.AbstractBrownianIncrement):
    r"""The random variables of one step of a weak method, for a step of size $h$.

    Their low moments, which are all that a weak method needs, are those of Gaussian
    increments. They are bounded, so that implicit stages stay solvable and moments finite.

    - `dt`: the step size $h$.
    - `W`: the three-point variables $\hat I_k$, $\pm\sqrt{3h}$ with probability $1/6$
        each and $0$ with probability $2/3$, with moments 1 to 5 those of
        $\mathcal N(0, h)$. For methods of order 3 the four-point variables, $\pm\sqrt{h
        (3 + \sqrt 6)}$ with probability $(3 - \sqrt 6) / 12$ each and $\pm\sqrt{h (3 -
        \sqrt 6)}$ with probability $(3 + \sqrt 6) / 12$ each: moments 1 to 7.
    - `second`, `third`: further, independent three-point variables $\hat I_{k+m}$ and
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


class WeakBrownianPath(AbstractPathWithLaws):
    r"""Discrete random variables in place of Brownian increments, for weak methods.

    Over each step this gives a [`diffrax_symplectic.WeakIncrement`][]. Steps are
    independent. Use it for expectations, and not for single paths: these are not the
    increments of a Brownian motion, so that a step cannot be divided into shorter ones.
    Step sizes have to be fixed (`diffrax.ConstantStepSize` or `diffrax.StepTo`).

    The increments are a function of `key` and of where the step lies, up to a fraction of
    its size, so that rounding errors of the time do not matter. A step that is computed
    again (for example by the backward pass of `diffrax.RecursiveCheckpointAdjoint`) gets
    the same increments.

    Probabilities are exact up to $2^{-32}$, odd moments exactly zero.
    """

    shape: PyTree[jax.ShapeDtypeStruct] = eqx.field(static=True)
    key: PRNGKeyArray
    second: bool = eqx.field(static=True)
    two_point: bool = eqx.field(static=True)
    order: int = eqx.field(static=True)

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

        - `shape`: a PyTree of `jax.ShapeDtypeStruct`s, the shape, dtype and structure of
            an increment; or a tuple of integers for one array of the default
            floating-point dtype. For `m` noises, `(m,)`.
        - `key`: a JAX random key, as from `jax.random.key(seed)`.
        - `second`: whether to draw a second, independent set of three-point variables.
        - `two_point`: whether to draw the two-point variables.
        - `order`: 2 for the three-point variables, which serve methods of weak order 1
            and 2; 3 for the four-point ones, with `second` and `third`.

        `second` and `two_point` do not change what `W` is for the same `key`.

        **Raises:** a `ValueError` if `key` is not a random key, if a dtype is not real
        floating-point, or if `order` is
        neither 2 nor 3.
        """
        if order not in (2, 3):
            raise ValueError(f"`order` must be 2 or 3; got {order!r}.")
        check_key(key, type(self).__name__)
        self.shape = checked_shape(shape, type(self).__name__)
        self.key = key
        self.second = second or order == 3
        self.two_point = two_point
        self.order = order

    @property
    def levy_area(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return WeakIncrement

    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        words = self.words(place_of(t0, t1), use_levy)
        return self.increment(words, t0, t1, use_levy)

    @property
    def laws(self) -> dict[str, AbstractLaw]:
        laws: dict[str, AbstractLaw]
        laws = {"W": THREE_POINT if self.order == 2 else FOUR_POINT}
        if self.second:
            laws["second"] = THREE_POINT
        if self.order == 3:
            laws["third"] = THREE_POINT
        if self.two_point:
            laws["two_point"] = two_point()
        return laws
