"""Programs, found by what they compute.

JAX finds a program by the function that it was traced from, as an object. So a function
that reads a global keeps its value of the first call, and a new function of the same text
compiles anew. Here the user's functions are traced in each call of this package, and equal
traces are one object. To trace a Hamiltonian takes a millisecond, to compile an expectation
takes seconds.

- `traced`: the user's function as a `Traced`, by which JAX finds the programs that call it.
- `compiled`: `equinox.filter_jit`, which keeps a limited number of programs.
- `once_for_each_signature`: for functions that read no values of arrays.
- `current_traces`: for functions that call `diffrax.diffeqsolve` themselves.
- `digest`: what tells one computation from another, also in other processes.
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
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

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
    with_constants_at,
    with_traces_of,
)


# The most programs that are kept, each of up to 30 MB. A call of `expectation` needs up to
# ten. What is dropped is compiled again when it is needed again.
_MOST_PROGRAMS = 64
# The most calls that are compared. Functions that are made anew in each trace would add to
# them without end.
_MOST_CALLS = 64
# The most results that a function remembers. Each holds a signature.
_MOST_REMEMBERED = 128
# Numbers in the text of a function are data, so that others compile nothing, unless they
# have at most this many binary digits: those like 2, 1/2 and 12 belong to formulas, and XLA
# simplifies what is made with them.
_DIGITS_OF_FORMULAS = 2
# Operations whose second argument XLA should know: it makes products and roots of powers.
_KNOWN_SECOND = frozenset(["pow", "rem"])
# Complex matrices and vectors with axes of up to this length are multiplied entry by entry.
# On CPUs XLA calls a routine for each pair of them in a batch: the product of a 2 by 2
# matrix and a vector takes 160 to 290 ns for each path, and its sums 4 ns; of two 8 by 8
# matrices 440 to 530 and 220 to 310 ns.
_LONGEST_AXIS = 8

Result = TypeVar("Result")


class Traced(eqx.Module):
    """The user's function, as the program that it was when it was traced.

    - `program`: all of it but the values of arrays. Functions that compute the same have
        one and the same program.
    - `numbers`: the arrays that the function closes over or holds, and numbers in its text.
    """

    program: "_Program" = eqx.field(static=True)
    numbers: list[Array]

    def __call__(self, *inputs: PyTree) -> PyTree:
        """The value of the function. The inputs have the structure and shapes of those for
        which it was traced. What is no array in them is not read again."""
        return self.program.value(self.numbers, inputs)


def traced(fn: Callable, *inputs: PyTree, identity: Any = None) -> Traced:
    """The function as a program of inputs like these: arrays or their shapes, and what else
    it takes, which is then part of the program. A `Traced` is returned as it is.

    `identity` stands for code that a trace names, but does not contain, such as a callback
    or the rule of a custom derivative: programs with such code are the same only for the
    same `identity`. It is the user's function where `fn` is made anew around it in each
    call, and by default `fn`."""
    if isinstance(fn, Traced):
        return fn
    leaves, treedef = jtu.tree_flatten((fn, inputs))
    is_array = [
        eqx.is_array(leaf) or isinstance(leaf, jax.ShapeDtypeStruct) for leaf in leaves
    ]
    # Set by `results` while it is traced.
    static_results = None

    # JAX keeps traces by the identity of functions. This function is new in each call of
    # `traced`, so that it is always traced.
    def results(*arrays: Array) -> PyTree[Array]:
        nonlocal static_results
        remaining = iter(arrays)
        all_leaves = [
            next(remaining) if is_it else leaf for is_it, leaf in zip(is_array, leaves)
        ]
        fn_with_arrays, traced_inputs = treedef.unflatten(all_leaves)
        result = fn_with_arrays(*traced_inputs)
        dynamic, static_results = eqx.partition(result, eqx.is_array_like)
        return dynamic

    arrays = [leaf for is_it, leaf in zip(is_array, leaves) if is_it]
    make_jaxpr = jax.make_jaxpr(results, return_shape=True)
    closed_jaxpr, struct_of_result = make_jaxpr(*arrays)
    jaxpr = closed_jaxpr.jaxpr
    jaxpr = jaxpr.replace(eqns=[*map(_with_sums_of_products, jaxpr.eqns)])
    jaxpr, text_numbers = _numbers_apart(jaxpr)
    # The leaves of the function come before those of the inputs. It has some if it is a
    # Module, or a `jax.tree_util.Partial`.
    fn_leaves = jtu.tree_leaves(fn)
    fn_arrays = [leaf for leaf in fn_leaves if eqx.is_array(leaf)]
    is_input_array = is_array[len(fn_leaves) :]
    treedef_of_result = jtu.tree_structure(struct_of_result)
    program = _Program(jaxpr, is_input_array, treedef_of_result, static_results)
    # In the order of the constants and the first inputs of `jaxpr`.
    consts = map(jnp.asarray, closed_jaxpr.consts)
    numbers = [*consts, *text_numbers, *fn_arrays]
    return Traced(_interned(program, fn if identity is None else identity), numbers)


class _Program:
    """A function of arrays, hashed by identity.

    - `jaxpr`: its program. The constants and the first inputs are the `numbers` of a
        `Traced`.
    - `is_array`: which leaves of the inputs of the function are arrays.
    - `treedef`, `static`: the structure of what the function returns, and those of its
        leaves that are not arrays.
    - `fingerprint`: a hash of what it computes, the same in all processes; set by
        `_interned`.
    """

    def __init__(
        self, jaxpr: Jaxpr, is_array: list[bool], treedef: Any, static: PyTree
    ):
        self.jaxpr = jaxpr
        self.is_array = is_array
        self.treedef = treedef
        self.static = static
        self.fingerprint = ""

    # `digest` reads this, so that it must tell programs from each other in all processes.
    def __repr__(self) -> str:
        return self.fingerprint

    def value(self, numbers: list[Array], inputs: PyTree) -> PyTree:
        """The value of the function, for the numbers of its `Traced`."""
        leaves = jtu.tree_leaves(inputs)
        arrays = [x for x, is_it in zip(leaves, self.is_array, strict=True) if is_it]
        num_consts = len(self.jaxpr.constvars)
        args = [*numbers[num_consts:], *arrays]
        converted = [
            _with_dtype_of(variable.aval, x)
            for x, variable in zip(args, self.jaxpr.invars, strict=True)
        ]
        results = evaluated(self.jaxpr, numbers[:num_consts], converted)
        return eqx.combine(self.treedef.unflatten(results), self.static)


def _with_dtype_of(aval: Any, x: Any) -> Array | np.ndarray:
    # Times may be numbers of Python.
    has_dtype = eqx.is_array(x) and x.dtype == aval.dtype
    return x if has_dtype else jnp.asarray(x, aval.dtype)


def _with_sums_of_products(eqn: JaxprEqn) -> JaxprEqn:
    """The operation itself, or in place of a product of small complex arrays the sums that
    it consists of."""
    if eqn.primitive.name != "dot_general":
        return eqn
    arrays: list[Any] = [x.aval for x in eqn.invars]
    structs = [jax.ShapeDtypeStruct(x.shape, x.dtype) for x in arrays]
    axes = [size for struct in structs for size in struct.shape]
    is_complex = any(jnp.issubdtype(x.dtype, jnp.complexfloating) for x in structs)
    if not is_complex or max(axes, default=0) > _LONGEST_AXIS:
        return eqn
    [result] = eqn.outvars
    dtype = _dtype_of(result.aval)
    dimension_numbers = eqn.params["dimension_numbers"]
    sums = jax.jit(ft.partial(_sums_of_products, dimension_numbers, dtype))
    [call] = jax.make_jaxpr(sums)(*structs).jaxpr.eqns
    return eqn.replace(primitive=call.primitive, params=call.params)


def _sums_of_products(
    dimension_numbers: Any, dtype: Any, left: Array, right: Array
) -> Array:
    """`jax.lax.dot_general` with a result of this dtype, entry by entry."""
    (left_summed, right_summed), (left_batch, right_batch) = dimension_numbers
    num_batch = len(left_batch)
    num_summed = len(left_summed)

    def in_order(x: Array, batch: Sequence[int], summed: Sequence[int]) -> Array:
        """The array with its axes of the batch first, and those to be summed last."""
        others = [axis for axis in range(x.ndim) if axis not in (*batch, *summed)]
        return jnp.transpose(x, (*batch, *others, *summed))

    left = in_order(left, left_batch, left_summed)
    right = in_order(right, right_batch, right_summed)
    # The result has the axes of the batch, then the others on the left and on the right.
    end_of_left = left.ndim - num_summed
    num_right = right.ndim - num_batch - num_summed
    left = jnp.expand_dims(left, range(end_of_left, end_of_left + num_right))
    right = jnp.expand_dims(right, range(num_batch, end_of_left))
    summed_axes = tuple(range(-num_summed, 0))
    return jnp.sum(left.astype(dtype) * right, axis=summed_axes, dtype=dtype)


def _numbers_apart(jaxpr: Jaxpr) -> tuple[Jaxpr, list[Array]]:
    """The program with constants for numbers in its text, and these numbers."""
    jaxpr = jaxpr.replace(eqns=[*map(_with_inverse_of_divisor, jaxpr.eqns)])
    places = [
        OperandPlace(k, position)
        for k, eqn in enumerate(jaxpr.eqns)
        for position, x in enumerate(eqn.invars)
        if isinstance(x, Literal)
        and _has_many_digits(x)
        and not (position == 1 and eqn.primitive.name in _KNOWN_SECOND)
    ]
    numbers = [jaxpr.eqns[place.operation].invars[place.position] for place in places]
    # A function may return a number of its text, such as a constant friction. In the text
    # the number may be of a weak type, which takes the dtype of what it meets, and as data
    # it is not. So it is data only where it can meet no other dtype: its own is that of all
    # inputs.
    dtypes = {_dtype_of(x.aval) for x in jaxpr.invars}
    for position, x in enumerate(jaxpr.outvars):
        if not isinstance(x, Literal) or dtypes != {_dtype_of(x.aval)}:
            continue
        if _has_many_digits(x):
            places.append(OperandPlace(len(jaxpr.eqns), position))
            numbers.append(x)
    arrays = [jnp.asarray(x.val, x.aval.dtype) for x in numbers]  # pyright: ignore
    return with_constants_at(jaxpr, places), arrays


def _with_inverse_of_divisor(eqn: JaxprEqn) -> JaxprEqn:
    """The operation itself, or in place of a division by a number a product with its
    inverse, to which XLA turns it, too. Thus the number can be data at no cost."""
    if eqn.primitive.name != "div":
        return eqn
    dividend, divisor = eqn.invars
    if not isinstance(divisor, Literal):
        return eqn
    if not _has_many_digits(divisor):
        return eqn
    value = np.asarray(divisor.val)
    inverse = Literal(np.ones_like(value) / value, divisor.aval)
    product = _product(divisor.aval.dtype)  # pyright: ignore (of an array)
    return eqn.replace(
        primitive=product.primitive,
        params=product.params,
        invars=[dividend, inverse],
    )


@ft.cache
def _product(dtype: Any) -> JaxprEqn:
    """A product, as this version of JAX writes it."""
    struct = jax.ShapeDtypeStruct((), dtype)
    [eqn] = jax.make_jaxpr(jax.lax.mul)(struct, struct).jaxpr.eqns
    return eqn


def _has_many_digits(number: Literal) -> bool:
    """Whether a number is more likely the value of a parameter than part of a formula."""
    value = np.asarray(number.val)
    if not np.issubdtype(value.dtype, np.floating) or not np.isfinite(value):
        return False
    # A mantissa of few binary digits becomes a whole number by a product with a small power
    # of two.
    mantissa, _ = np.frexp(value.astype(float))
    scaled = float(mantissa) * 2**_DIGITS_OF_FORMULAS
    return scaled != round(scaled)


# From what a program computes to the program, for as long as anything uses it.
_known: weakref.WeakValueDictionary[Hashable, _Program] = weakref.WeakValueDictionary()
_lock = threading.Lock()


def _interned(program: _Program, identity: Any) -> _Program:
    """The program that was known before if it computes the same, and otherwise this one.
    `identity` is as for `traced`."""
    only_named: list[Any] = []
    description = (
        _description(program.jaxpr, only_named),
        tuple(program.is_array),
        program.treedef,
        static_part(program.static),
    )
    # What a custom derivative or a callback computes is named in a trace, not written out.
    # Then only the same function has the same program.
    key = description, static_part(identity) if only_named else None
    with _lock:
        known = _known.setdefault(key, program)
    if not known.fingerprint:
        known.fingerprint = _hash(_without_addresses(repr(description)))
    return known


def _description(jaxpr: Jaxpr, only_named: list[Any]) -> Hashable:
    """All that a program computes: equal for equal programs, since variables are numbered
    as they appear. What a trace names, but does not write out, such as callbacks, is
    appended to `only_named`."""
    number_of: dict[Any, int] = {}
    # By identity, since most operations share one context, whose text is long.
    contexts: dict[int, str] = {}

    def variable(x: Any) -> Hashable:
        if isinstance(x, Literal):
            return _type_of(x.aval), np.asarray(x.val).tobytes()
        return number_of.setdefault(x, len(number_of))

    inputs = [
        (variable(x), _type_of(x.aval)) for x in (*jaxpr.constvars, *jaxpr.invars)
    ]
    operations = []
    for eqn in jaxpr.eqns:
        context = contexts.setdefault(id(eqn.ctx), str(eqn.ctx))
        operands = tuple(map(variable, eqn.invars))
        results = tuple(map(variable, eqn.outvars))
        params = _description_of_value(eqn.params, only_named)
        operations.append((eqn.primitive, context, operands, params, results))
    outputs = tuple(map(variable, jaxpr.outvars))
    return tuple(inputs), tuple(operations), outputs


def _type_of(aval: Any) -> tuple[tuple[int, ...], str, bool]:
    """The shape, the dtype, and whether other dtypes prevail."""
    return aval.shape, str(aval.dtype), getattr(aval, "weak_type", False)


def _dtype_of(aval: Any) -> str:
    _, dtype, _ = _type_of(aval)
    return dtype


def _description_of_value(x: Any, only_named: list[Any]) -> Hashable:
    """A parameter of an operation, as in `_description`."""
    if is_program(x):
        # The arrays that a program within the function closes over are part of it.
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
        # Zeros of both signs are equal, and NaN is not equal to itself.
        return type(x), repr(x)
    if is_rule(x) or not _is_hashable(x):
        only_named.append(x)
        return type(x)
    return type(x), x


def _array_value(x: Array | np.ndarray | np.generic) -> Hashable:
    """The values of an array, with its shape and dtype."""
    words = x
    if isinstance(x, Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        words = jax.random.key_data(x)
    return x.shape, str(x.dtype), np.asarray(words).tobytes()


def _is_hashable(x: Any) -> bool:
    try:
        hash(x)
    except TypeError:
        return False
    return True


class _ByIdentity:
    """A value that is equal to itself only, whether or not it has a hash of its own."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: Any) -> bool:
        return isinstance(other, _ByIdentity) and self.value is other.value

    def __hash__(self) -> int:
        return id(self.value)


