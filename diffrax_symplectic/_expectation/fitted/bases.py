"""The bases in which value functions are fitted: what a basis is, and polynomial bases.
(The basis on a grid is in `grid.py`.)"""

import abc
import functools as ft
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Key, PyTree

from ..._products import dot, tensordot
from .polynomials import hermite, least_squares, num_polynomials


# The number of pilot paths for each polynomial, and the least number in all. The fit hardly
# depends on them: for the Hénon-Heiles system by degree 6, standard errors were 0.6e-7 to
# 1.8e-7 with 5 to 90 paths for each polynomial, and 1e-3 without a fit.
_PILOTS_PER_POLYNOMIAL = 30
_FEWEST_PILOTS = 256
# The pilot's states are perturbed by this fraction of their standard deviations, since
# after the first steps the paths are in only a few different states. Four times as much
# made the standard errors 2 to 5 times larger, for the Hénon-Heiles system and for a
# pendulum by degree 4.
_PERTURBATION = 0.2
# A lower bound of the standard deviations along the axes of the covariance, as a fraction
# of the largest. Along shorter axes the points do not determine a fit. For both systems,
# 0.001 to 0.3 gave the same standard errors.
_LEAST_DEVIATION = 0.1
# The most and the fewest pilot paths of `Quadratic`, which averages Hessians over their
# states. A Hessian in `d` dimensions needs `d` gradients, so between these bounds there are
# `_QUADRATIC_GRADIENTS / d` paths.
_MOST_QUADRATIC_PILOTS = 128
_FEWEST_QUADRATIC_PILOTS = 16
_QUADRATIC_GRADIENTS = 2**13

# Maps a state to the values to which functions are fitted, or a state and a random key to
# estimates of these values.
Target: TypeAlias = Callable[..., Float[Array, "S m"]]


