import dataclasses

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array

from .._custom_types import RealScalarLike
from ._stepwise import Increment
from ._wrapper import AbstractWrappedPath


class TruncatedBrownianPath(AbstractWrappedPath):
    r"""Bounds the increments of a Brownian path, for implicit strong methods.

    Over a step of size $h < 1$ an increment $\sqrt h\,\xi$ becomes
    $\sqrt h\,\max(-A_h, \min(\xi, A_h))$ with $A_h = \sqrt{2 k |\ln h|}$. A Gaussian
    increment is unbounded, so that at any step size an implicit stage has, with positive
    probability, no solution; a truncated one is bounded by $\sqrt{2 k h |\ln h|}$. The
    price is a mean-square error $\mathbb E[(\xi - \xi_h)^2] \leq h^k$: take $k$ at least
    twice the strong order of the method.

    Steps have to be well below one unit of time, where the bound becomes 0: for `k=2` an
    increment keeps 97% of its variance at $h = 1/4$, 84% at $h = 1/2$ and 28% at
    $h = 0.9$.

    Lévy areas of the wrapped path are kept as they are. Step sizes have to be fixed.

    **Source:** [Milstein, Repin and Tretyakov
    (2002)](https://doi.org/10.1137/S0036142901395588).
    """

    path: diffrax.AbstractBrownianPath
    k: int = eqx.field(static=True)

    def __init__(self, path: diffrax.AbstractBrownianPath, *, k: int = 2):
        """**Arguments:**

        - `path`: any Brownian path of Diffrax.
        - `k`: the integer $k \\geq 1$ above.

        **Raises:** a `ValueError` if `k` is not a positive integer, or `path` is not a
        Brownian path. An error when run if a step is not shorter than one unit of time,
        where $A_h$ has no meaning.
        """
        if not isinstance(path, diffrax.AbstractBrownianPath):
            raise ValueError(
                "`TruncatedBrownianPath` wraps a Brownian path, for example "
                f"`FixedStepBrownianPath(shape, key)`; got {type(path).__name__}."
            )
        if isinstance(k, bool) or not isinstance(k, int) or k < 1:
            raise ValueError(
                "`k` must be an integer, 1 or larger (2 suits methods of strong order "
                f"1); got {k!r}."
            )
        self.path = path
        self.k = k

    @property
    def levy_area(self):
        return self.path.levy_area

    @property
    def laws(self) -> None:
        return None

    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        increment = self.path.evaluate(t0, t1, use_levy=use_levy)
        return self._clip(increment, t1 - t0)

    def num_own_words(self, use_levy: bool) -> int:
        del use_levy
        return 0

    def changed(self, increment, own_words, h, use_levy) -> Increment:
        del own_words, use_levy
        return self._clip(increment, h)

    def _clip(self, increment: Increment, h: RealScalarLike) -> Increment:
        h = jnp.abs(h)
        h = eqx.error_if(
            h,
            h >= 1,
            "`TruncatedBrownianPath` needs steps shorter than one unit of time, since "
            "the bound is a multiple of sqrt(|ln h|). Pass a smaller `dt0`, or measure "
            "time in larger units.",
        )
        # The bound of an empty step is zero, as h |ln h| tends to 0 with h.
        log_h = jnp.log(jnp.where(h > 0, h, 1))
        bound = jnp.sqrt(2 * self.k * h * jnp.abs(log_h))

        def clip(w):
            return jnp.clip(w, -bound.astype(w.dtype), bound.astype(w.dtype))

        if isinstance(increment, diffrax.AbstractBrownianIncrement):
            return dataclasses.replace(increment, W=jtu.tree_map(clip, increment.W))
        return jtu.tree_map(clip, increment)
