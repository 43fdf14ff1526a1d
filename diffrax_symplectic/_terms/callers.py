"""The user's functions in terms, and terms with programs in their place."""

import abc
from collections.abc import Callable, Iterator
from typing import Any, TypeVar

import diffrax
import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
from jaxtyping import Array, PyTree

from .._arguments import check_pair
from .._custom_types import Args, RealScalarLike, Y
from .._programs import Traced, traced
from .evaluation import call_user_function


_T = TypeVar("_T")


class AbstractCaller(eqx.Module):
    """A part of the terms of a Hamiltonian system that calls functions of the user."""

    @abc.abstractmethod
    def called_with(
        self, t: RealScalarLike, y: Y, args: Args
    ) -> dict[str, tuple[Any, ...]]:
        """What a solve of the state `y` calls the functions in these fields with, in arrays
        or their shapes. A field may hold a constant in place of a function."""


# What holds functions of the user and calls them. These are no functions of the user
# themselves, also where they stand in place of one, such as a `Drift` in an `ODETerm`.
_PARTS = AbstractCaller, diffrax.AbstractTerm, diffrax.AbstractSolver
_KNOWN_TERMS = (
    AbstractCaller,
    diffrax.ODETerm,
    diffrax.ControlTerm,
    diffrax.MultiTerm,
    diffrax.UnderdampedLangevinDiffusionTerm,
    diffrax.UnderdampedLangevinDriftTerm,
)


def with_programs(terms: _T, t: RealScalarLike, y: Y, args: Args) -> _T:
    """The terms, or a solver, with each function of the user replaced by a program of what
    it computes now. Functions that compute the same have equal programs, so what JAX has
    compiled for the terms that are returned serves for all such functions. Raises what the
    functions raise for such a state, and a `ValueError` for a state that is no pair where
    the terms need one."""
    y = jtu.tree_map(jnp.asarray, y)
    t = jnp.asarray(t, jnp.result_type(*jtu.tree_leaves(y)))
    programs: dict[int, Any] = {}
    for part in _parts(terms):
        if isinstance(part, AbstractCaller):
            check_pair(y)
        is_term = isinstance(part, diffrax.AbstractTerm)
        if is_term and not isinstance(part, _KNOWN_TERMS):
            # A term of a class of the user's.
            control = eqx.filter_eval_shape(part.contr, t, t)
            programs[id(part)] = _TracedTerm(
                part,
                _traced_field(part.vf, t, y, args, identity=part),
                traced(part.vf_prod, t, y, args, control, identity=part),
            )
        trace = _traced_field if isinstance(part, diffrax.ControlTerm) else traced
        for name, inputs in _called_with(part, t, y, args).items():
            fn = getattr(part, name)
            # A function may stand in several places, as the energy of a heat bath does. It
            # is traced once.
            if callable(fn) and not isinstance(fn, _PARTS) and id(fn) not in programs:
                call = jtu.Partial(_call, name, fn)
                programs[id(fn)] = trace(call, *inputs, identity=fn)

    def is_replaced(x: Any) -> bool:
        return id(x) in programs

    return jtu.tree_map(lambda x: programs.get(id(x), x), terms, is_leaf=is_replaced)


def _parts(tree: PyTree) -> Iterator[Any]:
    """All parts of terms or of a solver, also those within others."""

    def is_inner_part(x: Any) -> bool:
        return x is not tree and isinstance(x, _PARTS)

    if isinstance(tree, _PARTS):
        yield tree
    for leaf in jtu.tree_leaves(tree, is_leaf=is_inner_part):
        if is_inner_part(leaf):
            yield from _parts(leaf)


def _called_with(
    part: Any, t: RealScalarLike, y: Y, args: Args
) -> dict[str, tuple[Any, ...]]:
    """As `AbstractCaller.called_with`, for any part."""
    if isinstance(part, AbstractCaller):
        return part.called_with(t, y, args)
    if isinstance(part, diffrax.ODETerm | diffrax.ControlTerm):
        return {"vector_field": (t, y, args)}
    if isinstance(part, diffrax.UnderdampedLangevinDriftTerm):
        x, _ = y
        return {"grad_f": (x, args)}
    if isinstance(part, diffrax.AbstractSolver) and hasattr(part, "flow"):
        return {"flow": (t, y, args)}
    return {}


def _call(name: str, fn: Callable, *inputs: Any) -> PyTree[Array]:
    """`fn(*inputs)` for the user's function of this name. The last input is `args`."""
    *others, args = inputs
    return call_user_function(name, fn, *others, args=args)


def _traced_field(
    fn: Callable, t: RealScalarLike, y: Y, args: Args, identity: Any
) -> Callable:
    """The program of a vector field that may return a Lineax operator."""
    field = eqx.filter_eval_shape(fn, t, y, args)
    if not isinstance(field, lx.AbstractLinearOperator):
        return traced(fn, t, y, args, identity=identity)
    struct = field.in_structure()

    # A program returns arrays alone, and an operator may hold a function. So the program is
    # that of the product of the operator with a control.
    product = jtu.Partial(_product, fn)
    return _OperatorField(
        traced(product, t, y, args, struct, identity=identity), struct
    )


def _product(fn: Callable, *inputs: Any) -> Y:
    """The operator `fn(t, y, args)` times the control, which is the last of the inputs."""
    *t_y_args, control = inputs
    return fn(*t_y_args).mv(control)


class _OperatorField(eqx.Module):
    """A vector field whose values are Lineax operators."""

    product: Traced
    struct: PyTree = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, y: Y, args: Args):
        def product(control: PyTree[Array]) -> Y:
            return self.product(t, y, args, control)

        return lx.FunctionLinearOperator(product, self.struct)


class _TracedTerm(diffrax.AbstractTerm):
    """A term of a class of the user's.

    - `term`: the term, which gives the control.
    - `field`, `product`: its methods `vf` and `vf_prod`.
    """

    term: diffrax.AbstractTerm
    field: Callable
    product: Traced

    def vf(self, t, y, args):
        return self.field(t, y, args)

    def contr(self, t0, t1, **kwargs):
        return self.term.contr(t0, t1, **kwargs)

    def prod(self, vf, control):
        return self.term.prod(vf, control)

    def vf_prod(self, t, y, args, control):
        return self.product(t, y, args, control)
