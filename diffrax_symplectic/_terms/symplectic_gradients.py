"""Vector fields from Hamiltonians, by `jax.grad`.

- `Drift`: the vector field of the energy, also with friction.
- `HamiltonianNoise`: the noise.
- `hamiltonian_parts` and what follows it: the Hamiltonians within given terms.
"""

import abc
import functools as ft
import operator
from collections.abc import Callable
from typing import Any, ClassVar, Literal, TYPE_CHECKING

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Shaped

from .._arguments import check_pair, shapes, whole_number
from .._brownian import increment_struct, num_noises, zeros_and_unravel
from .._compat import ω
from .._custom_types import Args, BM, IntScalarLike, RealScalarLike
from .._parts import parts_of
from .callers import AbstractCaller
from .dependence import Dependence
from .evaluation import call_user_function, check_real_energies, checked_energy


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# Momenta or positions, which have the same structure and shapes.
HalfState = PyTree[Shaped[Array, "?*p"], "P"]
_State = tuple[HalfState, HalfState]
Hamiltonian = Callable[[RealScalarLike, HalfState, HalfState, Args], PyTree[Array]]
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
    m: int = eqx.field(static=True)

    def __init__(
        self,
        H: Callable[[IntScalarLike, RealScalarLike, PyTree, PyTree, Args], Array],
        m: int,
    ):
        """**Arguments:**

        - `H`: `H(k, t, p, q, args)`, the Hamiltonian of noise `k`, a scalar. A function, or
            a Module with parameters. `k` is a traced integer from `0` to `m - 1`.
        - `m`: the number of noises.

        **Raises:** a `ValueError` if `H` is not callable or `m` is not a positive integer;
        and, while the solve is traced, if `H` does not return a scalar.
        """
        if not callable(H):
            raise ValueError(
                f"`H` must be a function `H(k, t, p, q, args)`; got {H!r}."
            )
        self.H = H
        self.m = whole_number("m", m)

    def called_with(self, t, y, args):
        return {"H": (jax.ShapeDtypeStruct((), jnp.int32), t, *y, args)}

    def one(
        self, k: IntScalarLike, t: RealScalarLike, p: PyTree, q: PyTree, args: Args
    ) -> Array:
        """`H_k`, for `k` from 0 to `m - 1`. Raises a `ValueError` if it is not a scalar."""
        return checked_energy("H", self.H, k, t, p, q, args=args)

    def __call__(self, t: RealScalarLike, p: PyTree, q: PyTree, args: Args) -> Array:
        indices = jnp.arange(self.m)
        return jax.vmap(lambda k: self.one(k, t, p, q, args))(indices)


class OneNoise(eqx.Module):
    """A control for `HamiltonianNoise.vf_prod` that is zero for all noises but one.

    - `index`: the index of this noise in the flattened control. It may be traced.
    - `increment`: the increment of this noise.
    """

    index: IntScalarLike
    increment: RealScalarLike


class AbstractFriction(AbstractCaller):
    """The vector field `(-G v, 0)` of a friction `G`, with the velocities `v`."""

    @abc.abstractmethod
    def velocity(self, t: RealScalarLike, y: _State, args: Args) -> HalfState:
        """The velocities `v` of the state `y = (p, q)`."""

    @abc.abstractmethod
    def force(
        self, t: RealScalarLike, q: HalfState, args: Args, velocity: HalfState
    ) -> HalfState:
        """`-G v` at the positions `q`, for `v = velocity`."""

    def __call__(self, t: RealScalarLike, y: _State, args: Args) -> _State:
        """`(-G v, 0)`."""
        check_pair(y)
        _, q = y
        force = self.force(t, q, args, self.velocity(t, y, args))
        return force, jtu.tree_map(jnp.zeros_like, q)


