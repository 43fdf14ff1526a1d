"""Programs, found by what they compute.

JAX finds a compiled program by the identity of the function that was traced. So a function
that reads a global keeps the value of the first call, and a function that is defined again
compiles anew. Here the user's functions are traced in each call of this package, and equal
traces become one object, by which JAX finds the compiled program. To trace a Hamiltonian
takes a millisecond, to compile an expectation takes seconds.

- `traced`: traces a function of the user.
- `compiled`: as `equinox.filter_jit`, with a limited number of programs.
- `once_for_each_signature`: calls a function that reads no values of arrays only once.
- `current_traces`: traces a function of the user that calls `diffrax.diffeqsolve`.
- `digest`: a hash of a computation, which is the same in other processes.
"""

import collections
import contextlib
import contextvars
import functools as ft
import hashlib
import itertools
import re
import threading
import types
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias, TypeGuard, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PyTree

from ._compat import (
    ClosedJaxpr,
    evaluated,
    is_program,
    is_rule,
    is_traced,
    Jaxpr,
    JaxprEqn,
    Literal,
    OperandPlace,
    quick_options,
    RESULTS,
    with_constants_at,
    with_traces_of,
)


# The most compiled programs that are kept, each of up to 30 MB. A call of `expectation`
# needs up to ten. A program that was dropped is compiled again when it is needed again.
_MOST_PROGRAMS = 64
# The most calls of the user's functions that `current_traces` compares. A function that is
# made anew in each trace adds a call each time, without end.
_MOST_CALLS = 64
# The most results that `once_for_each_signature` keeps for a function, and the most
# functions of which `current_traces` keeps the calls.
_MOST_REMEMBERED = 128
# A literal is a Python number in a trace, such as 0.7 for `0.7 * x`. Most literals are the
# values of parameters. They become inputs of the program, so that another value does not
# compile anew. Literals of at most this many binary digits stay in the program: numbers
# such as 2, 1/2 and 12 belong to formulas, and XLA simplifies operations with them.
_DIGITS_OF_FORMULAS = 2
# In these operations a literal as the second argument stays in the program, too: XLA turns
# powers with a known exponent into products and roots.
_KNOWN_SECOND = frozenset(["pow", "rem"])
# Complex matrices and vectors with axes of up to this length are multiplied entry by entry.
# On CPUs XLA calls a routine for each pair of them in a batch. For each path the routine
# takes 160 to 290 ns for a 2 by 2 matrix and a vector, and 440 to 530 ns for two 8 by 8
# matrices. Entry by entry the products take 4 ns and 220 to 310 ns.
_LONGEST_AXIS = 8

Result = TypeVar("Result")


class Traced(eqx.Module):
    """A function of the user, as it was when it was traced.

    - `program`: the function without the values of its arrays. Functions that compute the
        same have one and the same program.
    - `numbers`: the values, in the order that `_Program` states.
    """

    program: "_Program" = eqx.field(static=True)
    numbers: list[Array]

    def __call__(self, *inputs: PyTree) -> PyTree:
        """The value of the function. The inputs have the structure and shapes of those for
        which it was traced. Their leaves that are not arrays are not read: the program
        contains those for which it was traced."""
        return self.program.value(self.numbers, inputs)


