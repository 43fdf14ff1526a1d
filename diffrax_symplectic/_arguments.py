"""Checks of arguments: functions, numbers, solvers, states."""

import inspect
import math
import os
from collections.abc import Hashable, Iterator
from traceback import extract_tb
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import ArrayLike, PyTree

from ._compat import is_traced
from ._custom_types import Y


_PACKAGE = os.path.dirname(__file__) + os.sep
# Pairs of names of arguments that show that a function takes positions first, and momenta
# or velocities second.
_POSITIONS_FIRST = (("x", "v"), ("x", "p"), ("q", "v"))


class ShortTraceback:
    """A context that shortens the traceback of a `ValueError` that this package raises: it
    drops the frames between the function that the user called and the check. Errors from
    the user's functions keep all frames, and so do all errors with
    `jax.config.update("jax_traceback_filtering", "off")`."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: Any, traceback: Any) -> None:
        shows_all_frames = jax.config.jax_traceback_filtering == "off"  # pyright: ignore
        if not isinstance(error, ValueError) or shows_all_frames:
            return
        # The last frame is that of the line that raised the error. The first frame is that
        # of the function whose code is in this context. Only the first frame is kept.
        if extract_tb(traceback)[-1].filename.startswith(_PACKAGE):
            traceback.tb_next = None


def check_takes(name: str, fn: Any, *arguments: str) -> None:
    """Raises a `ValueError` unless `fn`, the argument of this name of a function of this
    package, can be called with these `arguments` by position. They are the names that the
    documentation uses, such as `"t", "p", "q", "args"`. Refused are

    - anything that is no function;
    - a function of fewer arguments, or with more that have no default;
    - a function whose parameters have these names in another order, such as `H(t, q, p)`.
    """
    usage = f"`{name}({', '.join(arguments)})`"
    if not callable(fn):
        raise ValueError(f"`{name}` must be a function, called as {usage}; got {fn!r}.")
    try:
        signature = inspect.signature(fn)
    except ValueError:
        # Some functions written in C have no signature.
        return
    try:
        signature.bind(*arguments)
    except TypeError:
        raise ValueError(
            f"`{name}` is called as {usage}; got a function with other arguments, "
            f"`{signature}`."
        ) from None
    if _has_other_order(signature, arguments):
        raise ValueError(
            f"`{name}` is called as {usage}; got a function with its arguments in another "
            f"order, `{signature}`."
        )


def _has_other_order(signature: inspect.Signature, arguments: tuple[str, ...]) -> bool:
    """Whether the names of a function's parameters show that it takes the arguments in
    another order. Shapes would not show it, since momenta and positions are alike."""
    by_position = (
        inspect.Parameter.POSITIONAL_ONLY,
        inspect.Parameter.POSITIONAL_OR_KEYWORD,
    )
    names = [
        parameter.name
        for parameter in signature.parameters.values()
        if parameter.kind in by_position
    ]
    # A parameter may have any name, such as `momenta` for `p`. But if it has the name of
    # another argument, the order is wrong.
    is_any_misplaced = any(
        name in arguments and name != argument
        for name, argument in zip(names, arguments)
    )
    # The first argument is the time.
    takes_momenta_first = arguments[1:3] == ("p", "q")
    has_positions_first = tuple(names[1:3]) in _POSITIONS_FIRST
    return is_any_misplaced or (takes_momenta_first and has_positions_first)


def takes_args(fn: Any) -> bool:
    """Whether a function is to be called as `fn(key, args)`, and not as `fn(key)`. It is if
    it has a parameter named `args`, or two parameters without a default."""
    try:
        parameters = inspect.signature(fn).parameters
    except ValueError:
        # Some functions written in C have no signature.
        return False
    variadic = (inspect.Parameter.VAR_POSITIONAL, inspect.Parameter.VAR_KEYWORD)
    without_default = [
        parameter
        for parameter in parameters.values()
        if parameter.default is inspect.Parameter.empty
        and parameter.kind not in variadic
    ]
    return "args" in parameters or len(without_default) > 1


def check_solver(name: str, solver: Any) -> None:
    """Raises a `ValueError` unless the argument of this name is a solver."""
    if isinstance(solver, diffrax.AbstractSolver):
        return
    example = "ImplicitMidpoint"
    # The most common mistake is to pass a class in place of its instance.
    if isinstance(solver, type) and issubclass(solver, diffrax.AbstractSolver):
        example = solver.__name__
    raise ValueError(
        f"`{name}` must be a solver, such as `{example}()`; got {solver!r}."
    )


def check_made_for_noise(solver: diffrax.AbstractSolver) -> None:
    """Raises a `ValueError` for solvers of Diffrax that are for equations without noise, or
    that wrap another solver. Solvers from elsewhere are accepted, since they need not say
    which equations they are for."""
    kinds = diffrax.AbstractItoSolver | diffrax.AbstractStratonovichSolver
    is_of_diffrax = type(solver).__module__.startswith("diffrax.")
    # Not `isinstance`, which checks the solver in a `diffrax.HalfSolver` in its place.
    if is_of_diffrax and not issubclass(type(solver), kinds):
        raise ValueError(
            "`solver` must take fixed steps and be for equations with noise, as those of "
            f"`suggest_solver` are; got {solver!r}."
        )


def check_terms(terms: Any) -> None:
    """Raises a `ValueError` unless the argument `terms` is a term."""
    if not isinstance(terms, diffrax.AbstractTerm):
        raise ValueError(
            "`terms` must be Diffrax terms, such as `hamiltonian_terms(H0, noise, path)`, "
            f"or several in a `diffrax.MultiTerm(*terms)`; got {type(terms).__name__}."
        )


def check_args(args: Any) -> None:
    """Raises a `ValueError` for `args` that cannot be passed to a compiled program. A leaf
    is either numeric, and becomes an input of the program, or becomes a constant of the
    program, such as a string or a function."""
    for leaf in jtu.tree_leaves(args):
        # The program is found by the hashes of its constants. An iterator has a hash, but
        # yields other values each time. An array that is not numeric is no constant.
        has_fixed_value = isinstance(leaf, Hashable) and not isinstance(leaf, Iterator)
        is_constant = has_fixed_value and not eqx.is_array_like(leaf)
        if not (is_numeric(leaf) or is_constant):
            raise ValueError(
                "`args` must hold arrays, in tuples, lists and dictionaries, or in an "
                f"`equinox.Module`; got a {type(leaf).__name__}, {leaf!r}."
            )


def check_numbers(name: str, tree: PyTree) -> None:
    """Raises a `ValueError` unless all leaves of the argument of this name, a PyTree, are
    numbers or arrays of numbers."""
    for leaf in jtu.tree_leaves(tree):
        if not is_numeric(leaf):
            raise ValueError(
                f"`{name}` must hold numbers and arrays of numbers, in tuples, lists and "
                f"dictionaries; got a {type(leaf).__name__}, {leaf!r}."
            )


def is_numeric(leaf: Any) -> bool:
    """Whether JAX takes this for a number or an array of numbers."""
    # Codes of NumPy for objects, text, dates and times, of which JAX has no arrays.
    has_objects = getattr(leaf, "dtype", np.dtype(float)).kind in "OSUMm"
    return eqx.is_array_like(leaf) and not has_objects


def whole_number(name: str, value: Any, least: int = 1, most: int | None = None) -> int:
    """The value of the argument of this name, as an integer of Python. Raises a
    `ValueError` unless it is an integer, from `least` to `most`."""
    # To Python `True` is an integer.
    is_integer = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_integer or value < least or (most is not None and value > most):
        expected = "a positive integer"
        if most is not None:
            expected = f"an integer from {least} to {most}"
        elif least != 1:
            expected = f"an integer, {least} or larger"
        raise ValueError(f"`{name}` must be {expected}; got {value!r}.")
    return int(value)


def check_memory(
    name: str, number: int, bytes_of_each: int, device: Any = None
) -> None:
    """Raises a `ValueError` if the argument of this name asks for more paths at once than
    fit in the memory of a device, or without a `device` in this machine's memory. `number`
    is its value, the number of paths. A path takes `bytes_of_each` or more."""
    needed = number * bytes_of_each
    memory = _memory_of(device)
    if needed > memory:
        raise ValueError(
            f"`{name}={number}`: so many paths take {needed / 1e9:,.0f} GB or more, of "
            f"{memory / 1e9:,.0f} GB. Pass a smaller `{name}`."
        )


def _memory_of(device: Any) -> int | float:
    """The memory of a device in bytes, or infinity if that is not known."""
    if device is not None and device.platform != "cpu":
        statistics = device.memory_stats() or {}
        return statistics.get("bytes_limit", math.inf)
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError):
        # Not every operating system tells its memory.
        return math.inf


def check_real(name: str, leaves: list) -> None:
    """Raises a `ValueError` unless the function of this name returned real arrays, none of
    them empty. `leaves` are the leaves of what it returned: numbers, arrays, or instances
    of `jax.ShapeDtypeStruct` in their place."""
    if len(leaves) == 0:
        raise ValueError(f"`{name}` must return real arrays; it returned none.")
    if any(np.size(leaf) == 0 for leaf in leaves if hasattr(leaf, "shape")):
        raise ValueError(
            f"`{name}` must return arrays with one entry or more; got shapes "
            f"{[jnp.shape(leaf) for leaf in leaves]}."
        )
    dtypes = [getattr(leaf, "dtype", type(leaf)) for leaf in leaves]
    if not all(_is_real(dtype) for dtype in dtypes):
        raise ValueError(
            f"`{name}` must return real arrays; got dtypes {[str(d) for d in dtypes]}. "
            "For complex numbers return their real and imaginary parts."
        )


def _is_real(dtype: Any) -> bool:
    """Whether a mean over values of this dtype is a real number."""
    # Booleans are the values of events, whose mean is a probability.
    kinds = (jnp.floating, jnp.integer, jnp.bool_)
    return any(jnp.issubdtype(dtype, kind) for kind in kinds)


def checked_not_negative(name: str, value: Any, *, expected: str) -> ArrayLike:
    """Returns the value of the argument of this name. Raises a `ValueError` unless it is a
    real number or array. Unless it is traced, it must also be finite and not negative.
    `expected` says in the message what it must be, such as "a number"."""
    is_allowed = is_real_number(value)
    if is_allowed and not is_traced(value):
        values = np.asarray(value)
        is_allowed = np.all(np.isfinite(values) & (values >= 0))
    if not is_allowed:
        raise ValueError(
            f"`{name}` must be {expected}, finite and not negative; got {brief(value)}."
        )
    return value


def is_real_number(value: Any) -> bool:
    """Whether this is a real number, or an array of real numbers. Booleans do not count,
    since a mask in place of a number is a mistake."""
    dtype = getattr(value, "dtype", type(value))
    has_real_dtype = _is_real(dtype) and not jnp.issubdtype(dtype, jnp.bool_)
    return eqx.is_array_like(value) and has_real_dtype


def check_untraced(caller: str, tree: Any) -> None:
    """Raises a `ValueError` if any array is traced, that is, known only when a program
    runs. `caller` is the function's name for the message, in backticks."""
    if any(is_traced(x) for x in jtu.tree_leaves(tree)):
        raise inside_jax(caller)