def static_part(tree: PyTree) -> Hashable:
    """A PyTree without the values of its arrays: their shapes and dtypes, and all else."""
    leaves, treedef = jtu.tree_flatten(tree)
    if not _is_hashable(treedef):
        return _ByIdentity(tree)
    return treedef, tuple(map(_static_leaf, leaves))


def _static_leaf(leaf: Any) -> Hashable:
    if eqx.is_array(leaf):
        # Traces tell JAX's arrays of weak types from others.
        return leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)
    if isinstance(leaf, types.MethodType) and not _is_hashable(leaf):
        return _ByIdentity(leaf.__self__), leaf.__func__
    # `1`, `1.0` and `True` are equal, but not the same input.
    return type(leaf), leaf if _is_hashable(leaf) else _ByIdentity(leaf)


class _Remembered:
    """Values by their keys. The `max_size` that were used last are kept."""

    def __init__(self, max_size: int):
        self._max_size = max_size
        self._values: collections.OrderedDict[Hashable, Any] = collections.OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: Hashable, make: Callable[[], Any]) -> Any:
        """The value of this key, from `make` if it is not there."""
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
    """`equinox.filter_jit(fn)` for functions that return arrays, which drops programs when
    many others were used since.

    With `quickly` they are compiled by XLA's older generator of code for CPUs, where this
    version of XLA has it. The program of a fit takes 2.6 to 5 s of processor time to
    compile by the newer generator, and 1.8 to 3.2 s by the older one. Both programs run at
    the same speed."""

    # Not by `eqx.filter_jit`, whose cache would keep the programs that are dropped here.
    options = quick_options() if quickly else {}

    @ft.wraps(fn)
    def call(*args: Any) -> Result:
        leaves, treedef = jtu.tree_flatten(args)
        is_array = [eqx.is_array(leaf) for leaf in leaves]
        arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
        others = [None if eqx.is_array(leaf) else leaf for leaf in leaves]

        def of_arrays(arrays: list[Array]) -> Result:
            remaining = iter(arrays)
            all_leaves = [
                next(remaining) if is_it else other
                for is_it, other in zip(is_array, others)
            ]
            return fn(*treedef.unflatten(all_leaves))

        jitted = ft.partial(jax.jit, of_arrays, compiler_options=options)
        key = fn, quickly, treedef, tuple(is_array), static_part(others)
        try:
            return _programs.get(key, jitted)(arrays)
        except ValueError as error:
            # So JAX refuses options of the compiler for a program inside of another, or one
            # that captures values of another. It has no class of errors for this.
            if "`compiler_options`" not in str(error):
                raise
        # There the options of the other program apply.
        without_options = compiled(fn)
        return without_options(*args)

    return call