def traced(fn: Callable, *inputs: PyTree, identity: Any = None) -> Traced:
    """Traces the function for inputs like these. Leaves of the inputs are arrays, instances
    of `jax.ShapeDtypeStruct` in their place, or anything else, which becomes part of the
    program. A `Traced` is returned as it is.

    The trace is not kept as it is: products of small complex arrays become sums, and
    literals that are likely the values of parameters become constants.

    A trace names some code without containing it: callbacks, and rules of custom
    derivatives. Programs with such code are the same only for the same `identity`, by
    default `fn`. If `fn` is made anew in each call, around a function of the user, pass the
    function of the user as `identity`."""
    if isinstance(fn, Traced):
        return fn
    leaves, treedef = jtu.tree_flatten((fn, inputs))
    # Both lists are as long as `leaves`, with `None` for the leaves in the other list.
    array_leaves, other_leaves = eqx.partition(leaves, _is_array_or_struct)
    # What `fn` returns beside arrays, which a trace cannot return. Set by `of_arrays`.
    static_results = None

    # JAX keeps traces by the identity of functions. This function is new in each call of
    # `traced`, so that it is always traced.
    def of_arrays(arrays: list[Array | None]) -> PyTree:
        nonlocal static_results
        all_leaves = eqx.combine(arrays, other_leaves)
        fn_with_arrays, traced_inputs = treedef.unflatten(all_leaves)
        result = fn_with_arrays(*traced_inputs)
        dynamic_results, static_results = eqx.partition(result, eqx.is_array_like)
        return dynamic_results

    closed_jaxpr, struct = jax.make_jaxpr(of_arrays, return_shape=True)(array_leaves)
    jaxpr = closed_jaxpr.jaxpr
    jaxpr = jaxpr.replace(eqns=[*map(_with_sums_of_products, jaxpr.eqns)])
    jaxpr, literals = _with_literals_as_constants(jaxpr)
    # The leaves of `fn` come before the leaves of the inputs.
    num_fn_leaves = len(jtu.tree_leaves(fn))
    fn_arrays = [x for x in array_leaves[:num_fn_leaves] if x is not None]
    program = _Program(
        jaxpr,
        is_array=[x is not None for x in array_leaves[num_fn_leaves:]],
        result_treedef=jtu.tree_structure(struct),
        static_results=static_results,
    )
    numbers = [*map(jnp.asarray, closed_jaxpr.consts), *literals, *fn_arrays]
    return Traced(_interned(program, fn if identity is None else identity), numbers)


def _is_array_or_struct(x: Any) -> bool:
    return eqx.is_array(x) or isinstance(x, jax.ShapeDtypeStruct)


class _Program:
    """A function of arrays, hashed by identity. Its arrays are, in this order:

    1. the constants of the trace: arrays that the user's function closes over;
    2. literals of the trace that were made constants;
    3. arrays that the user's function holds, if it is a Module or a `jtu.Partial`;
    4. arrays among the inputs of the user's function.

    The `numbers` of a `Traced` are the first three.

    - `jaxpr`: takes 1 and 2 as constants, 3 and 4 as inputs.
    - `is_array`: which leaves of the inputs of the user's function are arrays.
    - `result_treedef`, `static_results`: the structure of what the user's function returns,
        and the leaves of it that are not arrays.
    - `fingerprint`: a hash of what it computes, the same in all processes; set by
        `_interned`.
    """

    def __init__(
        self,
        jaxpr: Jaxpr,
        is_array: list[bool],
        result_treedef: Any,
        static_results: PyTree,
    ):
        self.jaxpr = jaxpr
        self.is_array = is_array
        self.result_treedef = result_treedef
        self.static_results = static_results
        self.fingerprint = ""

    # `digest` reads this, so that it must tell programs from each other in all processes.
    def __repr__(self) -> str:
        return self.fingerprint

    def value(self, numbers: list[Array], inputs: PyTree) -> PyTree:
        """The value of the user's function, for the `numbers` of its `Traced`."""
        leaves = jtu.tree_leaves(inputs)
        arrays = [x for x, is_it in zip(leaves, self.is_array, strict=True) if is_it]
        # The constants of the trace come before the arrays of the function.
        num_consts = len(self.jaxpr.constvars)
        args = [*numbers[num_consts:], *arrays]
        converted = [
            _with_dtype_of(variable.aval, x)
            for x, variable in zip(args, self.jaxpr.invars, strict=True)
        ]
        results = evaluated(self.jaxpr, numbers[:num_consts], converted)
        return eqx.combine(self.result_treedef.unflatten(results), self.static_results)


def _with_dtype_of(aval: Any, x: Any) -> Array | np.ndarray:
    """`x` as an array of the dtype of `aval`. Times may be numbers of Python."""
    has_dtype = eqx.is_array(x) and x.dtype == aval.dtype
    return x if has_dtype else jnp.asarray(x, aval.dtype)


def _with_sums_of_products(eqn: JaxprEqn) -> JaxprEqn:
    """The operation, or in place of a product of small complex arrays, a call of a function
    that adds up the products of their entries. `_LONGEST_AXIS` says what that saves."""
    if eqn.primitive.name != "dot_general":
        return eqn
    avals: list[Any] = [x.aval for x in eqn.invars]
    structs = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in avals]
    axes = [size for struct in structs for size in struct.shape]
    is_complex = any(jnp.issubdtype(x.dtype, jnp.complexfloating) for x in structs)
    if not is_complex or max(axes, default=0) > _LONGEST_AXIS:
        return eqn
    [result] = eqn.outvars
    dtype = _dtype_of(result.aval)
    dimension_numbers = eqn.params["dimension_numbers"]
    sums = jax.jit(ft.partial(_sums_of_products, dimension_numbers, dtype))
    # The trace of a function with `jit` is one operation, which calls it.
    [call] = jax.make_jaxpr(sums)(*structs).jaxpr.eqns
    return eqn.replace(primitive=call.primitive, params=call.params)


