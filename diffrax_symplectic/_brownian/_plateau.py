import diffrax
import jax.flatten_util as jfu
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from .._custom_types import BM, RealScalarLike
from ._fixed_steps import require_fixed_steps
from ._random_words import check_key, random_words
from ._weak import fair_sign
from ._wrapper import AbstractWrappedPath, require_space_time_area


class PlateauIncrement(diffrax.AbstractSpaceTimeLevyArea):
    r"""Increment, space-time Lévy area and plateaus over a step of size $h$.

    The path over the step stands for two plateaus, of height $M - C$ over its first half
    and $M + C$ over its second, with $M = W / 2 + H$ its mean and $C = \pm\sqrt{h / 6}$
    with a fair sign: they have the mean of the Brownian path over the step and, in
    expectation, its mean square.

    - `dt`, `W`, `H`: as for Diffrax.
    - `C`: the variables $C_k$.
    """

    dt: PyTree[Float[Array, ""], "BM"]
    W: BM
    H: BM
    C: BM


class PlateauBrownianPath(AbstractWrappedPath):
    """Adds the plateaus of a [`diffrax_symplectic.PlateauIncrement`][] to the increments of
    a Brownian path with space-time Lévy area. Step sizes have to be fixed."""

    path: diffrax.AbstractBrownianPath
    key: PRNGKeyArray

    def __init__(self, path: diffrax.AbstractBrownianPath, key: PRNGKeyArray):
        """**Arguments:**

        - `path`: a Brownian path, for example `diffrax.VirtualBrownianTree(...,
            levy_area=diffrax.SpaceTimeLevyArea)`.
        - `key`: a JAX random key for the signs, independent of the path's.

        **Raises:** a `ValueError` if `path` has no space-time Lévy area.
        """
        require_space_time_area(path, type(self).__name__)
        check_key(key, type(self).__name__)
        self.path = path
        self.key = key

    @property
    def levy_area(self):
        return PlateauIncrement

    def evaluate(
        self,
        t0: RealScalarLike,
        t1: RealScalarLike | None = None,
        left: bool = True,
        use_levy: bool = False,
    ) -> PyTree[Array] | PlateauIncrement:
        """Implements [`diffrax.AbstractBrownianPath.evaluate`][].

        **Raises:** a `ValueError`, while tracing, inside a solve with an adaptive step
        size controller or `diffrax.HalfSolver`.
        """
        require_fixed_steps(self)
        increment = self.path.evaluate(t0, t1, left, use_levy)
        if not use_levy:
            return increment
        assert isinstance(increment, diffrax.AbstractSpaceTimeLevyArea)
        start, end = (jnp.zeros_like(t0), t0) if t1 is None else (t0, t1)
        flat, unravel = jfu.ravel_pytree(increment.W)
        words = random_words(
            self.key, jnp.asarray(start), jnp.asarray(end), 1, flat.size
        )
        size = jnp.sqrt(jnp.abs(jnp.asarray(end) - start) / 6).astype(flat.dtype)
        C = unravel(fair_sign(words[0], size))
        return PlateauIncrement(dt=increment.dt, W=increment.W, H=increment.H, C=C)