def inside_jax(caller: str) -> ValueError:
    """The error for a call of `caller` inside a JAX transformation."""
    return ValueError(
        f"{caller} cannot run inside JAX transformations, since batches are collected "
        "outside of JAX. Call it outside of `jit`, `vmap` and `grad`. To differentiate a "
        "mean, average gradients with `monte_carlo`."
    )


def brief(tree: PyTree) -> str:
    """Values for messages. Long arrays are shown by their first and last entries."""
    with np.printoptions(threshold=8, edgeitems=2):
        return str(tree)


def shapes(tree: PyTree) -> str:
    """The shape of an array, or all shapes of a PyTree, for messages."""
    if jtu.all_leaves([tree]):
        return str(jnp.shape(tree))
    return eqx.tree_pformat(jax.eval_shape(lambda: tree), struct_as_array=True)


def check_state(caller: str, y0: Y) -> None:
    """Raises a `ValueError` unless the state consists of real floating-point arrays, in
    one precision of at least 32 bits. `caller` is the name of the solver or function that
    the state was passed to."""
    leaves = jtu.tree_leaves(y0)
    if len(leaves) == 0:
        raise ValueError(f"`{caller}` needs a state with at least one array.")
    check_numbers("y0", y0)
    for leaf in leaves:
        dtype = jnp.result_type(leaf)
        if jnp.issubdtype(dtype, jnp.complexfloating):
            raise ValueError(
                f"`{caller}` needs a state `y0` of real floating-point arrays; got an "
                f"array of dtype {dtype}. For complex amplitudes `psi` with Hamiltonians "
                "construct the terms with `wave_terms(H0, noise, path)` and pass "
                "`y0=to_pair(psi0)`. For other equations split the state into its real and "
                "imaginary parts."
            )
        if not jnp.issubdtype(dtype, jnp.floating) or jnp.finfo(dtype).bits < 32:
            raise ValueError(
                f"`{caller}` needs a state `y0` of real floating-point arrays; got an "
                f"array of dtype {dtype}. Convert it with `.astype(float)`, to float32 or "
                "float64."
            )
    # A step would promote the arrays to one dtype. Diffrax refuses a state whose dtype
    # changes, but its message does not name the dtypes.
    dtypes = {str(jnp.result_type(leaf)) for leaf in leaves}
    if len(dtypes) > 1:
        raise ValueError(
            f"`{caller}` needs all arrays of `y0` to have one dtype; got {sorted(dtypes)}."
        )


