"""Vector fields times controls: of all terms, of the drift, of one noise."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, Float, PyTree

from .._brownian import num_noises, zeros_and_unravel
from .._compat import unwrapped, ω
from .._custom_types import Args, IntScalarLike, RealScalarLike, Terms, Y
from .._parts import parts_of
from .constrained_drift import without_constraint
from .drift_and_noise import control_struct, flattened
from .symplectic_gradients import HamiltonianNoise, OneNoise


# Under `jit` this function is traced and lowered once for several stages.
@eqx.filter_jit
def apply(terms: Terms, controls: list, args: Args, t: RealScalarLike, y: Y) -> Y:
    """The change of the state: the sum over terms of vector field times control. Raises a
    `ValueError` if the change does not have the dtypes and shapes of the state."""
    pairs = zip(terms, controls)
    changes = [term.vf_prod(t, y, args, control) for term, control in pairs]
    return _checked_sum(changes, y)


@eqx.filter_jit
def apply_one(
    terms: Terms,
    index: IntScalarLike,
    increment: Float[Array, ""],
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """The change of the state by one noise: its vector field times its increment.

    `index` is the number of this noise among the noises of all terms, in the order of their
    flattened controls. It may be traced. So every term is evaluated, and those without this
    noise get the increment zero."""
    changes = []
    # The number of noises of the terms before this one.
    num_before = 0
    for term in terms:
        num_in_term = num_noises(control_struct(term))
        is_in_term = (num_before <= index) & (index < num_before + num_in_term)
        index_in_term = jnp.clip(index - num_before, 0, num_in_term - 1)
        increment_or_zero = jnp.where(is_in_term, increment, 0)
        changes.append(_one_product(term, index_in_term, increment_or_zero, args, t, y))
        num_before += num_in_term
    return _checked_sum(changes, y)


def _one_product(
    term: diffrax.AbstractTerm,
    k: IntScalarLike,
    w: Array,
    args: Args,
    t: RealScalarLike,
    y: Y,
) -> Y:
    """The vector field of noise `k` of a term times the increment `w` of this noise.

    - Hamiltonians: only `H_k` is differentiated.
    - A `ControlTerm` whose field is an array with a last axis of noises: only the field of
        noise `k` is multiplied.
    - Any other term is called with the increments of all its noises, of which all but this
        one are zero.
    """
    # `unwrapped(term)` tells the class of the user's term. What is called is `term` itself:
    # Diffrax may have wrapped it to run backward in time.
    if isinstance(unwrapped(term), HamiltonianNoise):
        return term.vf_prod(t, y, args, OneNoise(index=k, increment=w))
    control = control_struct(term)
    if isinstance(unwrapped(term), diffrax.ControlTerm):
        field = term.vf(t, y, args)
        # The increments have shape `(m,)` and the field `(..., m)`. A scalar noise has no
        # such axis, and a PyTree or an operator of Lineax cannot be indexed.
        are_arrays = isinstance(control, jax.ShapeDtypeStruct) and eqx.is_array(field)
        if are_arrays and field.ndim > 0 and field.shape[-1:] == control.shape:
            return field[..., k] * w.astype(field.dtype)
    zeros, unravel = zeros_and_unravel(control)
    increments = zeros.at[k].set(w.astype(zeros.dtype))
    return term.vf_prod(t, y, args, unravel(increments))


def rate(drift: Terms, t: RealScalarLike, y: Y, args: Args) -> Y:
    """The rate of change of the state by the drift."""
    t = jnp.asarray(t, jnp.result_type(t, jnp.float32))
    # The control of a drift is the length of a step. With length one, the change of the
    # state is its rate.
    start = jnp.zeros_like(t)
    end = jnp.ones_like(t)
    controls = [term.contr(start, end) for term in drift]
    return apply(drift, controls, args, t, y)


def check_terms_fit_state(terms: PyTree, t0: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` unless `terms` are Diffrax terms that fit the state `y0`. (A
    PyTree of terms, as some solvers of Diffrax take, need not fit.)"""
    if not parts_of(diffrax.AbstractTerm, terms):
        raise ValueError(
            "`terms` must be Diffrax terms, such as `hamiltonian_terms(H0, noise, path)`"
            f"; got {type(terms).__name__}."
        )
    if not isinstance(terms, diffrax.AbstractTerm):
        return
    parts = tuple(flattened(without_constraint(terms)))
    # `apply` below would raise for these mistakes, too. This check comes first, since its
    # message names the term and its path.
    check_increments(parts, t0, y0, args)

    def total_change(t: RealScalarLike) -> Y:
        controls = [term.contr(t, t) for term in parts]
        return apply(parts, controls, args, t, y0)

    # Tracing is enough: `apply` raises if a term does not fit.
    eqx.filter_eval_shape(total_change, t0)


