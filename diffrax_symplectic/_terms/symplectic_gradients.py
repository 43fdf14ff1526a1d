"""Vector fields from Hamiltonians, by `jax.grad`: of a drift, of its slow potential, of the
noise. And what terms tell of the Hamiltonians that they come from."""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, Literal, TYPE_CHECKING

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Shaped

from .._arguments import check_pair, shapes, whole_number
from .._brownian import increment_struct
from .._compat import wrapped_like, ω
from .._custom_types import Args, BM, IntScalarLike, RealScalarLike, Terms
from .callers import AbstractCaller
from .dependence import Dependence
from .drift_and_noise import field_of
from .evaluation import call_user_function, check_real_energies, checked_energy


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# Momenta or positions, which have the same structure and shapes.
Momenta = PyTree[Shaped[Array, "?*p"], "P"]
_State = tuple[Momenta, Momenta]
Hamiltonian = Callable[[RealScalarLike, Momenta, Momenta, Args], PyTree[Array]]
AssertedStructure = Literal["separable", "additive"]


class IndexedNoise(AbstractCaller):
    r"""Noise Hamiltonians that can be evaluated one at a time, for
    [`diffrax_symplectic.hamiltonian_terms`][].

    $H_1, \ldots, H_m$ are given as one function of the index, so that
    [`diffrax_symplectic.NinomiyaVictoir`][], which follows the flow of one noise after
    another, evaluates only one of them at a time. Other solvers call `noise(t, p, q,
    args)`, which returns all of them, by `jax.vmap` over the index.
    """

    H: Callable[[IntScalarLike, RealScalarLike, PyTree, PyTree, Args], Array]
    m: int = eqx.field(static=True, converter=ft.partial(whole_number, "m"))

    def __check_init__(self):
        if not callable(self.H):
            raise ValueError(
                f"`H` must be a function `H(k, t, p, q, args)`; got {self.H!r}."
            )

    def called_with(self, t, y, args):
        return {"H": (jax.ShapeDtypeStruct((), jnp.int32), t, *y, args)}

    def one(
        self, k: IntScalarLike, t: RealScalarLike, p: PyTree, q: PyTree, args: Args
    ) -> Array:
        """`H_k`, for `k` from 0 to `m - 1`. Raises a `ValueError` if it is not a scalar."""
        value = call_user_function("H", self.H, k, t, p, q, args=args)
        return checked_energy(value, name="H")

    def __call__(self, t: RealScalarLike, p: PyTree, q: PyTree, args: Args) -> Array:
        indices = jnp.arange(self.m)
        return jax.vmap(lambda k: self.one(k, t, p, q, args))(indices)


IndexedNoise.__init__.__doc__ = """**Arguments:**

- `H`: `H(k, t, p, q, args)`, the Hamiltonian of noise `k`, a scalar. A function, or a
    Module with parameters. `k` is a traced integer from `0` to `m - 1`.
- `m`: the number of noises.

**Raises:** a `ValueError` if `H` is not callable or `m` is not a positive integer; and,
while the solve is traced, if `H` does not return a scalar.
"""


class OneNoise(eqx.Module):
    """A control with a single nonzero noise.

    - `index`: that of the noise in the flattened path.
    - `increment`: its value.
    """

    index: IntScalarLike
    increment: RealScalarLike


class Drift(AbstractCaller):
    """The vector field `(-dH0/dq, dH0/dp)`, where `slow` is a part of `H0`."""

    H0: Hamiltonian
    structure: AssertedStructure | None = eqx.field(static=True, default=None)
    # The user's function call that took `structure`, for messages.
    made_by: str = eqx.field(static=True, default="hamiltonian_terms")
    slow: Callable | None = None

    def called_with(self, t, y, args):
        p, q = y
        return {"H0": (t, p, q, args), "slow": (t, q, args)}

    def __call__(self, t: RealScalarLike, y: _State, args: Args) -> _State:
        check_pair(y)

        def total_energy(p: Momenta, q: Momenta) -> Array:
            value = call_user_function("H0", self.H0, t, p, q, args=args)
            energy = checked_energy(value)
            if self.slow is None:
                return energy
            return energy + _slow_energy(self.slow, t, q, args)

        return symplectic_gradient(total_energy, y)


class SlowForce(eqx.Module):
    """The vector field `(-dU/dq, 0)` of a potential `slow(t, q, args)`."""

    slow: Callable

    def __call__(self, t: RealScalarLike, y: _State, args: Args) -> _State:
        check_pair(y)
        p, q = y

        def energy(q: Momenta) -> Array:
            return _slow_energy(self.slow, t, q, args)

        return (-(jax.grad(energy)(q) ** ω)).ω, jtu.tree_map(jnp.zeros_like, p)


