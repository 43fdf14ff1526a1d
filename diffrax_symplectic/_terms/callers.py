"""The functions of the user that terms and solvers hold, and their programs in their place.

The program of a function is a `Traced`: what the function computed when it was traced. It
is found again by what it computes, as the module `_programs` says.
"""

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
        """For each field that may hold a function of the user, by name, the inputs of the
        function in a solve of the state `y`. An input may be given by the shapes of its
        arrays."""


# The classes of what holds functions of the user and calls them, here called parts. Some
# parts can be called themselves, such as the `Drift` in an `ODETerm`.
_PARTS = AbstractCaller, diffrax.AbstractTerm, diffrax.AbstractSolver
# Terms for which `_inputs_of_functions` knows the fields that hold functions. Any other
# term is of a class of the user's.
_KNOWN_TERMS = (
    AbstractCaller,
    diffrax.ODETerm,
    diffrax.ControlTerm,
    diffrax.MultiTerm,
    diffrax.UnderdampedLangevinDiffusionTerm,
    diffrax.UnderdampedLangevinDriftTerm,
)


def with_programs(terms: _T, t: RealScalarLike, y: Y, args: Args) -> _T:
    """The terms, or a solver, with each function of the user replaced by its program.

    Functions that compute the same have equal programs. So what JAX has compiled for the
    returned terms also serves for other functions that compute the same.

    The terms are taken apart into parts, the objects that call functions of the user. The
    functions in the fields of a part are replaced. A term of a class of the user's, whose
    fields are not known, is replaced as a whole.

    Raises what the functions raise for a state like `y`. Also raises a `ValueError` if the
    terms are those of a Hamiltonian system, and `y` is not a pair `(p, q)`."""
    y = jtu.tree_map(jnp.asarray, y)
    t = jnp.asarray(t, jnp.result_type(*jtu.tree_leaves(y)))
    # What takes the place of each function, or term of the user's class, by the `id` of the
    # function or term. A function that several parts hold, such as the energy of a heat
    # bath, is traced once.
    programs: dict[int, Any] = {}
    for part in _parts(terms):
        if isinstance(part, AbstractCaller):
            check_pair(y)
        # A term of a class of the user's: its methods become programs.
        is_term = isinstance(part, diffrax.AbstractTerm)
        if is_term and not isinstance(part, _KNOWN_TERMS):
            control = eqx.filter_eval_shape(part.contr, t, t)
            programs[id(part)] = _TracedTerm(
                term=part,
                field=_traced_field(part.vf, t, y, args, identity=part),
                product=traced(part.vf_prod, t, y, args, control, identity=part),
            )
        # Any other part: the functions in its fields become programs. The value of a vector
        # field of a `ControlTerm` may be a Lineax operator, which takes another tracer.
        trace = _traced_field if isinstance(part, diffrax.ControlTerm) else traced
        for name, inputs in _inputs_of_functions(part, t, y, args).items():
            fn = getattr(part, name)
            # The field may hold a constant, such as a friction, or an inner part.
            is_function = callable(fn) and not isinstance(fn, _PARTS)
            if is_function and id(fn) not in programs:
                # `_call` adds advice to errors of the function while it is traced. The
                # program still belongs to the function itself, its `identity`.
                call = jtu.Partial(_call, name, fn)
                programs[id(fn)] = trace(call, *inputs, identity=fn)

    def is_replaced(x: Any) -> bool:
        return id(x) in programs

    return jtu.tree_map(lambda x: programs.get(id(x), x), terms, is_leaf=is_replaced)


def _parts(tree: PyTree) -> Iterator[Any]:
    """All parts of terms or of a solver, each before the parts within it."""

    def is_inner_part(x: Any) -> bool:
        return x is not tree and isinstance(x, _PARTS)

    if isinstance(tree, _PARTS):
        yield tree
    for leaf in jtu.tree_leaves(tree, is_leaf=is_inner_part):
        if is_inner_part(leaf):
            yield from _parts(leaf)


def _inputs_of_functions(
    part: Any, t: RealScalarLike, y: Y, args: Args
) -> dict[str, tuple[Any, ...]]:
    """For each field of a part that may hold a function of the user, by name, the inputs of
    the function. Empty if the part has no such field."""
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
    """The program of a vector field, whose value may be a Lineax operator. `identity` is
    that of `traced`."""
    # The shapes of the value.
    field = eqx.filter_eval_shape(fn, t, y, args)
    if not isinstance(field, lx.AbstractLinearOperator):
        return traced(fn, t, y, args, identity=identity)
    struct = field.in_structure()
    # A program only returns arrays, and an operator may hold a function. So the product of
    # the operator with a control is traced.
    product = jtu.Partial(_product, fn)
    program = traced(product, t, y, args, struct, identity=identity)
    return _OperatorField(program, struct)


def _product(fn: Callable, *inputs: Any) -> Y:
    """The operator `fn(t, y, args)` times the control, which is the last of the inputs."""
    *t_y_args, control = inputs
    return fn(*t_y_args).mv(control)


class _OperatorField(eqx.Module):
    """A vector field whose values are Lineax operators.

    - `product`: the program of the operator times a control.
    - `struct`: the shapes and dtypes of the control.
    """

    product: Traced
    struct: PyTree = eqx.field(static=True)

    def __call__(self, t: RealScalarLike, y: Y, args: Args):
        def product(control: PyTree[Array]) -> Y:
            return self.product(t, y, args, control)

        return lx.FunctionLinearOperator(product, self.struct)


class _TracedTerm(diffrax.AbstractTerm):
    """A term of a class of the user's, with programs of its methods.

    - `term`: the term itself, which gives the control.
    - `field`, `product`: the programs of its methods `vf` and `vf_prod`.
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
