"""Langevin dynamics: friction on velocities, and the noise of a temperature."""

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from .._arguments import check_pair, check_takes, real_array, shapes
from .._brownian import increment_struct, raveled
from .._compat import replaced, unwrapped, ω
from .._custom_types import Args, BM, RealScalarLike
from ._constraint import Constraint
from ._hamiltonian import as_path, evaluated, hamiltonian_terms, scalar_energy
from ._vector_fields import flattened


_P = PyTree[Array]
_Value = PyTree[ArrayLike] | Callable[[RealScalarLike, _P, Args], PyTree[ArrayLike]]


class FrictionAlong(eqx.Module):
    r"""Friction along given directions, for [`diffrax_symplectic.langevin_terms`][]:
    $G = \sum_k d_k d_k^\top$.

    For friction between pairs of particles, each pair has a direction, which is opposite
    for the two of them. The noise is $\sqrt{2 T} \sum_k d_k\,\mathrm{d}w_k$, so that no
    root of a matrix is taken, and both conserve the total momentum.
    """

    directions: _Value


FrictionAlong.__init__.__doc__ = """**Arguments:**

- `directions`: an array of shape `(*p.shape, m)` for `m` noises, or for momenta in a PyTree
    a PyTree of such arrays; or a function `(t, q, args)` of these. In units of the root of
    a friction, (force / velocity)^(1/2).
"""


def langevin_terms(
    H0: Callable[[RealScalarLike, _P, _P, Args], PyTree[Array]],
    friction: "_Value | FrictionAlong",
    temperature: _Value | None = None,
    path: diffrax.AbstractBrownianPath | PyTree | None = None,
    *,
    structure: Any = None,
    constraint: Constraint | None = None,
) -> diffrax.MultiTerm:
    r"""The terms of Langevin dynamics: a Hamiltonian system with friction, in a heat bath.

    For the state $y = (p, q)$,

    $$\mathrm{d}p = -\frac{\partial H_0}{\partial q}\,\mathrm{d}t
        - G \frac{\partial H_0}{\partial p}\,\mathrm{d}t + B\,\mathrm{d}w, \qquad
      \mathrm{d}q = \frac{\partial H_0}{\partial p}\,\mathrm{d}t, \qquad
      B B^\top = 2 T G.$$

    The friction $G(t, q)$ acts on velocities, so it is symmetric positive semidefinite
    whatever the masses are. (For a rate $\gamma$, $\mathrm{d}p = \ldots - \gamma
    p\,\mathrm{d}t$, pass $G = \gamma m$.) If $H_0$ and $T$ are constant, the density
    $e^{-H_0 / T}$ is stationary. The noise is the same in the sense of Ito and of
    Stratonovich.

    [`diffrax_symplectic.BAOAB`][], [`diffrax_symplectic.LangevinMiddle`][] and
    [`diffrax_symplectic.Damped`][] treat friction by a step of its own. Every other solver,
    from this package or from Diffrax, takes it as a part of the drift. More terms are added
    by `diffrax.MultiTerm(*terms.terms, ...)`: other noise, or a second bath,
    `langevin_terms(H0, friction, temperature, path).terms[1:]`.

    **Arguments:**

    - `H0`: `H0(t, p, q, args)`, as for [`diffrax_symplectic.hamiltonian_terms`][].
    - `friction`: the friction $G$, in units of force over velocity: a number; an array with
        one number for each momentum, of the shape of `p`; or a symmetric positive
        semidefinite matrix, with the shape of `p` twice, `(n, n)` for `n` momenta. For
        momenta in a PyTree a number, or a PyTree of these. Or a function `(t, q, args)`
        that returns one of these. Or a [`diffrax_symplectic.FrictionAlong`][].
    - `temperature`: the temperature $T$, in units of energy: a number; for friction by
        numbers also one for each momentum, as an array or PyTree like `p`; or a function
        `(t, q, args)` of these. `None` for friction without noise.
    - `path`: the Brownian path or its shape, as for
        [`diffrax_symplectic.hamiltonian_terms`][]: the shape of `q`, or `(m,)` for the `m`
        directions of a `FrictionAlong`.
    - `structure`: as for [`diffrax_symplectic.hamiltonian_terms`][].
    - `constraint`: as for [`diffrax_symplectic.hamiltonian_terms`][]. Then
        [`diffrax_symplectic.BAOAB`][] is the solver. Friction and noise act within the
        allowed momenta; the density is $e^{-H_0 / T}$ on the allowed states.

    **Returns:** `MultiTerm(drift, friction, noise)`, or without `temperature`
    `MultiTerm(drift, friction)`.

    **Raises:** as [`diffrax_symplectic.hamiltonian_terms`][]; a `ValueError` if numbers are
    known to be negative or not finite, or a matrix not to be symmetric positive
    semidefinite; and, while the solve is traced, if their shapes do not fit. Paths fail
    where this is not known before.
    """
    alone = hamiltonian_terms(H0, structure=structure, constraint=constraint)
    (drift,) = alone.terms
    if (temperature is None) != (path is None):
        raise ValueError(
            "`langevin_terms` needs both a `temperature` and a `path` with the shape of "
            "`q`, or for friction without noise neither of them."
        )
    driven = None if path is None else as_path(path)
    struct = None if driven is None else increment_struct(driven)
    friction = _checked_friction(friction, struct)
    term = diffrax.ODETerm(Friction(H0, friction))
    if driven is None:
        return diffrax.MultiTerm(drift, term)
    noise = BathNoise(friction, _checked_temperature(temperature), driven)
    return diffrax.MultiTerm(drift, term, noise)


