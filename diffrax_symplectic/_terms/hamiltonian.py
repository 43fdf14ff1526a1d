"""The terms of a Hamiltonian system: vector fields from its Hamiltonians, by `jax.grad`."""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import Any, cast, get_args, Literal, TYPE_CHECKING

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree, Shaped

from .._arguments import check_pair, check_takes, shapes, whole_number
from .._brownian import increment_struct
from .._compat import replaced, unwrapped, ω
from .._custom_types import Args, BM, IntScalarLike, RealScalarLike
from .constrained_drift import constrained, Constraint
from .dependence import Dependence
from .evaluation import check_real, evaluated, scalar_energy
from .paths import as_path


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# Momenta or positions: of one structure and one shape each, which are those of the other.
_P = PyTree[Shaped[Array, "?*p"], "P"]
_State = tuple[_P, _P]
_Hamiltonian = Callable[[RealScalarLike, _P, _P, Args], PyTree[Array]]
_Structure = Literal["separable", "additive"]


def hamiltonian_terms(
    H0: _Hamiltonian,
    noise: _Hamiltonian | None = None,
    path: diffrax.AbstractBrownianPath | PyTree | None = None,
    *,
    structure: _Structure | None = None,
    constraint: Constraint | None = None,
    slow: Callable[[RealScalarLike, _P, Args], Array] | None = None,
) -> diffrax.MultiTerm:
    r"""The terms of a stochastic Hamiltonian system, from its Hamiltonians.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp

        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.2 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ())  # the shape of one noise
        ```

    For the state $y = (p, q)$, in the sense of Stratonovich,

    $$\mathrm{d}p = -\frac{\partial H_0}{\partial q}\,\mathrm{d}t
        - \sum_{k=1}^m \frac{\partial H_k}{\partial q} \circ \mathrm{d}w_k, \qquad
      \mathrm{d}q = \frac{\partial H_0}{\partial p}\,\mathrm{d}t
        + \sum_{k=1}^m \frac{\partial H_k}{\partial p} \circ \mathrm{d}w_k.$$

    Any Stratonovich solver accepts them, also Diffrax's. One reverse pass gives the noise
    of a step, for any number of noises.

    **Arguments:**

    - `H0`: `H0(t, p, q, args)`, a scalar. A function, or a Module with parameters;
        differentiable with respect to these and to `args`.
    - `noise`: `noise(t, p, q, args)`, the noise Hamiltonians $H_1, \ldots, H_m$ as an
        array of shape `(m,)`, or in the structure and shapes of `path`; a scalar if `m =
        1`. Or an [`diffrax_symplectic.IndexedNoise`][]. For a system without noise omit
        `noise` and `path`.
    - `path`: a Brownian path of shape `(m,)`. If the solver is not known yet, pass its
        shape, `(m,)` or a PyTree of `jax.ShapeDtypeStruct`s:
        [`diffrax_symplectic.suggest_solver`][], [`diffrax_symplectic.compare_solvers`][]
        and [`diffrax_symplectic.expectation`][] then make the path that the solver needs.
    - `structure`: `"separable"` ($H_0 = V(p) + U(t, q)$, $H_k = U_k(t, q)$) or `"additive"`
        (the gradients of the $H_k$ do not depend on the state), asserted instead of
        detected; see [FAQ](faq.md). It is relied on.
    - `constraint`: `constraint(q, args)`, an array of shape `(c,)` that is zero on the
        positions that the system can take, such as `jnp.stack([jnp.sum(q**2) - 1])` for a
        rod. Its gradients must be linearly independent there. For
        [`diffrax_symplectic.StormerVerlet`][] and [`diffrax_symplectic.BAOAB`][], with
        $H_0 = p \cdot M^{-1} p / 2 + U(t, q)$ and $H_k = U_k(t, q)$; all other solvers
        raise an error. Start from [`diffrax_symplectic.constrained_state`][].
    - `slow`: `slow(t, q, args)`, a potential that is added to `H0`, and whose force is soft
        or expensive. [`diffrax_symplectic.BAOAB`][] with a `flow` evaluates it once in a
        step, and leaves `H0` to the flow. For all other solvers it is a part of the drift.

    `p` and `q` are PyTrees of arrays of the same structure and shapes.

    **Returns:** `MultiTerm(drift, diffusion)`, or without noise `MultiTerm(drift)`.

    **Raises:** a `ValueError` if `path` is neither a Brownian path nor a shape, or if
    `structure` is unknown; and, while the solve is traced, if the state is not a pair
    `(p, q)` of the same structure and shapes, if `H0` does not return a scalar, if `noise`
    does not match the path or does not depend on the state, or if either needs concrete
    values or does not return real numbers.
    """
    check_takes("H0", H0, "t", "p", "q", "args")
    _check_structure_name(structure)
    if slow is not None:
        check_takes("slow", slow, "t", "q", "args")
    drift = diffrax.ODETerm(Drift(H0, structure, slow=slow))
    drift = constrained(drift, constraint)
    if noise is None and path is None:
        return diffrax.MultiTerm(drift)
    # If only one of the two was left out, its own check says so.
    noise = cast(_Hamiltonian, noise)
    return diffrax.MultiTerm(
        drift, *noise_terms(noise, path, structure=structure).terms
    )