class CovarianceFrame(eqx.Module):
    """Coordinates in which the states have mean zero and standard deviations of about one.
    They do not depend on components of the state that do not move."""

    mean: Float[Array, " d"]
    # The matrices from states to coordinates and back.
    to_coordinates: Float[Array, "d d"]
    to_states: Float[Array, "d d"]

    def coordinates(self, y: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """The coordinates of states."""
        return dot(y - self.mean, self.to_coordinates.T)

    def states(self, z: Float[Array, "*n d"]) -> Float[Array, "*n d"]:
        """The states with these coordinates."""
        return self.mean + dot(z, self.to_states.T)

    @staticmethod
    def of(
        points: Float[Array, "n d"], good: Bool[Array, " n"], scales: Float[Array, " d"]
    ) -> "CovarianceFrame":
        """The frame along the axes of the covariance of the good points. First each
        component of the state is divided by its scale, so that components are comparable.
        `scales` are zero for components that do not move."""
        weights = equal_weights(good, points.dtype)
        mean = weights @ points
        inverse_scales = inverse_or_zero(scales)
        scaled = (points - mean) * inverse_scales
        covariance = (scaled.T * weights) @ scaled
        # The variances along the axes are in ascending order.
        variances, axes = jnp.linalg.eigh(covariance)
        least_variance = _LEAST_DEVIATION**2 * variances[-1]
        # This keeps the matrices finite where nothing moves at all.
        tiny = jnp.finfo(points.dtype).eps ** 2
        deviations = jnp.sqrt(jnp.maximum(variances, least_variance) + tiny)
        return CovarianceFrame(
            mean=mean,
            to_coordinates=axes.T / deviations[:, None] * inverse_scales,
            to_states=scales[:, None] * axes * deviations,
        )

    def perturbed(self, states: Float[Array, "n d"]) -> Float[Array, "n d"]:
        """The states, perturbed at random."""
        # All steps have the same perturbations, constants from NumPy: drawing from keys
        # would take long to compile.
        z = np.random.default_rng(0).normal(0, _PERTURBATION, states.shape)
        return states + dot(jnp.asarray(z, states.dtype), self.to_states.T)


def equal_weights(good: Bool[Array, " n"], dtype: Any) -> Float[Array, " n"]:
    """The weights of the mean over all points or paths that are good."""
    return good.astype(dtype) / jnp.maximum(jnp.sum(good), 1)


def inverse_or_zero(scales: Float[Array, " d"]) -> Float[Array, " d"]:
    """One over each scale that is positive, and otherwise zero."""
    is_positive = scales > 0
    # The inner `where` avoids a division by zero.
    return jnp.where(is_positive, 1 / jnp.where(is_positive, scales, 1), 0)


class AbstractBasis(eqx.Module):
    """Functions of `d` coordinates. Each function is a linear combination of `size` basis
    functions. Arrays of coefficients have the leading axis `size`, followed by axes for
    times at which to average and for components of `phi`."""

    d: eqx.AbstractVar[int]
    # A number that says how fine the basis is, such as a degree, and its name for messages.
    resolution: eqx.AbstractVar[int]
    resolution_name: eqx.AbstractClassVar[str]

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """The number of coefficients of a function."""

    @property
    @abc.abstractmethod
    def num_pilots(self) -> int:
        """The number of pilot paths that a fit needs."""

    @property
    @abc.abstractmethod
    def num_sites(self) -> int:
        """The number of states at which a fit evaluates its target."""

    @abc.abstractmethod
    def frame(
        self,
        states: Float[Array, "n d"],
        good: Bool[Array, " n"],
        scales: Float[Array, " d"],
    ) -> PyTree:
        """The coordinates in which functions are fitted, as a PyTree of arrays. `states`
        are those of the pilot's paths after a step, and `good` says which paths did not
        fail. `scales` has a length scale for each component of the state, which is zero if
        the component does not move."""

    @abc.abstractmethod
    def coefficients(
        self,
        target: Target,
        frame: Any,
        states: Float[Array, "n d"],
        good: Bool[Array, " n"],
        keys: Key[Array, " n"],
    ) -> Float[Array, "size S m"]:
        """The coefficients of the functions fitted to `target`, for `S` times and `m`
        components of `phi`. The fit is made at or near the pilot's `states` that are
        `good`. A basis calls `target(state)`, or for a random estimate, which costs less,
        `target(state, key)` with the key of the pilot's path."""

    @abc.abstractmethod
    def value_at(
        self, frame: Any, y: Float[Array, " d"], c: Float[Array, "size S m"]
    ) -> Float[Array, "S m"]:
        """The values at a state of the functions with these coefficients."""


class Hermite(AbstractBasis):
    """Products of Hermite polynomials in all coordinates, up to a total degree, which is
    the `resolution`. The coefficients are a least-squares fit."""

    d: int
    resolution: int
    resolution_name: ClassVar[str] = "degree"

    @property
    def size(self):
        return num_polynomials(self.d, self.resolution)

    @property
    def num_pilots(self):
        return max(_FEWEST_PILOTS, _PILOTS_PER_POLYNOMIAL * self.size)

    @property
    def num_sites(self):
        return self.num_pilots

    def frame(self, states, good, scales):
        return CovarianceFrame.of(states, good, scales)

    def coefficients(self, target, frame, states, good, keys):
        points = frame.perturbed(states)
        values = jax.vmap(target)(points)
        c = self.least_squares_fits(values, frame, points, good, [self.resolution])
        return c[:, 0]

    def least_squares_fits(
        self,
        values: Float[Array, "n S m"],
        frame: CovarianceFrame,
        points: Float[Array, "n d"],
        good: Bool[Array, " n"],
        degrees: Sequence[int],
    ) -> Float[Array, "size degrees S m"]:
        """The coefficients of a least-squares fit of each of these degrees to the values at
        the good points."""
        B = self.polynomials(frame, points)
        # (n, S * m)
        flat_values = values.reshape(len(values), -1)
        is_finite = jnp.isfinite(flat_values).all(axis=1)
        is_used = good & jnp.isfinite(B).all(axis=1) & is_finite
        # Rows of zeros have no part in a fit.
        B = jnp.where(is_used[:, None], B, 0)
        flat_values = jnp.where(is_used[:, None], flat_values, 0)
        sizes = [num_polynomials(self.d, degree) for degree in degrees]
        c = least_squares(B, flat_values, sizes)
        return c.reshape(*c.shape[:2], *values.shape[1:])

    def polynomials(
        self, frame: CovarianceFrame, points: Float[Array, "n d"]
    ) -> Float[Array, "n size"]:
        """The values of all polynomials at points."""
        of_all_points = jax.vmap(ft.partial(hermite, degree=self.resolution))
        return jnp.stack(of_all_points(frame.coordinates(points)), axis=1)

    def value_at(self, frame, y, c):
        polynomials = hermite(frame.coordinates(y), self.resolution)
        # A sum of products, rather than a product of arrays, compiles to one loop without
        # temporary arrays.
        return ft.reduce(jnp.add, map(jnp.multiply, polynomials, c))


class Quadratic(AbstractBasis):
    """Quadratic functions for a `resolution` of 2, and linear ones for 1. The coefficients
    are the first and then the second derivatives, averaged over the pilot's states. For
    Gaussian states these averages are the least-squares fit, by Stein's lemma.

    The frame is the mean of the states and the scales of their components. Coordinates are
    states minus the mean, divided by the scales. For components that do not move, scales
    and coordinates are zero."""

    d: int
    resolution: int
    resolution_name: ClassVar[str] = "degree"

    @property
    def size(self):
        return self.d + self.d**2

    @property
    def num_pilots(self):
        affordable = max(_FEWEST_QUADRATIC_PILOTS, _QUADRATIC_GRADIENTS // self.d)
        return min(affordable, _MOST_QUADRATIC_PILOTS)

    @property
    def num_sites(self):
        # A Hessian costs as much as `d` gradients, and a gradient as much as two values.
        return 2 * self.d * self.num_pilots

    def frame(self, states, good, scales):
        return equal_weights(good, states.dtype) @ states, scales

    def coefficients(self, target, frame, states, good, keys):
        _, scales = frame

        def derivatives(key_and_state):
            """The first and second derivatives of the target at a state, with respect to
            coordinates `z`, as one array."""
            key, y = key_and_state

            def target_from_state(z):
                return target(y + scales * z, key)

            def gradient_twice(z):
                gradient = jax.jacrev(target_from_state)(z)
                return gradient, gradient

            # The gradient comes along with its derivative, as auxiliary output, and is not
            # evaluated once more.
            hessian_and_gradient = jax.jacfwd(gradient_twice, has_aux=True)
            # (S, m, d, d) and (S, m, d)
            hessian, gradient = hessian_and_gradient(jnp.zeros_like(y))
            flat_hessian = hessian.reshape(*gradient.shape[:-1], -1)
            # (d + d**2, S, m)
            return jnp.moveaxis(jnp.concatenate([gradient, flat_hessian], -1), -1, 0)

        # One path after another, since a Hessian takes the memory of `d` gradients.
        of_paths = lax.map(derivatives, (keys, states))
        weights = equal_weights(good, of_paths.dtype)
        mean = tensordot(weights, jnp.where(jnp.isfinite(of_paths), of_paths, 0), 1)
        # Derivatives of a higher order than the `resolution` are left out.
        order = np.repeat([1, 2], [self.d, self.d**2])[:, None, None]
        return jnp.where(order <= self.resolution, mean, 0)

    def value_at(self, frame, y, c):
        mean, scales = frame
        z = (y - mean) * inverse_or_zero(scales)
        d = len(y)
        gradient = c[:d]
        hessian = c[d:].reshape(d, d, *c.shape[1:])
        # The Taylor polynomial without its constant: a control variate is a difference of
        # values, from which the constant cancels.
        return tensordot(z, gradient + tensordot(z, hessian, 1) / 2, 1)