def is_friction(term: diffrax.AbstractTerm) -> bool:
    """Whether a term is the friction of `langevin_terms`."""
    term = unwrapped(term)
    return isinstance(term, diffrax.ODETerm) and isinstance(
        term.vector_field, Friction | _DiffraxFriction
    )


class Friction(eqx.Module):
    """The vector field `(-G dH0/dp, 0)`."""

    H0: Callable
    friction: Any

    def __call__(self, t: RealScalarLike, y: tuple[_P, _P], args: Args):
        check_pair(y)
        p, q = y

        def scalar(p):
            return scalar_energy(evaluated("H0", self.H0, t, p, q, args=args))

        velocity = jax.grad(scalar)(p)
        force = _product(self.friction, t, q, args, velocity)
        return (-(force**ω)).ω, jtu.tree_map(jnp.zeros_like, q)


class BathNoise(diffrax.AbstractTerm):
    """The noise `(B dw, 0)` with `B B^T = 2 T G`."""

    friction: Any
    temperature: _Value
    path: diffrax.AbstractBrownianPath

    def contr(self, t0: RealScalarLike, t1: RealScalarLike, **kwargs) -> BM:
        return self.path.evaluate(t0, t1, **kwargs)

    def vf(self, t: RealScalarLike, y: tuple[_P, _P], args: Args) -> PyTree[Array]:
        # For each array of the state, with a trailing axis of noises.
        flat, unravel = raveled(increment_struct(self.path))
        product = lambda unit: self.vf_prod(t, y, args, unravel(unit))
        return jax.vmap(product, out_axes=-1)(jnp.eye(flat.size, dtype=flat.dtype))

    def prod(self, vf: PyTree[Array], control: BM) -> tuple[_P, _P]:
        flat, _ = jfu.ravel_pytree(control)
        return jtu.tree_map(lambda v: jnp.tensordot(v, flat.astype(v.dtype), 1), vf)

    def vf_prod(
        self, t: RealScalarLike, y: tuple[_P, _P], args: Args, control: BM
    ) -> tuple[_P, _P]:
        check_pair(y)
        q = y[1]
        T = _value("temperature", self.temperature, t, q, args)
        kick = _root_product(self.friction, T, t, q, args, control)
        return kick, jtu.tree_map(jnp.zeros_like, q)


def momentum_first(
    terms: PyTree[diffrax.AbstractTerm], y: PyTree
) -> tuple[PyTree[diffrax.AbstractTerm], PyTree]:
    """Diffrax's own Langevin terms as a drift, a friction and a noise, with the velocity in
    the place of the momentum; and the halves of their state `(x, v)` exchanged. Other terms
    and their states are returned as they are."""
    parts = flattened(terms)
    if not any(isinstance(unwrapped(term), _DIFFRAX_DRIFT) for term in parts):
        return terms, y
    check_pair(y)
    exchanged = []
    for term in parts:
        own = unwrapped(term)
        if isinstance(own, _DIFFRAX_DRIFT):
            drift = diffrax.ODETerm(_Frictionless(own))
            friction = diffrax.ODETerm(_DiffraxFriction(own.gamma))
            exchanged += [replaced(term, drift), replaced(term, friction)]
        elif isinstance(own, diffrax.ODETerm):
            exchanged.append(replaced(term, diffrax.ODETerm(_ExchangedField(own))))
        else:
            exchanged.append(replaced(term, _Exchanged(own)))
    return diffrax.MultiTerm(*exchanged), (y[1], y[0])


