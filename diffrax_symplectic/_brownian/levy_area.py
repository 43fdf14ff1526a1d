"""Lévy areas between noises, drawn from Fourier series of the Brownian path."""

import dataclasses
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, PyTree, UInt32

from .._arguments import whole_number
from .._batch import materialize
from .._custom_types import BM, RealScalarLike
from .._products import dot
from .cells import checked_cell, compose, positive_or_one, Segment
from .random import AREA_WORDS, check_key, normal_from_words, place_of, random_words
from .stepwise import AbstractWrappedPath, Increment, increment_struct, num_noises
from .wrappers import check_space_time_area


class LevyAreaIncrement(diffrax.AbstractSpaceTimeLevyArea):
    r"""Increment, space-time Lévy area and Lévy areas over a step of size $h$.

    - `dt`, `W`, `H`: as in Diffrax.
    - `A`: the Lévy areas $A_{kl} = \frac12 \int (w_k \,\mathrm{d}w_l - w_l \,\mathrm{d}
        w_k)$, with $w = 0$ at the start of the step, as an antisymmetric matrix of shape
        `(m, m)`, with the `m` noises in the order of the leaves of `W`.
    """

    dt: PyTree[Float[Array, ""], "BM"]
    W: BM
    H: BM
    A: Float[Array, "m m"]


class LevyAreaBrownianPath(AbstractWrappedPath):
    r"""Adds the Lévy areas of a [`diffrax_symplectic.LevyAreaIncrement`][] to the
    increments of a Brownian path with space-time Lévy area. Step sizes must be fixed.

    Over a step the Brownian path is the line $\frac t h W$ plus a bridge. The first
    `num_terms` Fourier terms of the bridge are drawn conditional on its integral $H$. The
    other terms are replaced by Gaussian variables with the same mean and covariances given
    $H$. So for any number of terms the mean and all covariances of $W$, $H$ and $A$ are
    exact. The law of $A$ itself is approximated, with a mean-square error of
    $\mathcal O(h / \text{num\_terms})$ (Mrongowius and Rößler); `num_terms=0` is Davie's
    approximation. A step draws $2 m\, (\text{num\_terms} + 1) + \frac12 m (m - 1)$ normal
    numbers for $m$ noises.

    With `cell`, the path is sampled over cells of this size, and steps are composed of them
    by Chen's rule, so that solutions whose steps are multiples of `cell` follow the same
    path. A step then costs as much as all cells in it.

    **Source:** [Kloeden, Platen and Wright
    (1992)](https://doi.org/10.1080/07362999208809281) for the Fourier series; [Mrongowius
    and Rößler (2022)](https://doi.org/10.1080/07362994.2021.1922291) for the Gaussian
    remainder; [Davie (2014)](https://doi.org/10.1007/978-3-319-11292-3_7) for the moments
    given $W$ and $H$.
    """

    path: diffrax.AbstractBrownianPath
    key: PRNGKeyArray
    num_terms: int = eqx.field(static=True)
    cell: float | None = eqx.field(static=True)
    levy_area: ClassVar = LevyAreaIncrement  # pyright: ignore
    # The law of the areas is known only given `W` and `H`.
    laws: ClassVar[None] = None  # pyright: ignore

    def __init__(
        self,
        path: diffrax.AbstractBrownianPath,
        key: PRNGKeyArray,
        *,
        num_terms: int = 2,
        cell: float | None = None,
    ):
        """**Arguments:**

        - `path`: a Brownian path with space-time Lévy area, for example
            `FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)`.
        - `key`: a JAX random key for the areas, which may be the key of the path.
        - `num_terms`: the number of Fourier terms in each step or cell.
        - `cell`: the length of the cells, of which every step must be a multiple; or `None`
            to sample each step separately.

        **Raises:** a `ValueError` if `path` has no space-time Lévy area, if `num_terms` is
        negative or `cell` is not positive; an error when run if a step does not consist of
        whole cells.
        """
        check_space_time_area(path, type(self).__name__)
        check_key(key, type(self).__name__)
        self.path = path
        self.key = key
        self.num_terms = whole_number("num_terms", num_terms, 0)
        self.cell = checked_cell(cell)

    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        if self.cell is not None:
            segment = self._composed_segment(t0, t1, self.cell)
        elif use_levy:
            segment = self._drawn_segment(t0, t1)
        else:
            # The increment alone is the wrapped path's.
            return self.path.evaluate(t0, t1)
        shape = increment_struct(self.path)
        return segment.as_increment(LevyAreaIncrement, shape, t1 - t0, use_levy)

    def _composed_segment(self, t0: Array, t1: Array, cell: float) -> Segment:
        """The path from `t0` to `t1`, with areas drawn for each cell."""

        def sample(i: Array) -> Segment:
            # Through rounding a cell may end just beyond the end of the path.
            start = jnp.clip(i * cell, self.path.t0, self.path.t1)
            end = jnp.clip((i + 1) * cell, self.path.t0, self.path.t1)
            return self._drawn_segment(start, end)

        return compose(t0, t1, cell, sample, type(self).__name__)

    def _drawn_segment(self, t0: Array, t1: Array) -> Segment:
        """The path from `t0` to `t1`, with areas drawn for this segment as a whole."""
        # The areas read each entry of `W` and `H` several times. Without `materialize`, XLA
        # would compute it anew for each use.
        increment = materialize(lambda: self.path.evaluate(t0, t1, use_levy=True))
        place = place_of(t0, t1)
        size = self.num_own_words(use_levy=True)
        words = random_words(
            self.key, place, num_sets=1, set_size=size, first_pair=AREA_WORDS
        )
        return self._segment_from_words(increment, words[0], t1 - t0)

    def num_own_words(self, use_levy: bool) -> int:
        if not use_levy:
            return 0
        m = num_noises(increment_struct(self.path))
        return sum(_num_normals(m, self.num_terms))

    def own_increment(self, increment, own_words, h) -> Increment:
        """Adds areas to the increment of the wrapped path. The areas are drawn for the step
        as a whole, even if this path has cells."""
        # With `use_levy=False` an increment is `W` alone.
        if not isinstance(increment, diffrax.AbstractSpaceTimeLevyArea):
            return increment
        segment = self._segment_from_words(increment, own_words, h)
        shape = increment_struct(self.path)
        return segment.as_increment(LevyAreaIncrement, shape, h, use_levy=True)

    def _segment_from_words(
        self, increment: Increment, words: UInt32[Array, " normals"], h: RealScalarLike
    ) -> Segment:
        """The segment over a step of size `h` with this increment of the wrapped path, and
        with areas that are computed from one random word for each normal variable."""
        assert isinstance(increment, diffrax.AbstractSpaceTimeLevyArea)
        H, _ = jfu.ravel_pytree(increment.H)
        segment = Segment.from_increment(increment, jnp.abs(h))
        normals = normal_from_words(words, H.dtype)
        # The Brownian path is a line plus a bridge. A bridge over time `h` is a bridge over
        # unit time, scaled by `sqrt(h)`, as is its `H`. So its areas are scaled by `h`.
        unit_H = H / jnp.sqrt(positive_or_one(segment.h))
        bridge_area = segment.h * _bridge_area(unit_H, normals, self.num_terms)
        # The areas between the line and the bridge are `H_k W_l - W_k H_l`.
        outer = jnp.outer(H, segment.W)
        return dataclasses.replace(segment, A=outer - outer.T + bridge_area)