def noise_terms(
    noise: _Hamiltonian,
    path: diffrax.AbstractBrownianPath | PyTree,
    *,
    structure: _Structure | None = None,
) -> diffrax.MultiTerm:
    r"""The noise of [`diffrax_symplectic.hamiltonian_terms`][] alone, without a drift:

    $$\mathrm{d}p = -\sum_{k=1}^m \frac{\partial H_k}{\partial q} \circ \mathrm{d}w_k,
      \qquad
      \mathrm{d}q = \sum_{k=1}^m \frac{\partial H_k}{\partial p} \circ \mathrm{d}w_k.$$

    Add it to other terms, `diffrax.MultiTerm(*terms.terms, *noise_terms(noise,
    path).terms)`: noisy forces beside a bath of [`diffrax_symplectic.langevin_terms`][], or
    a second noise with a path of its own.

    **Arguments:** `noise`, `path` and `structure` are those of
    [`diffrax_symplectic.hamiltonian_terms`][].

    **Returns:** `MultiTerm(diffusion)`.

    **Raises:** what [`diffrax_symplectic.hamiltonian_terms`][] raises for these arguments.
    """
    check_takes("noise", noise, "t", "p", "q", "args")
    _check_structure_name(structure)
    return diffrax.MultiTerm(HamiltonianNoise(noise, as_path(path), structure))


def _check_structure_name(structure: Any) -> None:
    if structure not in (None, *get_args(_Structure)):
        raise ValueError(
            f"`structure` must be one of {get_args(_Structure)}, or `None` to detect it; "
            f"got {structure!r}."
        )


class IndexedNoise(eqx.Module):
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

    def one(
        self, k: IntScalarLike, t: RealScalarLike, p: PyTree, q: PyTree, args: Args
    ) -> Array:
        """`H_k`, for `k` from 0 to `m - 1`. Raises a `ValueError` if it is not a scalar."""
        return scalar_energy(evaluated("H", self.H, k, t, p, q, args=args), "H")

    def __call__(self, t: RealScalarLike, p: PyTree, q: PyTree, args: Args) -> Array:
        numbers = jnp.arange(self.m)
        return jax.vmap(lambda k: self.one(k, t, p, q, args))(numbers)


IndexedNoise.__init__.__doc__ = """**Arguments:**

- `H`: `H(k, t, p, q, args)`, the Hamiltonian of noise `k`, a scalar. A function, or a
    Module with parameters. `k` is a traced integer from `0` to `m - 1`.
- `m`: the number of noises.

**Raises:** a `ValueError` if `H` is not callable or `m` is not a positive integer; and,
while the solve is traced, if `H` does not return a scalar.
"""


class OneNoise(eqx.Module):
    """A control with a single nonzero noise.

    - `number`: its index in the flattened path.
    - `increment`: its value.
    """

    number: IntScalarLike
    increment: RealScalarLike


