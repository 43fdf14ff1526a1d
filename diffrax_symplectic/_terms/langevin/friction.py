"""The forms of friction, numbers, a matrix or directions, and its root in the noise of a
temperature."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, ArrayLike, Float, PyTree

from ..._arguments import check_takes, checked_not_negative, shapes
from ..._compat import is_traced
from ..._custom_types import Args, BM, RealScalarLike
from ..callers import AbstractCaller
from ..evaluation import call_user_function


# Momenta, velocities or positions: an array, or a PyTree of arrays.
_HalfState = PyTree[Array]
# A temperature, constant or a function.
Value = (
    PyTree[ArrayLike] | Callable[[RealScalarLike, _HalfState, Args], PyTree[ArrayLike]]
)
# A friction, constant or a function, except for directions.
FrictionValue = (
    Value
    | lx.AbstractLinearOperator
    | Callable[[RealScalarLike, _HalfState, Args], lx.AbstractLinearOperator]
)

_EXPECTED = "a real number, an array or PyTree of them, or a function of `(t, q, args)`"
_PASS_MATRIX = (
    "a matrix as `lineax.MatrixLinearOperator(matrix, "
    "lineax.positive_semidefinite_tag)`"
)
_PASS_BLOCKS = (
    "For momenta of shape `(n, d)` pass `lineax.PyTreeLinearOperator(array, "
    "jax.eval_shape(lambda: q), lineax.positive_semidefinite_tag)` with an array of shape "
    "`(n, d, n, d)`"
)


class FrictionAlong(AbstractCaller):
    r"""Friction along given directions, for [`diffrax_symplectic.langevin_terms`][]:
    $G = \sum_k d_k d_k^\top$.

    For friction between pairs of particles, each pair has a direction, which is opposite
    for the two of them. The noise is $\sqrt{2 T} \sum_k d_k\,\mathrm{d}w_k$, so that no
    root of a matrix is taken, and both conserve the total momentum.
    """

    directions: Value

    def __init__(self, directions: Value):
        """**Arguments:**

        - `directions`: an array of shape `(*p.shape, m)` for `m` noises, or for momenta in
            a PyTree a PyTree of such arrays; or a function `(t, q, args)` of these. In
            units of the root of a friction, (force / velocity)^(1/2).
        """
        self.directions = directions

    def called_with(self, t, y, args):
        _, q = y
        return {"directions": (t, q, args)}


class _Matrix(eqx.Module):
    """A constant matrix of friction, for momenta as a vector, with what would take long in
    every step. NaN if it is not symmetric positive semidefinite.

    - `matrix`: the matrix.
    - `root`: its root.
    - `structure`: the structure, shapes and dtypes of the momenta.
    """

    matrix: Float[Array, "n n"]
    root: Float[Array, "n n"]
    structure: PyTree[jax.ShapeDtypeStruct] = eqx.field(static=True)


def value_at(name: str, value: Any, t, q: _HalfState, args: Args) -> Any:
    """The user's friction, temperature or directions, called `name` in messages: a
    constant, or the value of a function."""
    if not callable(value):
        return value
    return call_user_function(name, value, t, q, args=args)


def product_with(
    friction: Any, t, q: _HalfState, args: Args, velocity: _HalfState
) -> _HalfState:
    """`G v` for the user's `friction` G in any of its forms. NaN where numbers are
    negative, or a constant matrix is not semidefinite."""
    if isinstance(friction, FrictionAlong):
        # G v = sum_k d_k (d_k . v), which costs less than to form the matrix. In the scalar
        # products each array of momenta is one summand.
        columns = _checked_columns(friction, t, q, args)
        speeds = jtu.tree_map(
            lambda d, v: jnp.tensordot(v, d, axes=jnp.ndim(v)), columns, velocity
        )
        total_speeds = sum(jtu.tree_leaves(speeds))
        return jtu.tree_map(lambda directions: directions @ total_speeds, columns)
    value = value_at("friction", friction, t, q, args)
    if _is_matrix(value):
        # Whether the value of a function is semidefinite is checked where the noise takes
        # its root.
        matrix = _checked_matrix(value, q, "the momenta")
        flat_v, unravel = jfu.ravel_pytree(velocity)
        return unravel(in_precision_of(matrix, flat_v) @ flat_v)
    values = _checked_numbers("friction", value, q)
    return jtu.tree_map(
        lambda g, v: not_negative(in_precision_of(g, v)) * v, values, velocity
    )


def root_product_with(
    friction: Any, T: PyTree, t, q: _HalfState, args: Args, control: BM
) -> _HalfState:
    """`B W` for the increments `W = control`, with `B B^T = 2 T G`. Raises a `ValueError`
    if their shapes do not fit the friction or the momenta."""
    if isinstance(friction, FrictionAlong):
        columns = _checked_columns(friction, t, q, args)
        T = _checked_single_temperature(T)
        flat_w, _ = jfu.ravel_pytree(control)
        # The shape `(m,)` for `m` directions, which all arrays share.
        noise_shape = jnp.shape(jtu.tree_leaves(columns)[0])[-1:]
        if noise_shape != flat_w.shape:
            raise ValueError(
                "The `path` of `langevin_terms` must have one noise for each direction of "
                f"the friction, shape {noise_shape}; got shape {shapes(control)}."
            )

        def kick_along(directions: Array) -> Array:
            scale = _root(2 * in_precision_of(T, directions))
            return directions @ (scale * in_precision_of(flat_w, directions))

        return jtu.tree_map(kick_along, columns)
    if not _have_same_shapes(control, q):
        raise ValueError(
            f"The `path` of `langevin_terms` must have the shape of `q`, {shapes(q)}; got "
            f"shape {shapes(control)}."
        )
    value = value_at("friction", friction, t, q, args)
    if _is_matrix(value):
        matrix = _checked_matrix(value, q, "the momenta")
        root = value.root if isinstance(value, _Matrix) else _root_of_matrix(matrix)
        flat_q, unravel = jfu.ravel_pytree(q)
        flat_w, _ = jfu.ravel_pytree(control)
        scale = _root(2 * in_precision_of(_checked_single_temperature(T), flat_q))
        w = in_precision_of(flat_w, flat_q)
        return unravel(scale * (in_precision_of(root, flat_q) @ w))
    numbers = _checked_numbers("friction", value, q)
    temperatures = _checked_numbers("temperature", T, q)

    def kick(g: ArrayLike, T: ArrayLike, w: Array, x: Array) -> Array:
        # Where either is negative, NaN makes the path fail.
        scale = _root(in_precision_of(g, x)) * _root(2 * in_precision_of(T, x))
        return scale * in_precision_of(w, x)

    return jtu.tree_map(kick, numbers, temperatures, control, q)


def _have_same_shapes(a: PyTree, b: PyTree) -> bool:
    """Whether two PyTrees have the same structure and shapes."""
    equal = eqx.tree_equal(jtu.tree_map(jnp.shape, a), jtu.tree_map(jnp.shape, b))
    return bool(equal)


def _is_matrix(friction: Any) -> bool:
    return isinstance(friction, _Matrix | lx.AbstractLinearOperator)


def _root_of_matrix(matrix: Array) -> Float[Array, "n n"]:
    return semidefinite_root(jnp.asarray(matrix, jnp.result_type(matrix, float)))


def _checked_matrix(
    friction: _Matrix | lx.AbstractLinearOperator, momenta: PyTree, called: str
) -> Array:
    """The matrix of the friction, for momenta as a vector. Raises a `ValueError` unless an
    operator is tagged as positive semidefinite, and maps PyTrees with the structure and
    shapes of `momenta` to such PyTrees. The message calls these `called`."""
    if isinstance(friction, _Matrix):
        structure = friction.structure
    elif lx.is_positive_semidefinite(friction):
        structure = friction.in_structure()
    else:
        raise ValueError(
            "The operator of `friction` must be tagged as positive semidefinite: pass "
            f"{_PASS_MATRIX}."
        )
    if not _have_same_shapes(structure, momenta):
        raise ValueError(
            f"The operator of `friction` must act on arrays with the shape of {called}, "
            f"{shapes(momenta)}; got one for shape {shapes(structure)}. "
            f"{_PASS_BLOCKS}."
        )
    return friction.matrix if isinstance(friction, _Matrix) else friction.as_matrix()


def _checked_columns(
    friction: FrictionAlong, t, q: _HalfState, args: Args
) -> _HalfState:
    """The directions for each array of the momenta, with a trailing axis of noises. Raises
    a `ValueError` if their shapes do not fit the momenta."""
    columns = value_at("directions", friction.directions, t, q, args)
    columns = _value_for_each("directions", columns, q)

    def fits(column: ArrayLike, momenta: Array) -> bool:
        return jnp.ndim(column) > 0 and jnp.shape(column)[:-1] == jnp.shape(momenta)

    # All arrays have the same directions, so their last axes agree.
    last_axes = {jnp.shape(column)[-1:] for column in jtu.tree_leaves(columns)}
    if len(last_axes) > 1 or not jtu.tree_all(jtu.tree_map(fits, columns, q)):
        raise ValueError(
            "`directions` of `FrictionAlong` must have the shape of the momenta and one "
            f"more axis, for the noises; got shape {shapes(columns)} for momenta of shape "
            f"{shapes(q)}."
        )
    return jtu.tree_map(in_precision_of, columns, q)


def _checked_numbers(
    name: str, value: PyTree, momenta: PyTree, called: str = "its momenta"
) -> PyTree:
    """The friction or temperature in the user's argument `name`, as numbers for each array
    of the `momenta`. Messages call the momenta `called`, since a path may stand in for
    them.

    Raises a `ValueError` unless these are a single number, or an array with as many axes as
    the momenta, each as long as theirs or one. (NumPy would also add axes in front. So for
    three particles in space `(3,)` would be one number for each axis of space, and more
    often one for each particle is meant.)"""
    values = _value_for_each(name, value, momenta)
    for x, of_momenta in zip(jtu.tree_leaves(values), jtu.tree_leaves(momenta)):
        shape = jnp.shape(x)
        momenta_shape = jnp.shape(of_momenta)
        fits = len(shape) == len(momenta_shape) and all(
            length in (1, of_axis) for length, of_axis in zip(shape, momenta_shape)
        )
        if shape == () or fits:
            continue
        advice = ""
        if len(momenta_shape) > 1 and shape == momenta_shape[:1]:
            axes = ", ".join([":"] + ["None"] * (len(momenta_shape) - 1))
            advice += f" For one number for each particle pass `{name}[{axes}]`."
        if name == "friction" and len(shape) == 2 and shape[0] == shape[1]:
            has_axes = len(momenta_shape) > 1
            advice += f" {_PASS_BLOCKS}." if has_axes else f" Pass {_PASS_MATRIX}."
        raise ValueError(
            f"An array of `{name}` must have the shape of {called}, {momenta_shape}, in "
            "which any axis may have length one, or be a single number; got shape "
            f"{shape}.{advice}"
        )
    return values


def _value_for_each(name: str, value: PyTree, p: PyTree) -> PyTree:
    """The user's argument `name`, a value for each array of momenta, in the structure of
    the momenta `p`: a single value is that of each array. Raises a `ValueError` if it has
    another structure."""
    if jtu.all_leaves([value]):
        return jtu.tree_map(lambda _: value, p)
    if jtu.tree_structure(value) != jtu.tree_structure(p):
        # The momenta may be given by their shapes.
        momenta = eqx.tree_pformat(p, struct_as_array=True)
        advice = ""
        if isinstance(value, list | tuple):
            advice = f" For an array pass `jnp.array({name})`, not a list."
        raise ValueError(
            f"`{name}` must be one number or array, or have the structure of the momenta "
            f"{momenta}; got {eqx.tree_pformat(value)}.{advice}"
        )
    return value


def _checked_single_temperature(T: PyTree) -> ArrayLike:
    """The temperature. Raises a `ValueError` unless it is one number. (With several,
    friction that mixes momenta has no stationary density that is known.)"""
    if not jtu.all_leaves([T]) or jnp.shape(T) != ():
        raise ValueError(
            "`temperature` must be one number for friction by a matrix or along "
            f"directions; got shape {shapes(T)}."
        )
    return T


def not_negative(friction: Array) -> Array:
    """The friction, or NaN where it is negative."""
    # Traced values cannot raise an error; NaN makes their path fail.
    return jnp.where(friction >= 0, friction, jnp.nan)


def _root(x: Array) -> Array:
    """The square root, with the derivative zero at zero, and NaN of negative numbers.

    A friction or temperature that is zero in a part of space, or for some momenta, stays
    zero along most directions. The infinite derivative of `jnp.sqrt`, times zero, would
    make the derivatives along these NaN.
    """
    positive = x > 0
    root = jnp.sqrt(jnp.where(positive, x, 1))
    # At zero the result is a constant, and not `x`, which would hand its derivative on.
    return jnp.where(positive, root, jnp.where(x == 0, 0.0, jnp.nan).astype(x.dtype))


def in_precision_of(x: ArrayLike, other: Array) -> Array:
    """`x` in the precision of `other`."""
    return jnp.asarray(x, jnp.result_type(other))


def checked_friction(
    friction: Any, path_struct: PyTree[jax.ShapeDtypeStruct] | None
) -> Any:
    """The friction, with the root of a constant matrix, for a path with increments like
    `path_struct`, or without a path. Raises a `ValueError` if it is known to be invalid."""
    # Before the solve only the shape of the path is known. If the friction does not fit it,
    # the path or the friction may be wrong, so messages name what both have to fit.
    what_it_fits = "the `path` and the momenta"
    if isinstance(friction, FrictionAlong):
        if not callable(friction.directions):
            return jtu.tree_map(jnp.asarray, friction)
        check_takes("directions", friction.directions, "t", "q", "args")
        return friction
    if isinstance(friction, lx.AbstractLinearOperator):
        # Without a path the operator is compared with its own structure here, and with the
        # momenta in the solve.
        structure = friction.in_structure()
        momenta = structure if path_struct is None else path_struct
        matrix = _checked_matrix(friction, momenta, what_it_fits)
        # The root of any other matrix than a semidefinite one is NaN.
        root = _root_of_matrix(matrix)
        is_semidefinite = ~jnp.any(jnp.isnan(root))
        if not is_traced(is_semidefinite) and not is_semidefinite:
            raise ValueError(
                "`friction` must be a symmetric positive semidefinite matrix; got "
                f"{matrix}."
            )
        return _Matrix(jnp.where(is_semidefinite, matrix, jnp.nan), root, structure)
    if callable(friction):
        check_takes("friction", friction, "t", "q", "args")
        return friction
    if len(jtu.tree_leaves(friction)) == 0:
        raise ValueError(
            "`friction` must be a number, an array, a PyTree of arrays, a matrix as an "
            "operator of Lineax, a `FrictionAlong`, or a function `(t, q, args)`; got "
            f"{friction!r}."
        )
    if path_struct is not None:
        _checked_numbers("friction", friction, path_struct, what_it_fits)
    return _checked_arrays("friction", friction)


def checked_temperature(temperature: Any) -> Any:
    """The temperature, in arrays. Raises a `ValueError` if it is known to be invalid."""
    if callable(temperature):
        check_takes("temperature", temperature, "t", "q", "args")
        return temperature
    return _checked_arrays("temperature", temperature)


def _checked_arrays(name: str, values: PyTree[ArrayLike]) -> PyTree[Array]:
    """The numbers in the user's argument `name`, in arrays. Raises a `ValueError` if they
    are known to be invalid."""

    def checked(x: ArrayLike) -> Array:
        return jnp.asarray(checked_not_negative(name, x, expected=_EXPECTED))

    return jtu.tree_map(checked, values)


# With `jit` this function is traced and compiled once for each shape.
@jax.jit
def semidefinite_root(square: Float[Array, "n n"]) -> Float[Array, "n n"]:
    r"""$L$ with $L L^\top$ equal to a symmetric positive semidefinite matrix: its Cholesky
    factor, with zero columns where the matrix is singular. NaN if it is no such matrix.

    A column is zero if its pivot is a rounding error, whose root would be far larger than
    one: a friction between particles would then change their total momentum.
    """
    n = len(square)
    eps = jnp.finfo(square.dtype).eps
    diagonal = jnp.diag(square)
    # The error of a pivot, which is a difference of numbers up to the diagonal entry. A
    # column is left out where its pivot is not larger.
    rounding = 10 * n * eps * diagonal
    # No entry (i, j) of a semidefinite matrix is larger than the root of the product of the
    # diagonal entries i and j. One of these is below `rounding` where a column was left
    # out, which gives a bound on what is left of a semidefinite matrix at the end.
    root_of_diagonal = jnp.sqrt(jnp.maximum(diagonal, 0))
    largest_remainder = (
        10 * (n * eps) ** 0.5 * root_of_diagonal[:, None] * root_of_diagonal
    )

    def with_column(j: Any, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        """The remainder of the matrix after column `j` of the root, the root with this
        column, and whether the matrix may still be semidefinite."""
        remainder, root, is_valid = carry
        pivot = remainder[j, j]
        is_used = pivot > rounding[j]
        entries = remainder[:, j] / jnp.sqrt(jnp.where(is_used, pivot, 1))
        entries = jnp.where(is_used & (jnp.arange(n) >= j), entries, 0)
        remainder = remainder - entries[:, None] * entries
        is_valid = is_valid & (pivot >= -rounding[j])
        return remainder, root.at[:, j].set(entries), is_valid

    asymmetry = jnp.max(jnp.abs(square - square.T))
    is_symmetric = asymmetry <= 100 * eps * jnp.max(jnp.abs(square))
    is_valid = is_symmetric & jnp.all(jnp.isfinite(square))
    # The remainder, the root and whether the matrix may be semidefinite, before any column.
    carry = (square, jnp.zeros_like(square), is_valid)
    # The loop is unrolled for all matrices that the fused engine solves with: the engine
    # takes no column whose number is known only when it runs.
    carry = jax.lax.fori_loop(0, n, with_column, carry, unroll=n <= 16)
    remainder, root, is_valid = carry
    is_valid = is_valid & jnp.all(jnp.abs(remainder) <= largest_remainder)
    return jnp.where(is_valid, root, jnp.nan)