class _Normals(NamedTuple):
    """Standard normal variables from which the areas of a bridge are computed, by their
    purpose; or the numbers of these variables. The remainder of a Fourier series consists
    of its terms beyond the first `num_terms`.

    - `cosines`, `sines`: for the first `num_terms` coefficients of each noise.
    - `remainder_sums`: for the sum of the cosine coefficients in the remainder, for each
        noise.
    - `mean_parts`: for the area that comes from the means of the cosine coefficients in the
        remainder, for each noise.
    - `deviation_parts`: for the area that comes from the deviations of these coefficients
        from their means, for each pair of noises.
    """

    cosines: Any
    sines: Any
    remainder_sums: Any
    mean_parts: Any
    deviation_parts: Any


def _num_normals(m: int, num_terms: int) -> _Normals:
    """The number of normal variables of each kind for `m` noises."""
    return _Normals(
        cosines=m * num_terms,
        sines=m * num_terms,
        remainder_sums=m,
        mean_parts=m,
        deviation_parts=m * (m - 1) // 2,
    )


def _bridge_area(
    H: Float[Array, " m"], normals: Float[Array, " normals"], num_terms: int
) -> Float[Array, "m m"]:
    r"""The Lévy areas of a Brownian bridge over unit time whose integral is `H`, computed
    from independent standard normal numbers, one after the other as in `_Normals`.

    The bridge is $\sum_r a_r (\cos 2 \pi r t - 1) + b_r \sin 2 \pi r t$ with independent
    coefficients of variance $s_r = 1 / (2 \pi^2 r^2)$. Its integral is $-\sum_r a_r$. Its
    area is $\pi \sum_r r (a_{kr} b_{lr} - b_{kr} a_{lr})$. The steps are:

    1. Draw the first `num_terms` coefficients, and the sum of the other cosine
        coefficients, as if `H` were not known.
    2. Condition the first cosine coefficients on the integral `H`.
    3. To the area of the first terms add two Gaussian parts in place of the area of the
        other terms, with the variances that this area has given `H`.
    """
    m = H.size
    ends = np.cumsum(_num_normals(m, num_terms))
    groups = _Normals(*jnp.split(normals, ends[:-1]))
    # NumPy computes the constants, so that the traced program does not.
    orders = np.arange(1, num_terms + 1)
    variances = 1 / (2 * np.pi**2 * orders**2)
    # The sums of s_r and of s_r^2 over the terms of the remainder, r > num_terms. Over all
    # r these sums are 1/12 and 1/360. With many terms, rounding could make the second
    # difference negative.
    sum_beyond = 1 / 12 - np.sum(variances)
    sum_of_squares_beyond = max(1 / 360 - np.sum(variances**2), 0)
    standard_deviations = jnp.asarray(np.sqrt(variances), H.dtype)
    a = standard_deviations * groups.cosines.reshape(m, num_terms)
    b = standard_deviations * groups.sines.reshape(m, num_terms)
    # The integral is H if the sum of all cosine coefficients is -H. So the coefficients
    # must lose the excess, which is their sum plus H. Independent Gaussian variables are
    # conditioned on their sum by taking from each a share of the excess in proportion to
    # its variance: s_r over the sum of all variances, which is 12 s_r.
    excess = jnp.sum(a, axis=1) + np.sqrt(sum_beyond) * groups.remainder_sums + H
    shares = jnp.asarray(12 * variances, H.dtype)
    a_given_H = a - shares * excess[:, None]
    series = _weighted_product(a_given_H, b, np.pi * orders)
    # Given H, the cosine coefficients of the remainder have the means -12 s_r H and the
    # variances s_r - 12 s_r^2. The means give one part of the area of the remainder, the
    # deviations from them another part. Since (pi r)^2 s_r is 1/2, the variances of these
    # parts are sums of 144 s_r^2 / 2 (times H^2) and of s_r - 12 s_r^2.
    mean_part = jnp.outer(H, np.sqrt(72 * sum_of_squares_beyond) * groups.mean_parts)
    spread = np.sqrt(sum_beyond - 12 * sum_of_squares_beyond)
    # These are the products a_kr b_lr of the area. The products b_kr a_lr are their
    # transpose.
    products = series - mean_part + spread * _above_diagonal(groups.deviation_parts, m)
    return products - products.T


