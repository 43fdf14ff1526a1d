"""The drift that makes a Stratonovich equation of an Ito equation."""

import functools as ft
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from .._brownian import increment_struct, UnspecifiedPath, zeros_and_unravel
from .._custom_types import Args, RealScalarLike, Terms, Y
from .drift_and_noise import flattened
from .paths import brownian_paths, motion_numbers, replace_paths, shapes_as_paths
from .vector_fields import apply


def ito_drift(*noise: diffrax.AbstractTerm) -> diffrax.ODETerm:
    r"""The drift to add if noise is meant in the sense of Itô: with it, the solvers of this
    package solve $\mathrm{d}y = a\,\mathrm{d}t + \sum_k b_k\,\mathrm{d}w_k$.

    !!! example

        ```python
        import diffrax
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        drift = diffrax.ODETerm(lambda t, y, args: 0.5 * y)
        path = ds.WeakBrownianPath((), jr.key(0))
        noise = diffrax.ControlTerm(lambda t, y, args: 0.3 * y, path)
        terms = diffrax.MultiTerm(drift, ds.ito_drift(noise), noise)
        price = lambda t, y, args: y
        call = price, terms, ds.StrangGauss(), 0, 1, 0.1, jnp.array(1.0)
        print(ds.expectation(*call, key=jr.key(1)))  # exp(0.5)
        ```

    The drift is $-\frac12 \sum_k (\partial b_k / \partial y)\, b_k$, computed from the
    terms with one derivative for each noise. It is zero for noise that does not depend on
    the state, and for the noise of `langevin_terms`.

    **Arguments:**

    - `noise`: noise terms, or a `MultiTerm` of these, with paths or shapes of paths. Pass
        all that share a path in one call: what one of them adds depends on the others.

    **Returns:** an `ODETerm`.

    **Raises:** a `ValueError` if a term has no Brownian path.
    """
    parts = tuple(part for term in noise for part in flattened(shapes_as_paths(term)))
    paths = [brownian_paths(part) for part in parts]
    if len(parts) == 0 or not all(len(found) == 1 for found in paths):
        names = ", ".join(f"`{type(part).__name__}`" for part in parts) or "none"
        raise ValueError(
            "`ito_drift` takes noise terms, each with a Brownian path, such as "
            f"`diffrax.ControlTerm(field, path)` or `noise_terms(H, path)`; got {names}."
        )
    motions = motion_numbers([path for (path,) in paths])
    # A term with a path would count as noise. The drift needs only the shapes of the paths.
    pathless = replace_paths(
        parts, lambda path: UnspecifiedPath(increment_struct(path))
    )
    leaves, structure = jtu.tree_flatten(pathless)
    return diffrax.ODETerm(_ItoDrift(leaves, structure, motions))


class _ItoDrift(eqx.Module):
    """The vector field `-1/2 sum_k b_k' b_k` of `ito_drift`, where `b_k'` is the derivative
    of the noise `b_k` by the state.

    - `leaves`, `structure`: the noise terms, flattened. Functions that look for noise or
        Hamiltonians in a PyTree of terms would find whole noise terms within this drift.
    - `motions`: for each noise term the number of the Brownian motion that drives it.
    """

    leaves: list[Any]
    structure: Any = eqx.field(static=True)
    motions: tuple[int, ...] = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, y: Y, args: Args) -> Y:
        noise: Terms = jtu.tree_unflatten(self.structure, self.leaves)
        structs = map(increment_struct, brownian_paths(noise))
        zeros, unravel = zeros_and_unravel(dict(zip(self.motions, structs)))

        def derivative_along_itself(unit: Float[Array, " n"]) -> Y:
            """`b_k' b_k` for one noise `k`. `unit` holds the increments of all Brownian
            motions, flattened: one for this noise, and zero for all others."""
            increments = unravel(unit)
            controls = [increments[motion] for motion in self.motions]
            # `b_k` as a function of the state.
            field = ft.partial(apply, noise, controls, args, t)
            _, change = jax.jvp(field, (y,), (field(y),))
            return change

        units = jnp.eye(zeros.size, dtype=zeros.dtype)
        changes = jax.vmap(derivative_along_itself)(units)
        return jtu.tree_map(lambda change: -jnp.sum(change, axis=0) / 2, changes)