def check_increments(terms: Terms, t0: RealScalarLike, y0: Y, args: Args) -> None:
    """Raises a `ValueError` if a `ControlTerm` cannot multiply its vector field by the
    increments of its path. (The errors of JAX and Lineax name neither of the two.)"""

    def product(term: diffrax.AbstractTerm) -> Y:
        field = term.vf(t0, y0, args)
        increments = term.contr(t0, t0)
        try:
            return term.prod(field, increments)
        except (TypeError, ValueError) as error:
            raise ValueError(_misfit(field, increments, y0)) from error

    for term in terms:
        if isinstance(unwrapped(term), diffrax.ControlTerm):
            # Tracing is enough: `product` raises.
            eqx.filter_eval_shape(product, term)


def _misfit(field: PyTree, increments: PyTree[Array], y0: Y) -> str:
    """The message for a vector field that cannot be multiplied by the increments of its
    path: an operator, the arrays of a state of several arrays, or a single array."""
    fitting_path = "Construct the path with the shape and dtype that the field takes"
    if isinstance(field, lx.AbstractLinearOperator):
        description = f"a Lineax operator on {_shapes_and_dtypes(field.in_structure())}"
        advice = fitting_path
    elif len(jtu.tree_leaves(y0)) > 1:
        description = f"arrays {_shapes_and_dtypes(field)}"
        advice = (
            "Of a state of several arrays the vector field must be a Lineax operator, such "
            "as a `lineax.FunctionLinearOperator` that maps the increments to a change of "
            "the state"
        )
    else:
        description = f"an array {_shapes_and_dtypes(field)}"
        advice = f"{fitting_path}, for an array the shape of its last axes"
    return (
        f"A `ControlTerm` cannot multiply its vector field, {description}, by the "
        f"increments of its path, {_shapes_and_dtypes(increments)}. {advice}."
    )


def _shapes_and_dtypes(tree: PyTree) -> str:
    """The shapes and dtypes of arrays, for messages."""
    return eqx.tree_pformat(tree, struct_as_array=True)


def tree_sum(values: list[Y]) -> Y:
    """The sum of PyTrees of the same structure, at least one."""
    total, *others = values
    for value in others:
        total = (total**ω + value**ω).ω
    return total


def _checked_sum(changes: list[Y], y: Y) -> Y:
    """The sum of at least one change of the state `y`. Raises a `ValueError` unless each
    change has the dtypes and shapes of the state. For another structure JAX raises one."""

    def check(change: Any, x: Any) -> None:
        # Both may be numbers of Python, which have no dtype. (`jnp.result_type` would not
        # do: for a weakly typed array it is the default dtype, not that of the array.)
        change = jnp.asarray(change)
        x = jnp.asarray(x)
        if (change.dtype, change.shape) != (x.dtype, x.shape):
            raise ValueError(
                f"The terms change an array of dtype and shape {x.dtype}{x.shape} by one "
                f"of {change.dtype}{change.shape}. Give the state, the vector fields and "
                "the path (as `shape=jax.ShapeDtypeStruct(shape, dtype)`) the same dtype, "
                "and times a dtype that is not wider."
            )

    for change in changes:
        jtu.tree_map(check, change, y)
    return tree_sum(changes)
