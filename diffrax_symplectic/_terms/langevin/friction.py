"""The forms of the friction `G`, and the products that a Langevin equation needs: `G v` for
the force of friction, and `B w` with `B B^T = 2 T G` for the noise of a temperature `T`.

A friction has one of three forms:

- numbers for each array of the momenta, which multiply them entry by entry;
- a matrix: an operator of Lineax, or a `_Matrix` if it is constant;
- directions: a `FrictionAlong`, here also called columns, as those of a matrix.

Numbers and matrices may also be the values of a function `(t, q, args)`.
"""

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
# A temperature, constant or a function; also a friction by numbers.
Value = (
    PyTree[ArrayLike] | Callable[[RealScalarLike, _HalfState, Args], PyTree[ArrayLike]]
)
# A friction by numbers or a matrix, constant or a function.
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
# What a friction has to fit, in messages before the solve. Only the path is known then, and
# the path may be what is wrong.
_PATH_AND_MOMENTA = "the `path` and the momenta"


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
    """A constant matrix of friction, for momenta flattened to a vector. Its root, which
    takes long to compute, is kept for all steps.

    - `matrix`: the matrix `G`; NaN if it is not symmetric positive semidefinite.
    - `root`: `L` with `L L^T = G`, or NaN.
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
    """`G v` for the user's friction `G` in any of its forms, and `v = velocity`:

    - directions `d_k`: `sum_k d_k (d_k . v)`, which costs less than to form the matrix;
    - a matrix times the flattened velocities;
    - numbers `g`: `g v`, entry by entry.

    NaN where numbers are negative, or if a constant matrix is not semidefinite. For the
    matrix of a function this is not checked: then its root in the noise is NaN."""
    if isinstance(friction, FrictionAlong):
        columns = _checked_columns(friction, t, q, args)
        # Each array of the momenta gives one summand of the scalar products `d_k . v`.
        summands = jtu.tree_map(
            lambda d, v: jnp.tensordot(v, d, axes=jnp.ndim(v)), columns, velocity
        )
        scalar_products = sum(jtu.tree_leaves(summands))
        return jtu.tree_map(lambda d: d @ scalar_products, columns)
    value = value_at("friction", friction, t, q, args)
    if _is_matrix(value):
        matrix = _checked_matrix(value, q, "the momenta")
        flat_v, unravel = jfu.ravel_pytree(velocity)
        return unravel(in_precision_of(matrix, flat_v) @ flat_v)
    numbers = _checked_numbers("friction", value, q)
    return jtu.tree_map(
        lambda g, v: not_negative(in_precision_of(g, v)) * v, numbers, velocity
    )


def root_product_with(
    friction: Any, T: PyTree, t, q: _HalfState, args: Args, control: BM
) -> _HalfState:
    """`B w` for the user's friction `G` in any of its forms and the increments
    `w = control`, with `B B^T = 2 T G`:

    - directions `d_k`: `B = sqrt(2 T) (d_1, ..., d_m)`, one column for each direction;
    - a matrix: `B = sqrt(2 T) L` with `L L^T = G`;
    - numbers `g`: `B` is diagonal, with `sqrt(g) sqrt(2 T)` on its diagonal.

    NaN where `g` or `T` is negative, or if a matrix is not semidefinite. Raises a
    `ValueError` if the shapes of the increments do not fit the friction or the momenta."""
    if isinstance(friction, FrictionAlong):
        return _root_product_along(friction, T, t, q, args, control)
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
        # `x` is an array of positions, in whose precision the result is computed.
        scale = _root(in_precision_of(g, x)) * _root(2 * in_precision_of(T, x))
        return scale * in_precision_of(w, x)

    return jtu.tree_map(kick, numbers, temperatures, control, q)


def _root_product_along(
    friction: FrictionAlong, T: PyTree, t, q: _HalfState, args: Args, control: BM
) -> _HalfState:
    """`sqrt(2 T) sum_k d_k w_k` for the directions `d_k` of a friction: `root_product_with`
    for this form."""
    columns = _checked_columns(friction, t, q, args)
    T = _checked_single_temperature(T)
    flat_w, _ = jfu.ravel_pytree(control)
    # `(m,)` for `m` directions. All arrays of momenta have the same directions.
    noise_shape = jnp.shape(jtu.tree_leaves(columns)[0])[-1:]
    if noise_shape != flat_w.shape:
        raise ValueError(
            "The `path` of `langevin_terms` must have one noise for each direction of "
            f"the friction, shape {noise_shape}; got shape {shapes(control)}."
        )

    def kick(d: Array) -> Array:
        scale = _root(2 * in_precision_of(T, d))
        return d @ (scale * in_precision_of(flat_w, d))

    return jtu.tree_map(kick, columns)


def _have_same_shapes(a: PyTree, b: PyTree) -> bool:
    """Whether two PyTrees have the same structure and shapes."""
    equal = eqx.tree_equal(jtu.tree_map(jnp.shape, a), jtu.tree_map(jnp.shape, b))
    return bool(equal)


def _is_matrix(friction: Any) -> bool:
    """Whether a friction is a matrix, constant or the value of a function."""
    return isinstance(friction, _Matrix | lx.AbstractLinearOperator)


def _root_of_matrix(matrix: Array) -> Float[Array, "n n"]:
    """The `semidefinite_root` of a matrix, also of integers."""
    return semidefinite_root(jnp.asarray(matrix, jnp.result_type(matrix, float)))


def _checked_matrix(
    friction: _Matrix | lx.AbstractLinearOperator, momenta: PyTree, called: str
) -> Array:
    """The matrix of a friction, for momenta flattened to a vector.

    Raises a `ValueError` unless the friction acts on PyTrees with the structure and shapes
    of `momenta`, which the message calls `called`. Also raises one if an operator is not
    tagged as positive semidefinite."""
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
    """The directions of a friction: for each array of the momenta an array with one more
    axis, of noises. Raises a `ValueError` if their shapes do not fit the momenta."""
    columns = value_at("directions", friction.directions, t, q, args)
    columns = _value_for_each("directions", columns, q)

    def fits(column: ArrayLike, momenta: Array) -> bool:
        return jnp.ndim(column) > 0 and jnp.shape(column)[:-1] == jnp.shape(momenta)

    # The last axis counts the directions, so it is as long in all arrays.
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
    """The numbers of the user's argument `name`, a friction or temperature, in the
    structure of the momenta. Raises a `ValueError` unless the argument has, for each array
    of the momenta, a single number or an array that fits axis by axis.

    Messages call the momenta `called`. Before the solve `momenta` are the shapes of the
    path, which are those of the momenta.

    To fit, an array needs as many axes as the momenta, each as long as theirs or of length
    one. (NumPy would also add axes in front. For three particles in space, an array of
    shape `(3,)` would then hold one number for each axis of space. More often one for each
    particle is meant.)"""
    values = _value_for_each(name, value, momenta)
    for x, of_momenta in zip(jtu.tree_leaves(values), jtu.tree_leaves(momenta)):
        shape = jnp.shape(x)
        momenta_shape = jnp.shape(of_momenta)
        if shape == () or _fits_axis_by_axis(shape, momenta_shape):
            continue
        advice = ""
        # One number for each particle, in a vector.
        if len(momenta_shape) > 1 and shape == momenta_shape[:1]:
            axes = ", ".join([":"] + ["None"] * (len(momenta_shape) - 1))
            advice += f" For one number for each particle pass `{name}[{axes}]`."
        # Probably a matrix.
        if name == "friction" and len(shape) == 2 and shape[0] == shape[1]:
            has_axes = len(momenta_shape) > 1
            advice += f" {_PASS_BLOCKS}." if has_axes else f" Pass {_PASS_MATRIX}."
        raise ValueError(
            f"An array of `{name}` must have the shape of {called}, {momenta_shape}, in "
            "which any axis may have length one, or be a single number; got shape "
            f"{shape}.{advice}"
        )
    return values


def _fits_axis_by_axis(shape: tuple[int, ...], momenta_shape: tuple[int, ...]) -> bool:
    """Whether an array has as many axes as the momenta, each of their length or of one."""
    pairs = zip(shape, momenta_shape)
    all_fit = all(length in (1, momenta_length) for length, momenta_length in pairs)
    return len(shape) == len(momenta_shape) and all_fit


def _value_for_each(name: str, value: PyTree, p: PyTree) -> PyTree:
    """The user's argument `name` in the structure of the momenta `p`. A single value is
    repeated for each array of momenta. Raises a `ValueError` for any other structure."""
    if jtu.all_leaves([value]):
        return jtu.tree_map(lambda _: value, p)
    if jtu.tree_structure(value) != jtu.tree_structure(p):
        # The momenta may be arrays or only their shapes. Both are shown by their shapes.
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
    """The temperature `T`. Raises a `ValueError` unless it is one number. (With several
    temperatures, no stationary density is known for friction that mixes momenta.)"""
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
    """The square root, with the derivative zero at zero; NaN for negative numbers.

    A friction or temperature may be zero in a part of space, where its derivatives are zero
    along most directions. The derivative of `jnp.sqrt` at zero is infinite, and infinity
    times zero would be NaN.
    """
    positive = x > 0
    # Both branches of a `where` are differentiated, so neither may have an infinite
    # derivative.
    root = jnp.sqrt(jnp.where(positive, x, 1))
    # At zero the result is the constant 0.0, and not `x`, whose derivative is not zero.
    return jnp.where(positive, root, jnp.where(x == 0, 0.0, jnp.nan).astype(x.dtype))


def in_precision_of(x: ArrayLike, other: Array) -> Array:
    """`x` with the dtype of `other`."""
    return jnp.asarray(x, jnp.result_type(other))


def checked_friction(
    friction: Any, path_struct: PyTree[jax.ShapeDtypeStruct] | None
) -> Any:
    """The user's friction in the form in which terms hold it. Raises a `ValueError` if the
    friction is known to be invalid.

    - A `FrictionAlong` has its directions in arrays, or as a function.
    - A constant matrix becomes a `_Matrix`, with its root.
    - A function stays as it is.
    - Numbers become arrays.

    `path_struct` has the shapes of the increments of the path; it is `None` without a path.
    """
    if isinstance(friction, FrictionAlong):
        if not callable(friction.directions):
            return jtu.tree_map(jnp.asarray, friction)
        check_takes("directions", friction.directions, "t", "q", "args")
        return friction
    if isinstance(friction, lx.AbstractLinearOperator):
        return _constant_matrix(friction, path_struct)
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
        # Only the errors of this check are wanted. The numbers themselves are brought into
        # the structure of the momenta in the solve, where the momenta are known.
        _checked_numbers("friction", friction, path_struct, _PATH_AND_MOMENTA)
    return _checked_arrays("friction", friction)


def _constant_matrix(
    operator: lx.AbstractLinearOperator,
    path_struct: PyTree[jax.ShapeDtypeStruct] | None,
) -> _Matrix:
    """The matrix of a constant friction, with its root. Raises a `ValueError` if it does
    not fit the path, or if it is known not to be symmetric positive semidefinite."""
    structure = operator.in_structure()
    # The path has the shapes of the momenta. Without a path the operator is compared with
    # itself here, and with the momenta in the solve.
    momenta = structure if path_struct is None else path_struct
    matrix = _checked_matrix(operator, momenta, _PATH_AND_MOMENTA)
    # The root is NaN if the matrix is not symmetric positive semidefinite.
    root = _root_of_matrix(matrix)
    is_semidefinite = ~jnp.any(jnp.isnan(root))
    if not is_traced(is_semidefinite) and not is_semidefinite:
        raise ValueError(
            f"`friction` must be a symmetric positive semidefinite matrix; got {matrix}."
        )
    # A traced matrix could not raise the error above. Where it is not semidefinite, NaN
    # makes the path fail, also if there is no noise, which would take the root.
    matrix = jnp.where(is_semidefinite, matrix, jnp.nan)
    return _Matrix(matrix, root, structure)


def checked_temperature(temperature: Any) -> Any:
    """The user's temperature: numbers as arrays, or a function as it is. Raises a
    `ValueError` if the temperature is known to be invalid."""
    if callable(temperature):
        check_takes("temperature", temperature, "t", "q", "args")
        return temperature
    return _checked_arrays("temperature", temperature)


def _checked_arrays(name: str, values: PyTree[ArrayLike]) -> PyTree[Array]:
    """The numbers in the user's argument `name`, as arrays. Raises a `ValueError` if one is
    known to be negative or not finite."""

    def checked(x: ArrayLike) -> Array:
        return jnp.asarray(checked_not_negative(name, x, expected=_EXPECTED))

    return jtu.tree_map(checked, values)


# With `jit` this function is traced and compiled once for each shape.
@jax.jit
def semidefinite_root(square: Float[Array, "n n"]) -> Float[Array, "n n"]:
    r"""The matrix $L$ with $L L^\top$ equal to `square`, a symmetric positive semidefinite
    matrix: its Cholesky factor, with zero columns where `square` is singular. NaN if
    `square` is not symmetric positive semidefinite.

    Columns are computed one after another, by Cholesky's method: the column `j` of `L` is
    the column `j` of the remainder, `square` minus the products of the earlier columns,
    over the root of its entry `(j, j)`, the pivot.

    A pivot that is a rounding error gives a zero column. Its root would be far larger than
    a rounding error: with it, a friction between particles would change their total
    momentum.
    """
    n = len(square)
    eps = jnp.finfo(square.dtype).eps
    diagonal = jnp.diag(square)
    # The rounding error of each pivot, a difference of numbers up to the diagonal entry.
    rounding = 10 * n * eps * diagonal
    # A bound on the entries r_ij of the remainder of a semidefinite matrix, after all
    # columns. An entry is left only if the pivot of its row or column, say of row i, was a
    # rounding error. Then the entry was at most sqrt(r_ii r_jj), with r_ii <= rounding[i]
    # and r_jj <= diagonal[j]. The bound is three times as large.
    root_of_diagonal = jnp.sqrt(jnp.maximum(diagonal, 0))
    largest_remainder = (
        10 * (n * eps) ** 0.5 * root_of_diagonal[:, None] * root_of_diagonal
    )

    def with_column(j: Any, carry: tuple[Any, ...]) -> tuple[Any, ...]:
        """`carry` after column `j`: the remainder of the matrix, the columns of the root so
        far, and whether the matrix may still be semidefinite."""
        remainder, root, is_valid = carry
        pivot = remainder[j, j]
        # If not, the column is zero.
        is_used = pivot > rounding[j]
        entries = remainder[:, j] / jnp.sqrt(jnp.where(is_used, pivot, 1))
        # The root is a lower triangular matrix.
        entries = jnp.where(is_used & (jnp.arange(n) >= j), entries, 0)
        remainder = remainder - entries[:, None] * entries
        is_valid = is_valid & (pivot >= -rounding[j])
        return remainder, root.at[:, j].set(entries), is_valid

    asymmetry = jnp.max(jnp.abs(square - square.T))
    is_symmetric = asymmetry <= 100 * eps * jnp.max(jnp.abs(square))
    is_valid = is_symmetric & jnp.all(jnp.isfinite(square))
    carry = (square, jnp.zeros_like(square), is_valid)
    # The loop is unrolled for all sizes that the fused engine takes: the engine needs the
    # number `j` of a column before it runs.
    carry = jax.lax.fori_loop(0, n, with_column, carry, unroll=n <= 16)
    remainder, root, is_valid = carry
    is_valid = is_valid & jnp.all(jnp.abs(remainder) <= largest_remainder)
    return jnp.where(is_valid, root, jnp.nan)