_DIFFRAX_DRIFT = diffrax.UnderdampedLangevinDriftTerm


class _Frictionless(eqx.Module):
    """The drift of Diffrax's Langevin term without friction, for `(velocity, position)`."""

    term: diffrax.UnderdampedLangevinDriftTerm

    def __call__(self, t: RealScalarLike, y: tuple[_P, _P], args: Args):
        v, x = y
        still = jtu.tree_map(jnp.zeros_like, v)
        _, dv = self.term.vf(t, (x, still), args)
        return dv, v


class _DiffraxFriction(eqx.Module):
    """The friction of Diffrax's Langevin term, for `(velocity, position)`. Its `gamma` may
    be a prefix of the velocity."""

    gamma: PyTree[ArrayLike]

    def __call__(self, t: RealScalarLike, y: tuple[_P, _P], args: Args):
        v, x = y

        def forces(gamma, v):
            of = lambda v: -_not_negative(_like(gamma, v)) * v
            return jtu.tree_map(of, v)

        return jtu.tree_map(forces, self.gamma, v), jtu.tree_map(jnp.zeros_like, x)


class _ExchangedField(eqx.Module):
    """The vector field of a drift term with the halves of its state exchanged."""

    term: diffrax.ODETerm

    def __call__(self, t: RealScalarLike, y: tuple[_P, _P], args: Args):
        dx, dv = self.term.vf(t, (y[1], y[0]), args)
        return dv, dx


class _Exchanged(diffrax.AbstractTerm):
    """A noise term with the halves of its state exchanged."""

    term: diffrax.AbstractTerm

    def vf(self, t, y, args):
        return self.term.vf(t, (y[1], y[0]), args)

    def contr(self, t0, t1, **kwargs):
        return self.term.contr(t0, t1, **kwargs)

    def prod(self, vf, control):
        dx, dv = self.term.prod(vf, control)
        return dv, dx


class _Square(eqx.Module):
    """A constant array that may be a matrix; whether it is symmetric positive semidefinite,
    and then its root, computed once."""

    value: Array
    is_semidefinite: Bool[Array, ""]
    root: Array


def _value(name: str, value: Any, t, q: _P, args: Args) -> PyTree:
    return evaluated(name, value, t, q, args=args) if callable(value) else value


def _product(friction: Any, t, q: _P, args: Args, velocity: _P) -> _P:
    """`G v`."""
    if isinstance(friction, FrictionAlong):
        columns = _columns(friction, t, q, args)
        along = lambda d, v: jnp.tensordot(v, d, jnp.ndim(v))
        parts = jtu.tree_leaves(jtu.tree_map(along, columns, velocity))
        return jtu.tree_map(lambda d: d @ sum(parts), columns)

    def product(g, v):
        value = g.value if isinstance(g, _Square) else g
        if not _is_matrix(value, v):
            return _not_negative(_like(value, v)) * v
        force = jnp.tensordot(_like(value, v), v, jnp.ndim(v))
        if not isinstance(g, _Square):
            return force
        return jnp.where(g.is_semidefinite, force, jnp.nan)

    value = _for_each("friction", _value("friction", friction, t, q, args), q)
    return jtu.tree_map(product, value, velocity, is_leaf=_is_square)