class Drift(eqx.Module):
    """The vector field `(-dH0/dq, dH0/dp)`, where `slow` is a part of `H0`."""

    H0: _Hamiltonian
    structure: _Structure | None = eqx.field(static=True, default=None)
    # The user's function call that took `structure`, for messages.
    made_by: str = eqx.field(static=True, default="hamiltonian_terms")
    slow: Callable | None = None

    def __call__(self, t: RealScalarLike, y: _State, args: Args) -> _State:
        check_pair(y)

        def scalar(p: _P, q: _P) -> Array:
            energy = scalar_energy(evaluated("H0", self.H0, t, p, q, args=args))
            if self.slow is None:
                return energy
            return energy + _slow_energy(self.slow, t, q, args)

        return symplectic_gradient(scalar, y)


class SlowForce(eqx.Module):
    """The vector field `(-dU/dq, 0)` of a potential `slow(t, q, args)`."""

    slow: Callable

    def __call__(self, t: RealScalarLike, y: _State, args: Args) -> _State:
        check_pair(y)
        p, q = y

        def energy(q: _P) -> Array:
            return _slow_energy(self.slow, t, q, args)

        return (-(jax.grad(energy)(q) ** ω)).ω, jtu.tree_map(jnp.zeros_like, p)


def _slow_energy(slow: Callable, t: RealScalarLike, q: _P, args: Args) -> Array:
    return scalar_energy(evaluated("slow", slow, t, q, args=args), "slow")


def slow_apart(drift: tuple) -> tuple[tuple, tuple]:
    """The terms of the drift without their slow potentials, and terms of these alone."""
    rest = []
    slow = []
    for term in drift:
        own = unwrapped(term)
        field = own.vector_field if isinstance(own, diffrax.ODETerm) else None
        if isinstance(field, Drift) and field.slow is not None:
            alone = dataclasses.replace(field, slow=None)
            # `replaced` keeps the direction of time, which Diffrax wraps around each term.
            rest.append(replaced(term, diffrax.ODETerm(alone)))
            slow.append(replaced(term, diffrax.ODETerm(SlowForce(field.slow))))
        else:
            rest.append(term)
    return tuple(rest), tuple(slow)


class AbstractNoise(diffrax.AbstractTerm):
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

    noise: _Hamiltonian
    path: diffrax.AbstractBrownianPath
    structure: _Structure | None = eqx.field(static=True, default=None)

    def vf(self, t: RealScalarLike, y: _State, args: Args) -> PyTree[Array]:
        # For each array of the state, with a trailing axis of noises: what Diffrax's own
        # solvers ask for, if they take several stages with one field.
        hamiltonians = self._checked(t, y, args)

        def flat(y: _State) -> Array:
            return jfu.ravel_pytree(hamiltonians(y))[0]

        def noises_last(x: Array) -> Array:
            return jnp.moveaxis(x, 0, -1)

        dp, dq = jtu.tree_map(noises_last, jax.jacrev(flat)(y))
        return (-(dq**ω)).ω, dp

    def vf_prod(
        self, t: RealScalarLike, y: _State, args: Args, control: BM | OneNoise
    ) -> _State:
        # The noise of a step is the gradient of one scalar, for any number of noises.
        hamiltonians = self._checked(t, y, args)

        def one_of_them(p: _P, q: _P, one: OneNoise) -> Array:
            if isinstance(self.noise, IndexedNoise):
                H = self.noise.one(one.number, t, p, q, args)
            else:
                H = jfu.ravel_pytree(hamiltonians((p, q)))[0][one.number]
            return H * jnp.asarray(one.increment, H.dtype)

        def dot(H: Array, increment: Array) -> Array:
            return jnp.sum(H * increment.astype(H.dtype))

        def scalar(p: _P, q: _P) -> Any:
            if isinstance(control, OneNoise):
                return one_of_them(p, q, control)
            dots = jtu.tree_map(dot, hamiltonians((p, q)), control)
            return sum(jtu.tree_leaves(dots))

        return symplectic_gradient(scalar, y)

    def is_vf_expensive(self, t0, t1, y, args) -> bool:
        # `vf` takes one reverse pass per noise, `vf_prod` a single one.
        struct = increment_struct(self.path)
        return sum(leaf.size for leaf in jtu.tree_leaves(struct)) > 2

    def _checked(self, t: RealScalarLike, y: _State, args: Args) -> Callable:
        """The noise Hamiltonians as a function of the state. Raises a `ValueError` if they
        do not depend on it."""
        check_pair(y)
        struct = increment_struct(self.path)

        def hamiltonians(y: _State) -> PyTree[Array]:
            p, q = y
            return self._hamiltonians(t, p, q, args, struct)

        # Their gradient would be zero, and noise would be missing without an error.
        if Dependence(hamiltonians, y).independent(lambda y: y):
            raise ValueError(
                "`noise` does not depend on the state, so there is no noise. Return "
                "Hamiltonians, not amplitudes: for kicks of constant strength to each "
                "momentum, dp_k = sigma_k dw_k, pass `noise = lambda t, p, q, args: -sigma "
                "* q`. Without noise, solve the drift alone, `terms.terms[0]`."
            )
        return hamiltonians

    def _hamiltonians(
        self,
        t: RealScalarLike,
        p: _P,
        q: _P,
        args: Args,
        struct: PyTree[jax.ShapeDtypeStruct],
    ) -> PyTree[Array]:
        """The noise Hamiltonians, in the structure and shapes of the path."""
        if isinstance(self.noise, IndexedNoise):
            # It gives advice on the errors of its function by itself.
            H = self.noise(t, p, q, args)
        else:
            H = evaluated("noise", self.noise, t, p, q, args=args)
        if not _fit(H, struct):
            raise ValueError(
                "`noise` must return one Hamiltonian for each noise of the path, which has "
                f"shape {shapes(struct)}; got shape {shapes(H)}. Return an array of shape "
                "`(m,)` and construct the path with `shape=(m,)`."
            )
        check_real("noise", H)
        return jtu.tree_map(lambda leaf, s: jnp.reshape(leaf, s.shape), H, struct)