class Drift(AbstractCaller):
    """The vector field `(-dH/dq, dH/dp)` of an energy `H`, with friction on the velocities
    `dH/dp` if there is any.

    The energy is `H0`, the potential `slow`, or the sum of both. Friction is in the same
    term, since the solvers of Diffrax for stochastic equations take one drift and one
    noise."""

    H0: Hamiltonian | None
    structure: AssertedStructure | None = eqx.field(static=True, default=None)
    # The name of the function that the user passed `structure` to, for messages.
    made_by: str = eqx.field(static=True, default="hamiltonian_terms")
    slow: Callable | None = None
    friction: AbstractFriction | None = None

    def called_with(self, t, y, args):
        p, q = y
        return {"H0": (t, p, q, args), "slow": (t, q, args)}

    def __call__(self, t: RealScalarLike, y: _State, args: Args) -> _State:
        check_pair(y)

        def energy(p: HalfState, q: HalfState) -> Array:
            # At least one of the two is there.
            energies = []
            if self.H0 is not None:
                energies.append(checked_energy("H0", self.H0, t, p, q, args=args))
            if self.slow is not None:
                energies.append(checked_energy("slow", self.slow, t, q, args=args))
            return ft.reduce(operator.add, energies)

        dp, dq = symplectic_gradient(energy, y)
        if self.friction is None:
            return dp, dq
        _, q = y
        return (dp**ω + self.friction.force(t, q, args, dq) ** ω).ω, dq


class AbstractNoise(diffrax.AbstractTerm, AbstractCaller):
    """Noise with a Brownian path.

    Subclasses define `vf_prod`. Solvers that call `vf` and `prod` instead pay for the
    vector fields of all noises, which have a trailing axis of noises for each array of the
    state."""

    path: AbstractVar[diffrax.AbstractBrownianPath]

    def contr(self, t0: RealScalarLike, t1: RealScalarLike, **kwargs) -> BM:
        return self.path.evaluate(t0, t1, **kwargs)

    def vf(self, t: RealScalarLike, y: _State, args: Args) -> PyTree[Array]:
        # Column `k` is the vector field of noise `k`: the product with a control that is 1
        # for this noise and 0 for all others. Diffrax's own solvers call this if they use
        # one vector field for several controls.
        zeros, unravel = zeros_and_unravel(increment_struct(self.path))

        def product(unit: Array) -> _State:
            return self.vf_prod(t, y, args, unravel(unit))

        # (noises, noises) to (*shape, noises) for each array of the state.
        units = jnp.eye(zeros.size, dtype=zeros.dtype)
        return jax.vmap(product, out_axes=-1)(units)

    def prod(self, vf: PyTree[Array], control: BM) -> PyTree[Array]:
        flat, _ = jfu.ravel_pytree(control)
        return jtu.tree_map(lambda v: jnp.tensordot(v, flat.astype(v.dtype), 1), vf)