def _above_diagonal(pair_values: Float[Array, " pairs"], m: int) -> Float[Array, "m m"]:
    """The strictly upper triangular matrix with these entries, row by row."""
    # Each entry of the matrix reads the value with its number: a gather, since a scatter is
    # slow. Entries that will be zero read the first value.
    numbers = np.zeros((m, m), int)
    numbers[np.triu_indices(m, 1)] = np.arange(pair_values.size)
    if m < 2:
        # With one noise there is no pair, and no value to read.
        pair_values = jnp.append(pair_values, 0)
    return jnp.triu(pair_values[numbers], 1)


# A matrix product over at most this many Fourier terms is computed as a sum of outer
# products.
_MOST_UNROLLED = 4


def _weighted_product(
    a: Float[Array, "m terms"], b: Float[Array, "m terms"], weights: np.ndarray
) -> Float[Array, "m m"]:
    """The matrix product `a diag(weights) b^T`."""
    if len(weights) > _MOST_UNROLLED:
        a = a * jnp.asarray(weights, a.dtype)
        return dot(a, b.T)
    # In a batch, a product of small matrices takes much longer than its arithmetic. So for
    # few terms it is a sum of outer products.
    products = [
        float(weight) * jnp.outer(a[:, i], b[:, i]) for i, weight in enumerate(weights)
    ]
    # The sum starts from zeros, since there may be no terms at all.
    return sum(products, jnp.zeros((len(a), len(a)), a.dtype))