def _fit(H: PyTree[Array], struct: PyTree[jax.ShapeDtypeStruct]) -> bool:
    """Whether there is one Hamiltonian for each noise of a path."""
    if jtu.tree_structure(H) != jtu.tree_structure(struct):
        return False
    pairs = zip(jtu.tree_leaves(H), jtu.tree_leaves(struct))
    # A single noise may be a scalar.
    return all(
        jnp.shape(leaf) == s.shape or jnp.size(leaf) == s.size == 1 for leaf, s in pairs
    )


def symplectic_gradient(scalar: Callable, y: _State) -> _State:
    """`(-dH/dq, dH/dp)` for `H = scalar(p, q)`."""
    p, q = y
    dp, dq = jax.grad(scalar, argnums=(0, 1))(p, q)
    return (-(dq**ω)).ω, dp


def is_hamiltonian(term: diffrax.AbstractTerm) -> bool:
    """Whether a term comes from Hamiltonians."""
    return len(_parts(term)) > 0


def drift_hamiltonians(terms: PyTree[diffrax.AbstractTerm]) -> list[_Hamiltonian]:
    """The Hamiltonians of all drifts."""
    return [part.H0 for part in _parts(terms) if isinstance(part, Drift)]


def asserted_structure(term: diffrax.AbstractTerm) -> str | None:
    """The `structure` that the user asserted for a term, and for all parts of it."""
    asserted = {part.structure for part in _parts(term)}
    return asserted.pop() if len(asserted) == 1 else None


def structure_asserted_in(term: diffrax.AbstractTerm) -> str | None:
    """The function that made a term from Hamiltonians, and that takes the `structure` of
    these; `None` for other terms."""
    drifts = [part for part in _parts(term) if isinstance(part, Drift)]
    if len(drifts) > 0:
        return drifts[0].made_by
    return "hamiltonian_terms" if is_hamiltonian(term) else None


def _parts(term: PyTree[diffrax.AbstractTerm]) -> list[Drift | HamiltonianNoise]:
    """What comes from Hamiltonians in a term, which may be wrapped or have friction."""
    return [x for x in jtu.tree_leaves(term, is_leaf=_is_part) if _is_part(x)]


def _is_part(x: Any) -> bool:
    return isinstance(x, Drift | HamiltonianNoise)
