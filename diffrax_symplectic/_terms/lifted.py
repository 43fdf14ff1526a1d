"""Hamiltonians of another variable than `(p, q)`, such as spins or complex amplitudes, and
the damping of these. The variable is a function of `(p, q)`, here called the chart."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, PyTree

from .._arguments import check_takes, checked_not_negative
from .._parts import parts_of
from .callers import AbstractCaller
from .hamiltonian import hamiltonian_terms
from .symplectic_gradients import IndexedNoise


class Lifted(AbstractCaller):
    """A Hamiltonian in another variable, `H(t, chart((p, q)), args)`, as a function of
    `(p, q)`.

    It is a Module and not a closure, so that parameters within `H` stay leaves of the
    terms, and so that `has_lifted` finds it.
    """

    H: Callable
    chart: Callable[[tuple[PyTree, PyTree]], PyTree]
    # Whether `H` is the function of an `IndexedNoise`, which takes the index of a noise
    # before the time.
    is_indexed: bool = eqx.field(static=True, default=False)

    def called_with(self, t, y, args):
        index = jax.ShapeDtypeStruct((), jnp.int32)
        inputs = t, jax.eval_shape(self.chart, y), args
        return {"H": (index, *inputs) if self.is_indexed else inputs}

    def __call__(self, *inputs) -> PyTree[Array]:
        # `(t, p, q, args)`, or for an `IndexedNoise` `(k, t, p, q, args)`.
        *index_and_time, p, q, args = inputs
        return self.H(*index_and_time, self.chart((p, q)), args)


def has_lifted(terms: PyTree) -> bool:
    """Whether these terms have Hamiltonians in another variable."""
    return len(parts_of(Lifted, terms)) > 0


def lifted_terms(
    H0: Callable,
    noise: Callable | None,
    path: diffrax.AbstractBrownianPath | PyTree | None,
    chart: Callable[[tuple[PyTree, PyTree]], PyTree],
    variable_name: str,
    damped_drift: Callable | None,
) -> diffrax.MultiTerm:
    """The terms of Hamiltonians in the variable `chart((p, q))`, which messages call
    `variable_name`. With damping, `damped_drift` is the vector field of `(p, q)` that
    takes the place of the vector field of `H0`; without damping it is `None`."""
    check_takes("H0", H0, "t", variable_name, "args")
    if noise is None:
        if path is not None:
            raise ValueError(
                f"`noise` must be a function, called as `noise(t, {variable_name}, args)`; "
                "got None. Without noise, leave out `path`, too."
            )
        lifted_noise = None
    elif isinstance(noise, IndexedNoise):
        # The lifted noises can also be evaluated one at a time, for the solvers that follow
        # the flow of one noise after another.
        lifted_noise = IndexedNoise(Lifted(noise.H, chart, is_indexed=True), noise.m)
    else:
        check_takes("noise", noise, "t", variable_name, "args")
        lifted_noise = Lifted(noise, chart)
    terms = hamiltonian_terms(Lifted(H0, chart), lifted_noise, path)
    if damped_drift is None:
        return terms
    # The first term is the drift, and after it comes the noise, if there is any.
    return diffrax.MultiTerm(diffrax.ODETerm(damped_drift), *terms.terms[1:])


def checked_damping(each: str, alpha: ArrayLike) -> ArrayLike:
    """The damping `alpha`, a number or an array of numbers, one for each damped vector.
    Raises a `ValueError` if a number is known to be negative or not finite. Its message
    calls a vector `each`, such as "each spin"."""
    return checked_not_negative(
        "damping", alpha, expected=f"a number, or an array with one for {each}"
    )


def damping_for(
    each: str, alpha: ArrayLike, shape: tuple[int, ...], dtype: Any
) -> Array:
    """The damping `alpha` of vectors in an array of shape `(*shape, components)`; NaN where
    it is negative or not finite. Raises a `ValueError` unless `alpha` is a number or has
    the shape `shape`. Its message calls a vector `each`."""
    alpha = jnp.asarray(alpha, dtype)
    if alpha.shape not in ((), shape):
        raise ValueError(
            f"`damping` must be a number, or have one for {each}, of shape {shape}; got "
            f"shape {alpha.shape}. (Terms take `(H0, noise, path, damping=alpha)`. The "
            "temperature enters by the noise.)"
        )
    # Traced values cannot raise an error; NaN makes their path fail.
    return jnp.where(jnp.isfinite(alpha) & (alpha >= 0), alpha, jnp.nan)
