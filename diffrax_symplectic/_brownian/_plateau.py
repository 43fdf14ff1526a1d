import diffrax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._custom_types import BM
from ._laws import AbstractLaw, two_point
from ._random_words import check_key, place_of, PLATEAU_WORDS, random_words
from ._stepwise import draw_set, Increment, laws_of, num_noises
from ._wrapper import (
    AbstractWrappedPath,
    increment_struct,
    require_space_time_area,
)


class PlateauIncrement(diffrax.AbstractSpaceTimeLevyArea):
    r"""Increment, space-time Lévy area and plateaus over a step of size $h$.

    The path over the step stands for two plateaus, of height $M - C$ over its first half
    and $M + C$ over its second. $M = W / 2 + H$ is the mean of the Brownian path over the
    step, and

    $$C = \pm\sqrt{\tfrac{1}{15} h + \tfrac{1}{12} W^2 + \tfrac15 H^2}$$

    with a fair sign: $M^2 + C^2$ is the mean square of the Brownian path over the step, in
    expectation given $W$ and $H$. The mean of $C^2$ is $h / 6$.

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
        return jtu.tree_map(_offset, self.dt, self.W, self.H, self.sign)


def _offset(h, W, H, sign):
    # In a solve backward in time Diffrax changes all signs, that of the step size included.
    h = jnp.abs(h).astype(W.dtype)
    size = jnp.sqrt(h / 15 + W**2 / 12 + H**2 / 5)
    return jnp.copysign(size, sign)


_SIGN = two_point()


class PlateauBrownianPath(AbstractWrappedPath):
    """Adds the plateaus of a [`diffrax_symplectic.PlateauIncrement`][] to the increments of
    a Brownian path with space-time Lévy area. Step sizes have to be fixed."""

    path: diffrax.AbstractBrownianPath
    key: PRNGKeyArray

    def __init__(self, path: diffrax.AbstractBrownianPath, key: PRNGKeyArray):
        """**Arguments:**

        - `path`: a Brownian path with space-time Lévy area, for example
            `FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)`.
        - `key`: a JAX random key for the signs, which may be that of the path.

        **Raises:** a `ValueError` if `path` has no space-time Lévy area.
        """
        require_space_time_area(path, type(self).__name__)
        check_key(key, type(self).__name__)
        self.path = path
        self.key = key

    @property
    def levy_area(self):
        return PlateauIncrement

    @property
    def laws(self) -> dict[str, AbstractLaw] | None:
        laws = laws_of(self.path)
        if laws is None:
            return None
        # The increments here hold no space-time-time areas.
        return {"W": laws["W"], "H": laws["H"], "sign": _SIGN}

    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        increment = self.path.evaluate(t0, t1, use_levy=use_levy)
        if not use_levy:
            return increment
        n = self.num_own_words(use_levy)
        words = random_words(self.key, place_of(t0, t1), 1, n, PLATEAU_WORDS)
        return self.changed(increment, words[0], t1 - t0, use_levy)

    def num_own_words(self, use_levy: bool) -> int:
        return num_noises(increment_struct(self.path)) if use_levy else 0

    def changed(self, increment, own_words, h, use_levy) -> Increment:
        if not use_levy:
            return increment
        assert isinstance(increment, diffrax.AbstractSpaceTimeLevyArea)
        sign = draw_set(_SIGN, own_words, h, increment.W)
        return PlateauIncrement(increment.dt, increment.W, increment.H, sign)