def _root_product(friction: Any, T: PyTree, t, q: _P, args: Args, control: BM) -> _P:
    """`B W`."""
    if isinstance(friction, FrictionAlong):
        columns = _columns(friction, t, q, args)
        flat, _ = jfu.ravel_pytree(control)
        scale = _single_temperature(T)
        first = jtu.tree_leaves(columns)[0]
        if jnp.shape(first)[-1:] != flat.shape:
            raise ValueError(
                "The `path` of `langevin_terms` must have one noise for each direction of "
                f"the friction, shape {jnp.shape(first)[-1:]}; got shape {shapes(control)}."
            )
        along = lambda d: d @ (jnp.sqrt(2 * _like(scale, d)) * flat.astype(d.dtype))
        return jtu.tree_map(along, columns)
    if jtu.tree_structure(control) != jtu.tree_structure(q) or [
        jnp.shape(x) for x in jtu.tree_leaves(control)
    ] != [jnp.shape(x) for x in jtu.tree_leaves(q)]:
        raise ValueError(
            f"The `path` of `langevin_terms` must have the shape of `q`, {shapes(q)}; got "
            f"shape {shapes(control)}."
        )

    def product(g, temperature, x, w):
        w = _like(w, x)
        matrix = g.value if isinstance(g, _Square) else g
        if not _is_matrix(matrix, x):
            if jnp.shape(temperature) not in ((), jnp.shape(x)):
                raise ValueError(
                    "An array of `temperature` must be a scalar, or have the shape of its "
                    f"momenta, {jnp.shape(x)}; got shape {jnp.shape(temperature)}."
                )
            # Where either is negative, NaN makes the path fail.
            return jnp.sqrt(_like(matrix, x)) * jnp.sqrt(2 * _like(temperature, x)) * w
        scale = jnp.sqrt(2 * _like(_single_temperature(temperature), x))
        root = _like(g.root, x) if isinstance(g, _Square) else _root(_like(g, x))
        return scale * jnp.tensordot(root, w, jnp.ndim(w))

    value = _for_each("friction", _value("friction", friction, t, q, args), q)
    return jtu.tree_map(
        product, value, _for_each("temperature", T, q), q, control, is_leaf=_is_square
    )


def _columns(friction: FrictionAlong, t, q: _P, args: Args) -> _P:
    """The directions for each array of the momenta, with a trailing axis of noises."""
    columns = _value("directions", friction.directions, t, q, args)
    columns = _for_each("directions", columns, q)
    numbers = {jnp.shape(d)[-1:] for d in jtu.tree_leaves(columns)}
    fits = lambda d, x: jnp.ndim(d) > 0 and jnp.shape(d)[:-1] == jnp.shape(x)
    if len(numbers) > 1 or not all(
        jtu.tree_leaves(jtu.tree_map(fits, columns, q))
    ):  # fmt: skip
        raise ValueError(
            "`directions` of `FrictionAlong` must have the shape of the momenta and one "
            f"more axis, for the noises; got shape {shapes(columns)} for momenta of shape "
            f"{shapes(q)}."
        )
    return jtu.tree_map(_like, columns, q)


def _is_matrix(g: ArrayLike, x: Array) -> bool:
    """Whether this is a matrix for the momenta `x`, and not a number or an array of them.
    Raises a `ValueError` if it is neither."""
    if jnp.shape(g) in ((), jnp.shape(x)):
        return False
    if jnp.shape(g) != jnp.shape(x) * 2:
        raise ValueError(
            "An array of `friction` must be a scalar, or have the shape of its momenta, "
            f"{jnp.shape(x)}, or as a matrix the shape {jnp.shape(x) * 2}; got shape "
            f"{jnp.shape(g)}."
        )
    return True


def _for_each(name: str, value: PyTree, p: _P) -> PyTree:
    """`value` in the structure of the momenta."""
    if jtu.all_leaves([value], is_leaf=_is_square):
        return jtu.tree_map(lambda _: value, p)
    if jtu.tree_structure(value, is_leaf=_is_square) != jtu.tree_structure(p):
        raise ValueError(
            f"`{name}` must be one number or array, or have the structure of the momenta "
            f"{eqx.tree_pformat(p)}; got {eqx.tree_pformat(value)}."
        )
    return value


def _single_temperature(T: PyTree) -> ArrayLike:
    if not jtu.all_leaves([T]) or jnp.shape(T) != ():
        raise ValueError(
            "`temperature` must be one number for friction by a matrix or along "
            f"directions; got shape {shapes(T)}."
        )
    return T


def _not_negative(g: Array) -> Array:
    # Traced values cannot raise an error; NaN makes their path fail.
    return jnp.where(g >= 0, g, jnp.nan)


def _like(x: ArrayLike, y: Array) -> Array:
    return jnp.asarray(x, jnp.result_type(y))


def _is_square(x: Any) -> bool:
    return isinstance(x, _Square)