def _sums_of_products(
    dimension_numbers: Any, dtype: Any, left: Array, right: Array
) -> Array:
    """The result of `jax.lax.dot_general` in this dtype, as sums of products of entries.

    Both factors get the same four groups of axes: those of the batch, those that only the
    left factor has, those that only the right factor has, and those to be summed. Axes that
    a factor lacks have length one. Then the factors are multiplied and summed."""
    (left_summed, right_summed), (left_batch, right_batch) = dimension_numbers
    num_batch = len(left_batch)
    num_summed = len(left_summed)

    def in_order(x: Array, batch: Sequence[int], summed: Sequence[int]) -> Array:
        """The array with its axes of the batch first, and those to be summed last."""
        others = [axis for axis in range(x.ndim) if axis not in (*batch, *summed)]
        return jnp.transpose(x, (*batch, *others, *summed))

    left = in_order(left, left_batch, left_summed)
    right = in_order(right, right_batch, right_summed)
    end_of_left = left.ndim - num_summed
    num_right = right.ndim - num_batch - num_summed
    left = jnp.expand_dims(left, range(end_of_left, end_of_left + num_right))
    right = jnp.expand_dims(right, range(num_batch, end_of_left))
    summed_axes = tuple(range(-num_summed, 0))
    return jnp.sum(left.astype(dtype) * right, axis=summed_axes, dtype=dtype)


def _with_literals_as_constants(jaxpr: Jaxpr) -> tuple[Jaxpr, list[Array]]:
    """The program with new constants in place of the literals that are likely the values of
    parameters, and the values of these constants."""
    jaxpr = jaxpr.replace(eqns=[*map(_with_inverse_of_divisor, jaxpr.eqns)])
    # Where the program reads these literals.
    places = [*_parameters_in_operations(jaxpr), *_parameters_in_results(jaxpr)]
    jaxpr, literals = with_constants_at(jaxpr, places)
    return jaxpr, [jnp.asarray(x.val, x.aval.dtype) for x in literals]


def _parameters_in_operations(jaxpr: Jaxpr) -> list[OperandPlace]:
    """Where operations read literals that are likely the values of parameters."""
    places = []
    for operation, eqn in enumerate(jaxpr.eqns):
        for position, x in enumerate(eqn.invars):
            stays_literal = position == 1 and eqn.primitive.name in _KNOWN_SECOND
            if _is_parameter(x) and not stays_literal:
                places.append(OperandPlace(operation, position))
    return places


def _parameters_in_results(jaxpr: Jaxpr) -> list[OperandPlace]:
    """Where the program returns literals that are likely the values of parameters, such as
    a constant friction."""
    # A literal such as 0.7 may have a weak type: its product with a float32 array has
    # float32. A constant has no weak type: if it has float64, so has the product. Therefore
    # the literal becomes a constant only if all inputs have its dtype.
    input_dtypes = {_dtype_of(x.aval) for x in jaxpr.invars}
    return [
        OperandPlace(RESULTS, position)
        for position, x in enumerate(jaxpr.outvars)
        if _is_parameter(x) and input_dtypes == {_dtype_of(x.aval)}
    ]


def _with_inverse_of_divisor(eqn: JaxprEqn) -> JaxprEqn:
    """The operation, or in place of a division by the value of a parameter, the product
    with its inverse. XLA itself does this for a known divisor. So the division costs no
    more when the divisor becomes an input of the program."""
    if eqn.primitive.name != "div":
        return eqn
    dividend, divisor = eqn.invars
    if not _is_parameter(divisor):
        return eqn
    value = np.asarray(divisor.val)
    inverse = Literal(np.ones_like(value) / value, divisor.aval)
    product = _product(_dtype_of(divisor.aval))
    return eqn.replace(
        primitive=product.primitive,
        params=product.params,
        invars=[dividend, inverse],
    )