# The user's functions that are called while a trace is made, with their inputs.
_calls: contextvars.ContextVar[dict[Hashable, tuple[Any, ...]] | None]
_calls = contextvars.ContextVar("calls", default=None)
_numbers_of_traces = itertools.count(1)


def note_call(fn: Callable, *inputs: PyTree) -> None:
    """Tells `current_traces` of a call of a function of the user, before the call."""
    calls = _calls.get()
    if calls is not None:
        structs = jtu.tree_map(_struct_of_array, inputs)
        calls.setdefault((_ByIdentity(fn), static_part(inputs)), (fn, *structs))


def _struct_of_array(x: Any) -> Any:
    return jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x


class _Watched(NamedTuple):
    """A trace that JAX may use again.

    - `number`: the argument of `with_traces_of` with which it was made.
    - `calls`: for each call of a function of the user in it, the arguments of `traced`, and
        the program that it was then.
    """

    number: int
    calls: list[tuple[tuple[Any, ...], Traced]]

    def is_current(self) -> bool:
        """Whether all functions still compute the same."""
        if len(self.calls) > _MOST_CALLS:
            return False
        return all(
            digest(traced(*call)) == digest(program) for call, program in self.calls
        )


_watched = _Remembered(_MOST_REMEMBERED)


@contextlib.contextmanager
def current_traces(fn: Callable) -> Iterator[None]:
    """A context in which to trace a function of the user that solves equations. JAX keeps
    traces of `diffrax.diffeqsolve` by the identity of the functions in its terms: they are
    used again while these functions compute the same, since they take a second to make."""
    key = static_part(fn)
    watched = _watched.get(key, lambda: None)
    if watched is None or not watched.is_current():
        # JAX has no traces of a new number, so it traces anew.
        watched = _Watched(next(_numbers_of_traces), [])
    calls: dict[Hashable, tuple[Any, ...]] = {}
    token = _calls.set(calls)
    try:
        with with_traces_of(watched.number):
            yield
    finally:
        _calls.reset(token)
    new_calls = []
    for call in calls.values():
        # A function that `fn` makes from values of its trace cannot be called after it, or
        # returns what depends on them. It need not be watched, since each trace makes
        # another one.
        try:
            program = traced(*call)
        except jax.errors.UnexpectedTracerError:
            continue
        if not any(map(is_traced, program.numbers)):
            new_calls.append((call, program))
    _watched.put(key, _Watched(watched.number, [*watched.calls, *new_calls]))


def once_for_each_signature(fn: Callable[..., Result]) -> Callable[..., Result]:
    """A function that reads no values of arrays in its arguments, and is called once for
    each structure, shapes and dtypes of these. Tracing anew takes longer than a short
    ensemble: the checks of shapes took 5 of 11 ms for 64 paths."""
    remembered = _Remembered(_MOST_REMEMBERED)

    @ft.wraps(fn)
    def call_once(*args: Any) -> Result:
        settings = jax.default_backend(), jnp.result_type(float)
        return remembered.get((static_part(args), settings), lambda: fn(*args))

    return call_once


def digest(tree: PyTree) -> str:
    """A hash of all values in a PyTree, the same in all processes with the same versions of
    packages. Functions that were not traced count by their names."""
    leaves, treedef = jtu.tree_flatten(tree)
    values = [_array_value(x) if eqx.is_array(x) else repr(x) for x in leaves]
    return _hash(_without_addresses(repr((treedef, values))))


def _without_addresses(text: str) -> str:
    return re.sub(r" at 0x[0-9a-f]+", "", text)


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