def _slow_energy(slow: Callable, t: RealScalarLike, q: Momenta, args: Args) -> Array:
    """The value of the potential `slow`. Raises a `ValueError` if it is not a scalar."""
    value = call_user_function("slow", slow, t, q, args=args)
    return checked_energy(value, name="slow")


def slow_apart(drift: Terms) -> tuple[Terms, Terms]:
    """The terms of the drift without their slow potentials, and terms of these alone."""
    rest = []
    slow = []
    for term in drift:
        field = field_of(term)
        if isinstance(field, Drift) and field.slow is not None:
            fast = dataclasses.replace(field, slow=None)
            # This keeps the direction of time, which Diffrax wraps around each term.
            rest.append(wrapped_like(term, diffrax.ODETerm(fast)))
            slow.append(wrapped_like(term, diffrax.ODETerm(SlowForce(field.slow))))
        else:
            rest.append(term)
    return tuple(rest), tuple(slow)


class AbstractNoise(diffrax.AbstractTerm, AbstractCaller):
    """Noise with a Brownian path. Subclasses define `vf`, for each array of the state with
    a trailing axis of noises, and `vf_prod`, which costs less."""

    path: AbstractVar[diffrax.AbstractBrownianPath]

    def contr(self, t0: RealScalarLike, t1: RealScalarLike, **kwargs) -> BM:
        return self.path.evaluate(t0, t1, **kwargs)

    def prod(self, vf: PyTree[Array], control: BM) -> PyTree[Array]:
        flat, _ = jfu.ravel_pytree(control)
        return jtu.tree_map(lambda v: jnp.tensordot(v, flat.astype(v.dtype), 1), vf)


class HamiltonianNoise(AbstractNoise):
    """The noise of Hamiltonians. Its product with the control `I` is the symplectic
    gradient of `I . H`."""

    noise: Hamiltonian
    path: diffrax.AbstractBrownianPath
    structure: AssertedStructure | None = eqx.field(static=True, default=None)

    def called_with(self, t, y, args):
        # An `IndexedNoise` is not the user's function, but calls one.
        if isinstance(self.noise, IndexedNoise):
            return {}
        return {"noise": (t, *y, args)}

    def vf(self, t: RealScalarLike, y: _State, args: Args) -> PyTree[Array]:
        # Diffrax's own solvers ask for this if they take several stages with one field.
        hamiltonians = self._hamiltonians_at(t, y, args)

        def flat_hamiltonians(y: _State) -> Array:
            flat, _ = jfu.ravel_pytree(hamiltonians(y))
            return flat

        def noises_last(x: Array) -> Array:
            return jnp.moveaxis(x, 0, -1)

        # For each array of the state: (noises, *shape) to (*shape, noises).
        by_p, by_q = jtu.tree_map(noises_last, jax.jacrev(flat_hamiltonians)(y))
        return (-(by_q**ω)).ω, by_p

    def vf_prod(
        self, t: RealScalarLike, y: _State, args: Args, control: BM | OneNoise
    ) -> _State:
        # The noise of a step is the gradient of one scalar, for any number of noises.
        hamiltonians = self._hamiltonians_at(t, y, args)

        def energy_of_one(p: Momenta, q: Momenta, one: OneNoise) -> Array:
            if isinstance(self.noise, IndexedNoise):
                H = self.noise.one(one.index, t, p, q, args)
            else:
                flat, _ = jfu.ravel_pytree(hamiltonians((p, q)))
                H = flat[one.index]
            return H * jnp.asarray(one.increment, H.dtype)

        def dot(H: Array, increment: Array) -> Array:
            return jnp.sum(H * increment.astype(H.dtype))

        def energy(p: Momenta, q: Momenta) -> Any:
            if isinstance(control, OneNoise):
                return energy_of_one(p, q, control)
            dots = jtu.tree_map(dot, hamiltonians((p, q)), control)
            return sum(jtu.tree_leaves(dots))

        return symplectic_gradient(energy, y)

    def is_vf_expensive(self, t0, t1, y, args) -> bool:
        # `vf` takes one reverse pass per noise, `vf_prod` a single one.
        struct = increment_struct(self.path)
        return sum(leaf.size for leaf in jtu.tree_leaves(struct)) > 2

    def _hamiltonians_at(
        self, t: RealScalarLike, y: _State, args: Args
    ) -> Callable[[_State], PyTree[Array]]:
        """The noise Hamiltonians at time `t`, as a function of the state. Raises a
        `ValueError` if they do not depend on it. This traces them once more in every call,
        but at run time costs nothing."""
        check_pair(y)
        struct = increment_struct(self.path)

        def hamiltonians(state: _State) -> PyTree[Array]:
            p, q = state
            return self._evaluated_hamiltonians(t, p, q, args, struct)

        # The gradient of such Hamiltonians is zero, so noise would be missing without an
        # error.
        if Dependence(hamiltonians, y).independent(of=lambda state: state):
            raise ValueError(
                "`noise` does not depend on the state, so there is no noise. Return "
                "Hamiltonians, not amplitudes: for kicks of constant strength to each "
                "momentum, dp_k = sigma_k dw_k, pass `noise = lambda t, p, q, args: -sigma "
                "* q`. Without noise, solve the drift alone, `terms.terms[0]`."
            )
        return hamiltonians

    def _evaluated_hamiltonians(
        self,
        t: RealScalarLike,
        p: Momenta,
        q: Momenta,
        args: Args,
        struct: PyTree[jax.ShapeDtypeStruct],
    ) -> PyTree[Array]:
        """The noise Hamiltonians, in the structure and shapes of the path."""
        if isinstance(self.noise, IndexedNoise):
            # An `IndexedNoise` gives advice on the errors of its function by itself.
            H = self.noise(t, p, q, args)
        else:
            H = call_user_function("noise", self.noise, t, p, q, args=args)
        if not _has_one_for_each_noise(H, struct):
            raise ValueError(
                "`noise` must return one Hamiltonian for each noise of the path, which has "
                f"shape {shapes(struct)}; got shape {shapes(H)}. Return an array of shape "
                "`(m,)` and construct the path with `shape=(m,)`."
            )
        check_real_energies("noise", H)
        return jtu.tree_map(lambda leaf, s: jnp.reshape(leaf, s.shape), H, struct)