@ft.cache
def _product(dtype: str) -> JaxprEqn:
    """The operation that multiplies two numbers, from this version of JAX."""
    struct = jax.ShapeDtypeStruct((), dtype)
    [eqn] = jax.make_jaxpr(jax.lax.mul)(struct, struct).jaxpr.eqns
    return eqn


def _is_parameter(x: Any) -> TypeGuard[Literal]:
    """Whether an operand is a literal that is more likely the value of a parameter than
    part of a formula."""
    if not isinstance(x, Literal):
        return False
    value = np.asarray(x.val)
    if not np.issubdtype(value.dtype, np.floating) or not np.isfinite(value):
        return False
    # The mantissa is 0.1... in binary digits. If it has no more than `_DIGITS_OF_FORMULAS`
    # of them, it becomes a whole number when it is scaled by two to this power.
    mantissa, _ = np.frexp(value.astype(float))
    scaled = float(mantissa) * 2**_DIGITS_OF_FORMULAS
    return scaled != round(scaled)


# All programs in use, by what they compute.
_known: weakref.WeakValueDictionary[Hashable, _Program] = weakref.WeakValueDictionary()
_lock = threading.Lock()


def _interned(program: _Program, identity: Any) -> _Program:
    """The known program that computes the same as this one. If there is none, this one is
    returned, and known from now on. `identity` is as for `traced`."""
    # Code that the program names without containing it, added by `_description`.
    only_named: list[Any] = []
    description = (
        _description(program.jaxpr, only_named),
        tuple(program.is_array),
        program.result_treedef,
        static_part(program.static_results),
    )
    # Code that is only named cannot be compared. If there is any, only the same `identity`
    # has the same program.
    key = description, static_part(identity) if only_named else None
    with _lock:
        known = _known.setdefault(key, program)
    if not known.fingerprint:
        known.fingerprint = _hash(_without_addresses(repr(description)))
    return known


def _description(jaxpr: Jaxpr, only_named: list[Any]) -> Hashable:
    """All that a program computes, as a key: its inputs, operations and outputs. Equal
    programs have equal descriptions, since variables are numbered in the order in which
    they appear. Code that the program names without containing it, such as a callback, is
    appended to `only_named`."""
    number_of: dict[Any, int] = {}
    # The text of each context by its identity. A context holds JAX's settings for an
    # operation. Its text is long, and most operations share one context.
    contexts: dict[int, str] = {}

    def described(x: Any) -> Hashable:
        """The value of a literal, or the number of a variable."""
        if isinstance(x, Literal):
            return _type_of(x.aval), np.asarray(x.val).tobytes()
        return number_of.setdefault(x, len(number_of))

    inputs = [
        (described(x), _type_of(x.aval)) for x in (*jaxpr.constvars, *jaxpr.invars)
    ]
    operations = []
    for eqn in jaxpr.eqns:
        if id(eqn.ctx) not in contexts:
            contexts[id(eqn.ctx)] = str(eqn.ctx)
        context = contexts[id(eqn.ctx)]
        operands = tuple(map(described, eqn.invars))
        results = tuple(map(described, eqn.outvars))
        params = _description_of_value(eqn.params, only_named)
        operations.append((eqn.primitive, context, operands, params, results))
    outputs = tuple(map(described, jaxpr.outvars))
    return tuple(inputs), tuple(operations), outputs


def _type_of(aval: Any) -> tuple[tuple[int, ...], str, bool]:
    """The shape, the dtype, and whether the type is weak."""
    return aval.shape, str(aval.dtype), getattr(aval, "weak_type", False)


def _dtype_of(aval: Any) -> str:
    _, dtype, _ = _type_of(aval)
    return dtype


def _description_of_value(x: Any, only_named: list[Any]) -> Hashable:
    """The value of a parameter of an operation, or a part of one, as a part of
    `_description`."""
    if is_program(x):
        # Arrays that an inner program closes over are part of the description.
        consts = x.consts if isinstance(x, ClosedJaxpr) else ()
        values = tuple(_description_of_value(const, only_named) for const in consts)
        jaxpr: Any = x.jaxpr if isinstance(x, ClosedJaxpr) else x
        return values, _description(jaxpr, only_named)
    if isinstance(x, Mapping):
        return tuple(
            (name, _description_of_value(x[name], only_named)) for name in sorted(x)
        )
    if isinstance(x, tuple | list):
        return type(x), tuple(_description_of_value(item, only_named) for item in x)
    if eqx.is_array(x):
        return _array_value(x)
    if isinstance(x, float | complex):
        # As text, since zeros of both signs are equal, and NaN is not equal to itself.
        return type(x), repr(x)
    # Functions, and values without a hash, cannot be compared. They count by their type.
    if is_rule(x) or not _is_hashable(x):
        only_named.append(x)
        return type(x)
    return type(x), x


