"""The thermal noise that belongs to a friction."""

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, ArrayLike, PyTree

from .._arguments import real_array
from .._custom_types import Args, RealScalarLike
from ._friction import (
    checked,
    Fault,
    is_square,
    matrix_faults,
    root_of_matrix,
    UNKNOWN,
)


def thermal_noise(
    gamma: PyTree[ArrayLike], mass: PyTree[ArrayLike], T: PyTree[ArrayLike]
) -> "ThermalNoise":
    r"""The noise Hamiltonians that balance friction at temperature $T$:
    $H_k = -\sum_j \sigma_{jk} q_j$ with $\sigma \sigma^\top = 2 \gamma M T$.

    With the friction $-\gamma p$ of [`diffrax_symplectic.BAOAB`][],
    [`diffrax_symplectic.LangevinMiddle`][] or [`diffrax_symplectic.Damped`][] and $V(p) =
    p \cdot M^{-1} p / 2$, the density $e^{-H_0 / T}$ is then stationary. The path must have
    the shape of `q`.

    **Arguments:**

    - `gamma`: the friction rate, as for the solvers, in units of one over time. For a
        friction tensor, $\mathrm{d}p = -\Gamma M^{-1} p\,\mathrm{d}t$, pass
        `Gamma / mass`.
    - `mass`: the masses in $V(p)$: a number, an array with the shape of `q`, or a PyTree of
        these.
    - `T`: the temperature, in units of energy: a number, or, if `gamma` is not a matrix,
        one for each momentum, like `mass`.

    **Returns:** a function `noise(t, p, q, args)` for
    [`diffrax_symplectic.hamiltonian_terms`][].

    **Raises:** a `ValueError` if a mass is not positive, a temperature is negative, or
    either is not finite (as far as they are not traced), if no solver accepts `gamma`, and
    in the solve if one of them does not fit `q`. The solve fails if a matrix `gamma` is
    traced and `gamma * mass` is not symmetric positive semidefinite.
    """
    for name, value in (("mass", mass), ("T", T)):
        for leaf in jtu.tree_leaves(value):
            kind = "a real number, or an array or PyTree of them"
            real_array(name, leaf, positive=name == "mass", kind=kind)
    given = dict(gamma=checked(gamma), mass=mass, T=T)
    is_one = lambda x: jtu.all_leaves([x])
    like = next((x for x in given.values() if not is_one(x)), 0.0)
    for name, x in given.items():
        if not is_one(x) and jtu.tree_structure(x) != jtu.tree_structure(like):
            raise ValueError(
                f"`{name}` must be one number or array, or have the structure of `q`, like "
                f"the other arguments; got {eqx.tree_pformat(given)}."
            )
    each = [jtu.tree_map(lambda _: x, like) if is_one(x) else x for x in given.values()]
    return ThermalNoise(jtu.tree_map(_Amplitudes.of, *each))


class _Amplitudes(eqx.Module):
    r"""$2 \gamma M T$ for the momenta of one array, and its root if it may be a matrix."""

    variance: Array
    root: Array | None
    fault: Fault | None = eqx.field(static=True)

    @staticmethod
    def of(gamma: ArrayLike, mass: ArrayLike, T: ArrayLike) -> "_Amplitudes":
        try:
            variance = 2 * jnp.asarray(gamma) * jnp.asarray(mass) * jnp.asarray(T)
        except (TypeError, ValueError):
            raise ValueError(
                "`gamma`, `mass` and `T` must have shapes that broadcast; got "
                f"{jnp.shape(gamma)}, {jnp.shape(mass)} and {jnp.shape(T)}. A matrix "
                "`gamma` has the shape of `q` twice: (n, d, n, d) for `q` of shape (n, d)."
            ) from None
        variance = jnp.asarray(variance, jnp.result_type(variance, float))
        (fault,) = matrix_faults(variance)
        if not is_square(variance.shape) or fault not in (None, UNKNOWN):
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
                f"shape of `q`, {q.shape}, or `gamma` be a matrix of shape {q.shape * 2}; "
                f"`2 * gamma * mass * T` has shape {shape}."
            )
        if self.root is None:
            reason = getattr(self.fault, "reason", "")
            raise ValueError(
                "`gamma * mass` of `thermal_noise` must be a symmetric positive "
                f"semidefinite matrix, but {reason}. For a tensor with dp = -Gamma v dt "
                "pass `gamma=Gamma / mass`."
            )
        return -jnp.tensordot(self.root.astype(q.dtype), q, q.ndim)


class ThermalNoise(eqx.Module):
    """The result of [`diffrax_symplectic.thermal_noise`][]."""

    amplitudes: PyTree[_Amplitudes]

    def __call__(self, t: RealScalarLike, p: PyTree, q: PyTree, args: Args) -> PyTree:
        del t, p, args
        amplitudes = self.amplitudes
        is_one = lambda x: isinstance(x, _Amplitudes)
        if is_one(amplitudes):
            return jtu.tree_map(amplitudes.hamiltonians, q)
        if jtu.tree_structure(amplitudes, is_leaf=is_one) != jtu.tree_structure(q):
            raise ValueError(
                "`gamma`, `mass` and `T` of `thermal_noise` must be numbers or arrays, or "
                f"have the structure of `q`; got q = {eqx.tree_pformat(q)}."
            )
        of = lambda x, q: x.hamiltonians(q)
        return jtu.tree_map(of, amplitudes, q, is_leaf=is_one)