class HamiltonianNoise(AbstractNoise):
    """The noise of Hamiltonians `H`, an array or a PyTree. The vector field times the
    control `I`, the increments of the path, is the symplectic gradient of `I . H`."""

    noise: Hamiltonian
    path: diffrax.AbstractBrownianPath
    structure: AssertedStructure | None = eqx.field(static=True, default=None)
    made_by: ClassVar[str] = "hamiltonian_terms"

    def called_with(self, t, y, args):
        return {"noise": (t, *y, args)}

    def vf_prod(
        self, t: RealScalarLike, y: _State, args: Args, control: BM | OneNoise
    ) -> _State:
        check_pair(y)

        def hamiltonians(p: HalfState, q: HalfState) -> PyTree[Array]:
            return self._hamiltonians(t, p, q, args)

        # The gradient would be zero, so the noise would be missing without an error. This
        # check traces the Hamiltonians once more, and costs nothing at run time.
        if Dependence(hamiltonians, *y).independent(of=lambda p, q: (p, q)):
            raise ValueError(
                "`noise` does not depend on the state, so there is no noise. Return "
                "Hamiltonians, not amplitudes: for kicks of constant strength to each "
                "momentum, dp_k = sigma_k dw_k, pass `noise = lambda t, p, q, args: -sigma "
                "* q`. Without noise, solve the drift alone, `terms.terms[0]`."
            )

        def dot(H: Array, increment: Array) -> Array:
            return jnp.sum(H * increment.astype(H.dtype))

        # `I . H`, a single scalar. The noise of a step is its symplectic gradient, which
        # takes one reverse pass for any number of noises.
        def control_dot_hamiltonians(p: HalfState, q: HalfState) -> Any:
            if not isinstance(control, OneNoise):
                dots = jtu.tree_map(dot, hamiltonians(p, q), control)
                return sum(jtu.tree_leaves(dots))
            # All increments are zero but one, so `I . H` has one summand.
            if isinstance(self.noise, IndexedNoise):
                # Only this Hamiltonian is evaluated.
                H = self.noise.one(control.index, t, p, q, args)
            else:
                # The function gives all Hamiltonians at once, of which one is taken.
                flat, _ = jfu.ravel_pytree(hamiltonians(p, q))
                H = flat[control.index]
            return H * jnp.asarray(control.increment, H.dtype)

        return symplectic_gradient(control_dot_hamiltonians, y)

    def _hamiltonians(self, t, p: HalfState, q: HalfState, args: Args) -> PyTree[Array]:
        """All noise Hamiltonians, in the structure and shapes of the increments of the
        path. Raises a `ValueError` if they do not fit the path, or are not real."""
        if isinstance(self.noise, IndexedNoise):
            # An `IndexedNoise` itself gives advice on the errors of its function.
            H = self.noise(t, p, q, args)
        else:
            H = call_user_function("noise", self.noise, t, p, q, args=args)
        structs = increment_struct(self.path)

        def fits(H: Array, struct: jax.ShapeDtypeStruct) -> bool:
            # The shapes of a single noise may differ: its Hamiltonian may be a scalar and
            # its increment an array of one number, or the other way round.
            return jnp.shape(H) == struct.shape or jnp.size(H) == struct.size == 1

        same_structure = jtu.tree_structure(H) == jtu.tree_structure(structs)
        if not same_structure or not jtu.tree_all(jtu.tree_map(fits, H, structs)):
            raise ValueError(
                "`noise` must return one Hamiltonian for each noise of the path, which "
                f"has shape {shapes(structs)}; got shape {shapes(H)}. Return an "
                "array of the shape of the path, or make a path of the other shape."
            )
        check_real_energies("noise", H)
        return jtu.tree_map(lambda leaf, s: jnp.reshape(leaf, s.shape), H, structs)

    def is_vf_expensive(self, t0, t1, y, args) -> bool:
        # `vf` takes one reverse pass per noise, `vf_prod` a single one.
        return num_noises(increment_struct(self.path)) > 2


def symplectic_gradient(energy: Callable, y: _State) -> _State:
    """`(-dH/dq, dH/dp)` for `H = energy(p, q)`."""
    p, q = y
    by_p, by_q = jax.grad(energy, argnums=(0, 1))(p, q)
    return (-(by_q**ω)).ω, by_p


def hamiltonian_parts(
    terms: PyTree[diffrax.AbstractTerm],
) -> list[Drift | HamiltonianNoise]:
    """The parts of terms that come from Hamiltonians: vector fields of drifts, and noises.
    The terms may be wrapped or have friction."""
    return parts_of((Drift, HamiltonianNoise), terms)


def is_hamiltonian(term: diffrax.AbstractTerm) -> bool:
    """Whether a term comes from Hamiltonians."""
    return len(hamiltonian_parts(term)) > 0


def asserted_structure(term: diffrax.AbstractTerm) -> str | None:
    """The `structure` that the user asserted for a term; `None` unless it is the same for
    all parts of the term that come from Hamiltonians."""
    asserted = {part.structure for part in hamiltonian_parts(term)}
    return asserted.pop() if len(asserted) == 1 else None


def name_of_maker(term: diffrax.AbstractTerm) -> str | None:
    """The name of the function of this package that made a term from Hamiltonians, such as
    `"langevin_terms"`; `None` for other terms. The function takes `structure`."""
    return next((part.made_by for part in hamiltonian_parts(term)), None)