def _has_one_for_each_noise(
    H: PyTree[Array], struct: PyTree[jax.ShapeDtypeStruct]
) -> bool:
    """Whether these are the noise Hamiltonians of a path with increments like `struct`."""
    if jtu.tree_structure(H) != jtu.tree_structure(struct):
        return False
    for leaf, leaf_struct in zip(jtu.tree_leaves(H), jtu.tree_leaves(struct)):
        # The shapes of a single noise may differ: its Hamiltonian may be a scalar and its
        # increment an array of one number, or the other way round.
        is_single = jnp.size(leaf) == leaf_struct.size == 1
        if jnp.shape(leaf) != leaf_struct.shape and not is_single:
            return False
    return True


def symplectic_gradient(energy: Callable, y: _State) -> _State:
    """`(-dH/dq, dH/dp)` for `H = energy(p, q)`."""
    p, q = y
    by_p, by_q = jax.grad(energy, argnums=(0, 1))(p, q)
    return (-(by_q**ω)).ω, by_p


def is_hamiltonian(term: diffrax.AbstractTerm) -> bool:
    """Whether a term comes from Hamiltonians."""
    return len(_hamiltonian_parts(term)) > 0


def drift_hamiltonians(terms: PyTree[diffrax.AbstractTerm]) -> list[Hamiltonian]:
    """The Hamiltonians of all drifts."""
    return [part.H0 for part in _hamiltonian_parts(terms) if isinstance(part, Drift)]


def asserted_structure(term: diffrax.AbstractTerm) -> str | None:
    """The `structure` that the user asserted for a term, and for all parts of it."""
    asserted = {part.structure for part in _hamiltonian_parts(term)}
    return asserted.pop() if len(asserted) == 1 else None


def name_of_maker(term: diffrax.AbstractTerm) -> str | None:
    """The name of the function of this package that made a term from Hamiltonians and takes
    their `structure`, such as `"langevin_terms"`; `None` for other terms."""
    drifts = [part for part in _hamiltonian_parts(term) if isinstance(part, Drift)]
    if len(drifts) > 0:
        return drifts[0].made_by
    return "hamiltonian_terms" if is_hamiltonian(term) else None


def _hamiltonian_parts(
    term: PyTree[diffrax.AbstractTerm],
) -> list[Drift | HamiltonianNoise]:
    """The vector fields and noises in a term that come from Hamiltonians. The term may be
    wrapped or have friction."""
    return [
        x
        for x in jtu.tree_leaves(term, is_leaf=_is_hamiltonian_part)
        if _is_hamiltonian_part(x)
    ]


def _is_hamiltonian_part(x: Any) -> bool:
    return isinstance(x, Drift | HamiltonianNoise)
