import functools as ft
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from ._arguments import shapes, whole_number
from ._custom_types import Args, IntScalarLike, RealScalarLike


class IndexedNoise(eqx.Module):
    r"""Noise Hamiltonians that can be evaluated one at a time, for
    [`diffrax_symplectic.hamiltonian_terms`][].

    $H_1, \ldots, H_m$ are given by one function of the index. Called as
    `noise(t, p, q, args)` it returns all of them, by `jax.vmap` over the index, so that
    it can be used in place of a function. [`diffrax_symplectic.NinomiyaVictoir`][] follows
    the flow of one noise after another, and evaluates only the noise of that flow. With a
    function that returns all `m` it has to evaluate all of them for each of the `m` flows.

    !!! example

        ```python
        import diffrax_symplectic as ds


        def H(k, t, p, q, args):  # each site is pushed by a noise of its own
            return -args[k] * q[k]


        noise = ds.IndexedNoise(H, 1000)
        ```
    """

    H: Callable[[IntScalarLike, RealScalarLike, PyTree, PyTree, Args], Array]
    m: int = eqx.field(static=True, converter=ft.partial(whole_number, "m"))

    def __check_init__(self):
        if not callable(self.H):
            raise ValueError(
                f"`H` must be a function `H(k, t, p, q, args)`; got {self.H!r}."
            )

    def one(
        self, k: IntScalarLike, t: RealScalarLike, p: PyTree, q: PyTree, args: Args
    ) -> Array:
        """`H_k`, for `k` from 0 to `m - 1`. Raises a `ValueError` if it is no scalar."""
        out = self.H(k, t, p, q, args)
        if not jtu.all_leaves([out]) or jnp.shape(out) != ():
            raise ValueError(
                "`H(k, t, p, q, args)` of `IndexedNoise` must return a scalar, the "
                f"Hamiltonian of the noise `k`; got shape {shapes(out)}."
            )
        return jnp.asarray(out, jnp.result_type(out, float))

    def __call__(self, t: RealScalarLike, p: PyTree, q: PyTree, args: Args) -> Array:
        return jax.vmap(lambda k: self.one(k, t, p, q, args))(jnp.arange(self.m))


IndexedNoise.__init__.__doc__ = """**Arguments:**

- `H`: `H(k, t, p, q, args)`, the Hamiltonian of the noise `k`, a scalar. A function, or
    a Module with parameters. `k` is a traced integer from `0` to `m - 1`: index arrays
    with it.
- `m`: the number of noises.

**Raises:** a `ValueError` if `H` is not callable or `m` not a positive integer; and, while
the solve is traced, if `H` does not return a scalar.
"""


class OneNoise(eqx.Module):
    """The control of the noise term of `hamiltonian_terms` in which all noises vanish but
    one. `number` counts the noises in the order of the flattened path."""

    number: IntScalarLike
    increment: RealScalarLike
