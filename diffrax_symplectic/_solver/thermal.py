"""The noise that belongs to a friction at a temperature."""

from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, PyTree

from .._custom_types import Args, RealScalarLike
from ._friction import checked, Fault, matrix_faults, root_of_matrix, UNKNOWN


def thermal_noise(
    gamma: PyTree[ArrayLike], mass: PyTree[ArrayLike], T: PyTree[ArrayLike]
) -> "ThermalNoise":
    r"""The noise Hamiltonians that keep a system with friction at a temperature:
    $H_k = -\sum_j \sigma_{jk} q_j$ with $\sigma \sigma^\top = 2 \gamma M T$.

    With the friction $-\gamma p$ of [`diffrax_symplectic.BAOAB`][],
    [`diffrax_symplectic.LangevinMiddle`][] or [`diffrax_symplectic.Damped`][] and $V(p) =
    p \cdot M^{-1} p / 2$ the density $e^{-H_0 / T}$ is then stationary. There is one noise
    for each momentum: the path has the shape of `q`.

    !!! example

        ```python
        import diffrax
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        mass, T = jnp.array([1.0, 4.0]), 0.5
        Gamma = jnp.array([[1.0, 0.3], [0.3, 0.5]])  # dp = -Gamma v dt
        gamma = Gamma / mass  # dp = -gamma p dt
        terms = ds.hamiltonian_terms(
            lambda t, p, q, args: jnp.sum(p**2 / (2 * mass)) + jnp.sum(q**4),
            ds.thermal_noise(gamma, mass, T),
            ds.WeakBrownianPath((2,), jr.key(0)),
        )
        y0 = jnp.zeros(2), jnp.ones(2)
        sol = diffrax.diffeqsolve(terms, ds.LangevinMiddle(gamma), 0, 1, 0.1, y0)
        ```

    **Arguments:**

    - `gamma`: the friction, as the solvers take it, in units of one over time. Of a tensor
        with $\mathrm{d}p = -\Gamma M^{-1} p\,\mathrm{d}t$ it is `Gamma / mass`.
    - `mass`: the masses, as they stand in $V(p)$: a number; or an array of the shape of
        `q`, or a PyTree of such.
    - `T`: the temperature, in units of energy: a number; or one for each momentum, as
        `mass`, where `gamma` is no matrix.

    **Returns:** a function `noise(t, p, q, args)` for
    [`diffrax_symplectic.hamiltonian_terms`][].

    **Raises:** a `ValueError` if a mass is known not to be positive, a temperature to be
    negative, or either not to be finite, for a `gamma` that no solver takes, and in the
    solve if one of them does not fit `q`. If values of a matrix `gamma` are traced, and
    `gamma * mass` is not symmetric positive semidefinite, the noise is NaN, and the solve
    fails.
    """
    for name, value in (("mass", mass), ("T", T)):
        for leaf in jtu.tree_leaves(value):
            _check_number(name, leaf)
    given = dict(gamma=checked(gamma), mass=mass, T=T)
    trees = [x for x in given.values() if not jtu.all_leaves([x])]
    treedef = jtu.tree_structure([*trees, gamma][0])
    for name, x in given.items():
        if not jtu.all_leaves([x]) and jtu.tree_structure(x) != treedef:
            raise ValueError(
                f"`{name}` must be one number or array, or have the structure of `q`, as "
                f"the other arguments have; got {eqx.tree_pformat(given)}."
            )
    leaves = [jtu.tree_leaves(x) for x in given.values()]
    most = max(map(len, leaves))
    each = zip(*(x if len(x) == most else x * most for x in leaves))
    return ThermalNoise(treedef.unflatten([_Amplitudes.of(*x) for x in each]))


class _Amplitudes(eqx.Module):
    r"""For the momenta of one array: $2 \gamma M T$, and if that may be a matrix its root,
    which is computed here and not in each step."""

    variance: Array
    root: Array | None
    fault: Fault | None = eqx.field(static=True)

    @staticmethod
    def of(gamma: ArrayLike, mass: ArrayLike, T: ArrayLike) -> "_Amplitudes":
        try:
            variance = 2 * jnp.asarray(gamma) * jnp.asarray(mass) * jnp.asarray(T)
        except (TypeError, ValueError):
            raise ValueError(
                "`gamma`, `mass` and `T` must have shapes that go together; got "
                f"{jnp.shape(gamma)}, {jnp.shape(mass)} and {jnp.shape(T)}."
            ) from None
        (fault,) = matrix_faults(variance)
        half = variance.shape[: variance.ndim // 2]
        possible = fault is None or fault == UNKNOWN
        if variance.ndim == 0 or variance.shape != half + half or not possible:
            return _Amplitudes(variance, None, fault)
        return _Amplitudes(variance, root_of_matrix(variance), fault)

    def hamiltonians(self, q: Array) -> Array:
        shape, q = self.variance.shape, jnp.asarray(q)
        pairs = zip(shape[::-1], q.shape[::-1])
        if len(shape) <= q.ndim and all(n in (1, most) for n, most in pairs):
            return -jnp.sqrt(self.variance).astype(q.dtype) * q
        if shape != q.shape * 2:
            raise ValueError(
                "`gamma`, `mass` and `T` of `thermal_noise` must be numbers or have the "
                f"shape of `q`, {q.shape}, or `gamma` that of a matrix, {q.shape * 2}; "
                f"`2 * gamma * mass * T` has shape {shape}."
            )
        if self.root is None:
            reason = getattr(self.fault, "reason", "")
            raise ValueError(
                "`gamma * mass` of `thermal_noise` must be a symmetric positive "
                f"semidefinite matrix, but {reason}. Of a tensor with dp = -Gamma v dt "
                "pass `gamma=Gamma / mass`."
            )
        return -jnp.tensordot(self.root.astype(q.dtype), q, q.ndim)


class ThermalNoise(eqx.Module):
    """What [`diffrax_symplectic.thermal_noise`][] returns."""

    amplitudes: PyTree[_Amplitudes]

    def __call__(self, t: RealScalarLike, p: PyTree, q: PyTree, args: Args) -> PyTree:
        del t, p, args
        amplitudes = self.amplitudes
        if isinstance(amplitudes, _Amplitudes):
            return jtu.tree_map(amplitudes.hamiltonians, q)
        is_one = lambda x: isinstance(x, _Amplitudes)
        if jtu.tree_structure(amplitudes, is_leaf=is_one) != jtu.tree_structure(q):
            raise ValueError(
                "`gamma`, `mass` and `T` of `thermal_noise` must be numbers or arrays, or "
                f"have the structure of `q`; got q = {eqx.tree_pformat(q)}."
            )
        along = lambda x, q: x.hamiltonians(q)
        return jtu.tree_map(along, amplitudes, q, is_leaf=is_one)


def _check_number(name: str, value: Any) -> None:
    """Raises a `ValueError` unless this is a positive mass, or a temperature."""
    least = {"mass": "positive", "T": "not negative"}[name]
    is_number = eqx.is_array_like(value) and not isinstance(value, bool)
    if is_number and isinstance(value, jax.core.Tracer):
        return
    if is_number and not np.iscomplexobj(value):
        values = np.asarray(value)
        fits = values > 0 if name == "mass" else values >= 0
        if np.all(fits & np.isfinite(values)):
            return
    raise ValueError(
        f"`{name}` must be a finite real number, {least}, or an array or PyTree of such; "
        f"got {value!r}."
    )