def _checked_friction(friction: Any, struct: PyTree | None) -> Any:
    """The friction with the roots of constant matrices, for a path of this shape, if there
    is one. Raises a `ValueError` if it is known to be invalid."""
    if isinstance(friction, FrictionAlong):
        if callable(friction.directions):
            check_takes("directions", friction.directions, "t", "q", "args")
        return jtu.tree_map(lambda x: x if callable(x) else jnp.asarray(x), friction)
    if callable(friction):
        check_takes("friction", friction, "t", "q", "args")
        return friction
    if len(jtu.tree_leaves(friction)) == 0:
        raise ValueError(
            "`friction` must be a number, an array, a PyTree of arrays, a `FrictionAlong`, "
            f"or a function `(t, q, args)`; got {friction!r}."
        )
    if struct is None:
        return jtu.tree_map(lambda g: _checked_array(g, None), friction)
    each = jtu.tree_map(lambda s: jnp.zeros(s.shape), struct)
    one = jtu.all_leaves([friction])
    if one and len({x.shape for x in jtu.tree_leaves(each)}) == 1:
        return _checked_array(friction, jtu.tree_leaves(each)[0])
    if one:
        return _checked_array(friction, None)
    return jtu.tree_map(_checked_array, _for_each("friction", friction, each), each)


def _checked_array(g: ArrayLike, x: Array | None) -> Array | _Square:
    """Of the friction of the momenta `x`, if their shape is known."""
    shape = jnp.shape(g)
    half = len(shape) // 2
    may_be_matrix = half > 0 and shape == shape[:half] * 2
    is_matrix = x is not None and _is_matrix(g, x)
    kind = "a real number, an array or PyTree of them, or a function of `(t, q, args)`"
    if not may_be_matrix:
        return jnp.asarray(real_array("friction", g, positive=False, kind=kind))
    root = _root(jnp.asarray(g, jnp.result_type(g, float)))
    is_semidefinite = ~jnp.any(jnp.isnan(root))
    square = _Square(jnp.asarray(g), is_semidefinite, root)
    if isinstance(is_semidefinite, jax.core.Tracer):
        return square
    if not is_semidefinite and (is_matrix or not np.all(np.asarray(g) >= 0)):
        raise ValueError(
            "`friction` must be a symmetric positive semidefinite matrix, or an array of "
            f"numbers that are not negative, one for each momentum; got {g!r}."
        )
    return square


def _checked_temperature(temperature: Any) -> Any:
    if callable(temperature):
        check_takes("temperature", temperature, "t", "q", "args")
        return temperature
    kind = "a real number, an array or PyTree of them, or a function of `(t, q, args)`"
    checked = lambda T: jnp.asarray(
        real_array("temperature", T, positive=False, kind=kind)
    )
    return jtu.tree_map(checked, temperature)


def _root(matrix: Float[Array, "..."]) -> Float[Array, "..."]:
    r"""$L$ with $L L^\top$ equal to a symmetric positive semidefinite matrix: its Cholesky
    factor, with zero columns where the matrix is singular. NaN if it is no such matrix.

    A column is zero if its pivot is a rounding error, whose root would be far larger than
    one: a friction between particles would then change their total momentum.
    """
    n = round(matrix.size**0.5)
    A = matrix.reshape(n, n)
    eps = jnp.finfo(A.dtype).eps
    diagonal = jnp.diag(A)
    # Of a pivot, which is a difference of numbers up to the entry of the diagonal.
    rounding = 10 * n * eps * diagonal
    # No entry of what is left of a semidefinite matrix without its tiny pivots is larger.
    size = jnp.sqrt(jnp.maximum(diagonal, 0))
    most = 10 * (n * eps) ** 0.5 * size[:, None] * size

    def column(j, carry):
        left, root, is_valid = carry
        pivot = left[j, j]
        used = pivot > rounding[j]
        below = left[:, j] / jnp.sqrt(jnp.where(used, pivot, 1))
        below = jnp.where(used & (jnp.arange(n) >= j), below, 0)
        left = left - below[:, None] * below
        is_valid = is_valid & (pivot >= -rounding[j])
        return left, root.at[:, j].set(below), is_valid

    begin = A, jnp.zeros_like(A), _is_symmetric(A) & jnp.all(jnp.isfinite(A))
    left, root, is_valid = jax.lax.fori_loop(0, n, column, begin, unroll=n <= 16)
    is_valid = is_valid & jnp.all(jnp.abs(left) <= most)
    return jnp.where(is_valid, root, jnp.nan).reshape(matrix.shape)


def _is_symmetric(matrix: Float[Array, "n n"]) -> Bool[Array, ""]:
    size = 100 * jnp.finfo(matrix.dtype).eps * jnp.max(jnp.abs(matrix))
    return jnp.max(jnp.abs(matrix - matrix.T)) <= size