def _array_value(x: Array | np.ndarray | np.generic) -> Hashable:
    """The values of an array, with its shape and dtype."""
    values = x
    # NumPy cannot read random keys.
    if isinstance(x, Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        values = jax.random.key_data(x)
    return x.shape, str(x.dtype), np.asarray(values).tobytes()


def _is_hashable(x: Any) -> bool:
    try:
        hash(x)
    except TypeError:
        return False
    return True


class _ByIdentity:
    """A value that is equal to itself only. It need not have a hash."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _ByIdentity) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def static_part(tree: PyTree) -> Hashable:
    """A key for a PyTree: its structure, the shapes and dtypes of its arrays, but not their
    values, and its other leaves."""
    leaves, treedef = jtu.tree_flatten(tree)
    if not _is_hashable(treedef):
        return _ByIdentity(tree)
    return treedef, tuple(map(_static_leaf, leaves))


def _static_leaf(leaf: Any) -> Hashable:
    """The part of `static_part` for one leaf."""
    if eqx.is_array(leaf):
        # Arrays of NumPy have no weak types.
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)
    # A bound method has no hash if its object has none, such as a Module with arrays.
    if isinstance(leaf, types.MethodType) and not _is_hashable(leaf):
        return _ByIdentity(leaf.__self__), leaf.__func__
    # `1`, `1.0` and `True` are equal, but not the same input.
    return type(leaf), leaf if _is_hashable(leaf) else _ByIdentity(leaf)


class _Remembered:
    """A cache, which keeps the `max_size` values that were used last."""

    def __init__(self, max_size: int):
        self._max_size = max_size
        self._values: collections.OrderedDict[Hashable, Any] = collections.OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value of this key. If there is none, `make` makes it."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
        # If this raises an error, nothing is remembered.
        value = make()
        self.put(key, value)
        return value

    def put(self, key: Hashable, value: Any) -> None:
        with self._lock:
            self._values[key] = value
            self._values.move_to_end(key)
            if len(self._values) > self._max_size:
                self._values.popitem(last=False)


_programs = _Remembered(_MOST_PROGRAMS)


def compiled(fn: Callable[..., Result], quickly: bool = False) -> Callable[..., Result]:
    """The function, compiled, as by `equinox.filter_jit(fn)`, for functions that return
    arrays. The cache of `filter_jit` keeps all programs. Here only the `_MOST_PROGRAMS`
    that were used last are kept, for all functions together.

    With `quickly`, XLA's older generator of code for CPUs compiles them, where this version
    of XLA has it. The program of a fit takes 2.6 to 5 s of processor time to compile by the
    newer generator, and 1.8 to 3.2 s by the older one. Both programs run at the same
    speed."""

    options = quick_options() if quickly else {}

    @ft.wraps(fn)
    def call(*args: Any) -> Result:
        leaves, treedef = jtu.tree_flatten(args)
        # Both lists are as long as `leaves`, with `None` for the leaves in the other list.
        array_leaves, other_leaves = eqx.partition(leaves, eqx.is_array)

        def of_arrays(arrays: list[Array | None]) -> Result:
            return fn(*treedef.unflatten(eqx.combine(arrays, other_leaves)))

        make_jitted = ft.partial(jax.jit, of_arrays, compiler_options=options)
        key = fn, quickly, treedef, static_part(other_leaves)
        try:
            return _programs.get(key, make_jitted)(array_leaves)
        except ValueError as error:
            # JAX refuses options of the compiler for a program inside of another, or one
            # that captures values of another. It has no class of errors for this.
            if "`compiler_options`" not in str(error):
                raise
        # Inside of another program, the options of the other program apply.
        without_options = compiled(fn)
        return without_options(*args)

    return call


# A function of the user and its inputs, as the arguments of `traced`.
_Call: TypeAlias = tuple[Any, ...]
# The calls inside a context of `current_traces`; outside of such contexts `None`.
_calls: contextvars.ContextVar[dict[Hashable, _Call] | None]
_calls = contextvars.ContextVar("calls", default=None)
_new_numbers = itertools.count(1)


def note_call(fn: Callable, *inputs: PyTree) -> None:
    """Tells `current_traces` of a call of a function of the user, before the call."""
    calls = _calls.get()
    if calls is not None:
        structs = jtu.tree_map(_struct_of_array, inputs)
        calls.setdefault((_ByIdentity(fn), static_part(inputs)), (fn, *structs))


def _struct_of_array(x: Any) -> Any:
    return jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x


class _NumberedTraces(NamedTuple):
    """Traces that JAX keeps, and what shows whether they are still right.

    - `number`: the number of the contexts that the traces were made in, for
        `with_traces_of`. JAX uses a trace again only in a context of the same number.
    - `calls`: the calls of the user's functions in these traces, each with a trace of the
        function as it was then.
    """

    number: int
    calls: list[tuple[_Call, Traced]]

    def are_current(self) -> bool:
        """Whether the user's functions still compute the same. The answer is `False` if
        there are too many calls to find out."""
        if len(self.calls) > _MOST_CALLS:
            return False
        return all(digest(traced(*call)) == digest(then) for call, then in self.calls)


# For each function that was passed to `current_traces`.
_numbered_traces = _Remembered(_MOST_REMEMBERED)


@contextlib.contextmanager
def current_traces(fn: Callable) -> Iterator[None]:
    """A context in which to trace `fn`, a function of the user that solves equations.

    JAX keeps the traces of `diffrax.diffeqsolve` by the identity of the functions in its
    terms, and uses them again even if these functions compute something else by then. A
    trace takes a second to make, so it should be used again while nothing has changed:

    1. The context has a number. JAX uses only traces from contexts of the same number.
    2. Inside the context, `note_call` records the user's functions that are called.
    3. At the end, each of these functions is traced alone, and stored with the number.
    4. The next context for `fn` traces these functions again. If they compute the same, it
        has the same number. Otherwise it has a new one, for which JAX has no traces."""
    key = static_part(fn)
    traces = _numbered_traces.get(key, lambda: None)
    if traces is None or not traces.are_current():
        traces = _NumberedTraces(number=next(_new_numbers), calls=[])
    calls: dict[Hashable, _Call] = {}
    token = _calls.set(calls)
    try:
        with with_traces_of(traces.number):
            yield
    finally:
        _calls.reset(token)
    # Functions in a trace that JAX used again were not called this time. So the calls from
    # earlier contexts are kept.
    all_calls = [*traces.calls, *_traced_now(calls.values())]
    _numbered_traces.put(key, _NumberedTraces(traces.number, all_calls))


def _traced_now(calls: Iterable[_Call]) -> Iterator[tuple[_Call, Traced]]:
    """The calls that can be made again later, each with a trace of its function as it is
    now.

    The function that `current_traces` is for may make others, from values of its trace.
    They fail after the trace, or depend on these values. They are left out, since each
    trace makes others."""
    for call in calls:
        try:
            now = traced(*call)
        except jax.errors.UnexpectedTracerError:
            continue
        if not any(map(is_traced, now.numbers)):
            yield call, now


def once_for_each_signature(fn: Callable[..., Result]) -> Callable[..., Result]:
    """Decorates a function whose result does not depend on the values of arrays in its
    arguments. The function is called once for each structure, shapes and dtypes of the
    arguments, and its result is remembered. To trace anew takes longer than a short
    ensemble: the checks of shapes took 5 of 11 ms for 64 paths."""
    remembered = _Remembered(_MOST_REMEMBERED)

    @ft.wraps(fn)
    def call_once(*args: Any) -> Result:
        # The result may depend on the device and on whether numbers have 64 bits.
        settings = jax.default_backend(), jnp.result_type(float)
        return remembered.get((static_part(args), settings), lambda: fn(*args))

    return call_once


def digest(tree: PyTree) -> str:
    """A hash of all values in a PyTree, the same in all processes with the same versions of
    packages. Functions count by their names, unless they are in a `Traced`."""
    leaves, treedef = jtu.tree_flatten(tree)
    values = [_array_value(x) if eqx.is_array(x) else repr(x) for x in leaves]
    return _hash(_without_addresses(repr((treedef, values))))


def _without_addresses(text: str) -> str:
    """The text without addresses of objects, which differ between processes."""
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