def check_pair(y: PyTree) -> None:
    """Raises a `ValueError` unless `y` is a pair of the same structure and shapes."""
    if fault := pair_fault(y):
        raise ValueError(fault)


def pair_fault(y: PyTree) -> str | None:
    """A message that says what to pass instead of `y`, or `None` if `y` is a pair of the
    same structure and shapes."""
    advice = (
        "The state of a Hamiltonian system is a pair `(p, q)` of arrays (or PyTrees) of "
        "the same structure and shapes: pass `y0=(p0, q0)`, or for spins "
        "`y0=to_spinors(s0)`, or for complex amplitudes `y0=to_pair(psi0)`. "
    )
    # Complex arrays come first: they are the most common states that are no pairs.
    if any(jnp.iscomplexobj(leaf) for leaf in jtu.tree_leaves(y)):
        return (
            f"{advice}Both are real; got {eqx.tree_pformat(y)}. For complex amplitudes "
            "construct the terms with `wave_terms`."
        )
    # A step returns a plain tuple, also for a list or a tuple with names.
    if type(y) is not tuple or len(y) != 2:
        return f"{advice}Got {eqx.tree_pformat(y)}."
    p, q = y
    same_structure = jtu.tree_structure(p) == jtu.tree_structure(q)
    if not same_structure or _shapes_of(p) != _shapes_of(q):
        return f"{advice}Got p = {eqx.tree_pformat(p)} and q = {eqx.tree_pformat(q)}."
    return None


def _shapes_of(tree: PyTree) -> list[tuple[int, ...]]:
    return [jnp.shape(leaf) for leaf in jtu.tree_leaves(tree)]
