"""Each operation of the table, replayed for many paths, gives what JAX gives for each."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from diffrax_symplectic._stablehlo.complex import complex_functions
from diffrax_symplectic._stablehlo.elementwise import elementwise
from diffrax_symplectic._stablehlo.operation import RULES

from ..drjit_here import needs_drjit
from ..families import slow_except
from .replayed import replayed, replayed_and_by_jax, replayed_lanes


pytestmark = needs_drjit

LANES = 500
DTYPES = np.float32, np.float64
in_both_precisions = pytest.mark.parametrize("dtype", DTYPES, ids=["f32", "f64"])
F, I, U, B = "float", "int32", "uint32", "bool"  # noqa: E741
# Values at which conventions differ.
SPECIAL = {
    F: [0.0, -0.0, 1.0, -1.0, 0.5, -1.5, 2.5, np.inf, -np.inf, np.nan, 1e30, -1e-30],
    I: [0, 1, -1, 2, -2, 31, 32, 33, 2**31 - 1, -(2**31)],
    U: [0, 1, 2, 31, 32, 33, 2**31, 2**32 - 1],
    B: [False, True],
}


def values(kind: str, shape, dtype, seed: int, spread: float = 3.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    shape = (LANES, *shape)
    if kind == F:
        x = rng.normal(0, spread, shape).astype(dtype)
    elif kind == B:
        x = rng.integers(0, 2, shape).astype(bool)
    else:
        info = np.iinfo(kind)
        x = rng.integers(info.min, info.max, shape, dtype=kind, endpoint=True)
    special = np.array(SPECIAL[kind], x.dtype)
    pairs = len(special) ** 2
    flat = x.reshape(LANES, -1)
    # All pairs of these, if there are two operands.
    order = np.arange(pairs) // len(special) if seed % 2 else np.arange(pairs)
    flat[:pairs] = special[order % len(special)][:, None]
    return x


def assert_close(actual, exact, ulps: float) -> None:
    assert actual.dtype == exact.dtype
    if not np.issubdtype(exact.dtype, np.floating):
        np.testing.assert_array_equal(actual, exact)
        return
    np.testing.assert_array_equal(np.isnan(actual), np.isnan(exact))
    infinite = np.isinf(exact)
    np.testing.assert_array_equal(actual[infinite], exact[infinite])
    finite = np.isfinite(exact)
    info = np.finfo(exact.dtype)
    # Below the normal numbers JAX has zero.
    unit = np.spacing(np.maximum(np.abs(exact[finite]), info.tiny / info.eps))
    assert np.max(np.abs(actual[finite] - exact[finite]) / unit, initial=0) <= ulps


def domain(low, high):
    """A function of arguments that are brought between these first."""
    return lambda fn: lambda x, *rest: fn(jnp.clip(x, low, high), *rest)


unit = domain(-0.99, 0.99)
INTEGERS = "int8", "uint8", "int32", "uint32", "int64", "uint64"

# ruff: noqa: E501 (a table)
# name: function, kinds and shapes of arguments, units in the last place.
CASES = {
    "abs": (jnp.abs, [(F, ())], 0),
    "acos": (unit(jnp.arccos), [(F, ())], 4),
    "acosh": (lambda x: jnp.arccosh(1.1 + jnp.abs(x)), [(F, ())], 8),
    "add": (jnp.add, [(F, ()), (F, ())], 0),
    "add of integers": (jnp.add, [(U, ()), (U, ())], 0),
    "and": (jnp.bitwise_and, [(I, ()), (I, ())], 0),
    # JAX 0.12's own, in single precision and without optimizations, is off by 10.
    "asin": (unit(jnp.arcsin), [(F, ())], 12),
    "asinh": (domain(-1e9, 1e9)(jnp.arcsinh), [(F, ())], 4),
    "atan": (jnp.arctan, [(F, ())], 4),
    "atan2": (jnp.arctan2, [(F, ()), (F, ())], 4),
    # Of which JAX's own is off by up to 128.
    "atanh": (unit(jnp.arctanh), [(F, ())], 128),
    "bitcast_convert": (lambda x: lax.bitcast_convert_type(x, jnp.int32), [(U, ())], 0),
    "broadcast_in_dim": (lambda x: jnp.broadcast_to(x[:, None], (3, 2, 3))[1] * 1, [(F, (2,))], 0),
    "case": (lambda i, x: lax.switch(i % 3, [jnp.floor, jnp.negative, jnp.abs], x), [(U, ()), (F, ())], 2),
    "cbrt": (jnp.cbrt, [(F, ())], 16),
    "ceil": (jnp.ceil, [(F, ())], 0),
    "clamp": (lambda x, y: lax.clamp(-jnp.ones_like(x), x, jnp.abs(y)), [(F, ()), (F, ())], 0),
    "compare": (lambda a, b: jnp.stack([a < b, a <= b, a > b, a >= b, a == b, a != b]), [(F, ()), (F, ())], 0),
    "compare of integers": (lambda a, b: jnp.stack([a < b, a >= b, a == b]), [(U, ()), (U, ())], 0),
    "concatenate": (lambda x, y: jnp.concatenate([x, y, x], 1), [(F, (2, 2)), (F, (2, 1))], 0),
    "constant": (lambda x: x + np.arange(6.0).reshape(2, 3).astype(x.dtype), [(F, (2, 3))], 0),
    "convert to numbers": (lambda x: x.astype(float), [(I, ())], 0),
    "convert to bool": (lambda x: x.astype(bool), [(F, ())], 0),
    "convert out of range": (lambda x: jnp.stack([(x * s).astype(k).astype("int64") for k in INTEGERS for s in (1, 1e9, 1e19)]), [(F, ())], 0),
    "convert between integers": (lambda x: jnp.stack([x.astype(k).astype("int64") for k in INTEGERS]), [(I, ())], 0),
    "convert to integers": (domain(-9, 9)(lambda x: jnp.where(x == x, x, 0).astype(jnp.int32)), [(F, ())], 0),
    "cosh": (domain(-9, 9)(jnp.cosh), [(F, ())], 16),
    "cosine": (domain(-9, 9)(jnp.cos), [(F, ())], 4),
    "count_leading_zeros": (lax.clz, [(U, ())], 0),
    "divide": (jnp.divide, [(F, ()), (F, ())], 1),
    "divide of numbers without sign": (lax.div, [(U, ()), (U, ())], 0),
    "divide of integers": (lax.div, [(I, ()), (I, ())], 0),
    "dot_general": (lambda a, b: jnp.einsum("kij,kjl->kil", a, b), [(F, (2, 2, 3)), (F, (2, 3, 2))], None),
    "dot_general of another type": (lambda a, b: jnp.dot(a.astype("int8"), b.astype("int8"), preferred_element_type="int32"), [(I, (4,)), (I, (4,))], 0),
    "dot_general with zeros": (lambda a: jnp.array([[0, 1], [0.5, 2]], a.dtype) @ jnp.stack([a, 0.5 + 0 * jnp.sign(a)]), [(F, ())], 1),
    "dot_general of vectors": (jnp.dot, [(F, (4,)), (F, (4,))], None),
    "dynamic_slice": (lambda x, i: lax.dynamic_slice(x, (i, 0 * i), (2, 2)), [(F, (4, 2)), (I, ())], 0),
    "dynamic_update_slice": (lambda x, y, i: lax.dynamic_update_slice(x, y, (i,)), [(F, (4,)), (F, (2,)), (I, ())], 0),
    "erf": (lax.erf, [(F, ())], 8),
    "erf_inv": (lambda x: lax.erf_inv(jnp.clip(x, -0.9, 0.9)), [(F, ())], 64),
    # In the tail JAX's own is less accurate: see the test below.
    "erfc": (domain(-9, 2)(lax.erfc), [(F, ())], 16),
    "exponential": (domain(-9, 9)(jnp.exp), [(F, ())], 4),
    "exponential_minus_one": (domain(-9, 9)(jnp.expm1), [(F, ())], 4),
    "floor": (jnp.floor, [(F, ())], 0),
    "gather": (lambda x: x[np.array([[2, 0], [-1, 1]]), np.array([0, 1])], [(F, (3, 2))], 0),
    "gather of each path": (lambda x, i: x[i % 3, 1], [(F, (3, 2)), (U, ())], 0),
    "gather with a batch axis": (lambda x, i: jnp.take_along_axis(x, i % 3, axis=0), [(F, (3, 2)), (U, (2, 2))], 0),
    "gather of rows": (lambda x: x[:, np.array([2, 0, 2])], [(F, (2, 3))], 0),
    "if": (lambda b, x: lax.cond(b, lambda x: jnp.floor(x), lambda x: x * 2, x), [(B, ()), (F, ())], 2),
    "iota": (lambda x: x + jnp.arange(3), [(F, (3,))], 0),
    "is_finite": (jnp.isfinite, [(F, ())], 0),
    "log": (lambda x: jnp.log(jnp.abs(x)), [(F, ())], 2),
    "log_plus_one": (lambda x: jnp.log1p(jnp.abs(x)), [(F, ())], 4),
    "logistic": (domain(-9, 9)(jax.nn.sigmoid), [(F, ())], 8),
    "maximum": (jnp.maximum, [(F, ()), (F, ())], 0),
    "maximum of integers": (jnp.maximum, [(U, ()), (U, ())], 0),
    "minimum": (jnp.minimum, [(F, ()), (F, ())], 0),
    "multiply": (jnp.multiply, [(F, ()), (F, ())], 0),
    "multiply by zero": (lambda x: jnp.stack([0 * x, x * -0.0]), [(F, ())], 0),
    "multiply of integers": (jnp.multiply, [(U, ()), (U, ())], 0),
    "negate": (jnp.negative, [(F, ())], 0),
    "not": (jnp.bitwise_not, [(U, ())], 0),
    "not of bool": (jnp.logical_not, [(B, ())], 0),
    "optimization_barrier": (lax.optimization_barrier, [(F, ())], 0),
    "or": (jnp.logical_or, [(B, ()), (B, ())], 0),
    "pad": (lambda x: lax.pad(x, 7.0 * x[0, 0], ((1, 2, 1), (-1, 0, 0))), [(F, (2, 3))], 0),
    "popcnt": (lax.population_count, [(U, ())], 0),
    "power": (lambda x, y: jnp.abs(x) ** jnp.clip(y, -3, 3), [(F, ()), (F, ())], 128),
    "power of negative numbers": (lambda x: x ** jnp.array([2, 3, -1, 0.5]), [(F, ())], 32),
    "reduce": (lambda x: jnp.sum(x, axis=(0, 2)), [(F, (2, 3, 2))], None),
    "reduce to the largest": (lambda x: jnp.max(x, axis=1), [(F, (2, 3))], 0),
    "reduce to a place": (lambda x: jnp.argmax(x), [(F, (5,))], 0),
    "reduce_window": (lambda x: jnp.cumsum(x, axis=1), [(F, (2, 5))], None),
    "reduce_window to the largest": (lambda x: lax.reduce_window(x, -jnp.inf, lax.max, (2, 3), (1, 2), ((0, 1), (2, 0))), [(F, (3, 5))], 0),
    "reduce_window from the end": (lambda x: lax.cumprod(x, reverse=True), [(I, (4,))], 0),
    "reduce by two operations": (lambda x: lax.reduce(x, np.zeros((), x.dtype), lambda a, b: (a + b) * 0.5, (0,)), [(F, (3,))], 4),
    "reduce by one argument": (lambda x: lax.reduce(x, np.zeros((), x.dtype), lambda a, b: a + a, (0,)), [(F, (3,))], 0),
    "reduce of single bits": (lambda x: lax.reduce(x, np.int32(1), lax.bitwise_and, (0,)), [(I, (3,))], 0),
    "reduce of all bits": (lambda x: lax.reduce(x, np.int32(-1), lax.bitwise_and, (0,)), [(I, (3,))], 0),
    "reduce of bool": (lambda x: jnp.stack([jnp.all(x), jnp.any(x)]), [(B, (3,))], 0),
    "remainder": (lambda a, b: lax.rem(jnp.clip(a, -999, 999), jnp.where(jnp.abs(b) < 0.1, 0.3, b)), [(F, ()), (F, ())], 0),
    "remainder of integers": (lax.rem, [(I, ()), (I, ())], 0),
    "reshape": (lambda x: x.reshape(3, 2) * 1, [(F, (2, 3))], 0),
    "reverse": (lambda x: x[::-1, :], [(F, (3, 2))], 0),
    "round_nearest_afz": (lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO), [(F, ())], 0),
    "round_nearest_even": (jnp.round, [(F, ())], 0),
    "rsqrt": (lax.rsqrt, [(F, ())], 4),
    "scatter": (lambda x: x.at[np.array([2, 0])].set(x[:2] * 2), [(F, (3, 2))], 0),
    "scatter that adds": (lambda x: x.at[np.array([1, 1, 0])].add(x[:3]), [(F, (4,))], None),
    "scatter of each path": (lambda x, y, i: x.at[i].set(y, mode="drop"), [(F, (4,)), (F, (2,)), (I, (2,))], 0),
    "scatter of each path, which adds": (lambda x, y, i: x.at[1, i % 3].add(y), [(F, (2, 3)), (F, (2,)), (U, (2,))], None),
    "scatter with a batch axis": (jax.vmap(lambda x, i: x.at[i % 3].set(7.0)), [(F, (2, 3)), (U, (2,))], 0),
    "select": (lambda b, x, y: jnp.where(b, x, y), [(B, ()), (F, ()), (F, ())], 0),
    # The product needs an axis.
    "select by a scalar": (lambda b, x: jnp.where(b, x, 0) @ jnp.ones((1, 2), x.dtype), [(B, ()), (F, (1,))], 0),
    "shift_left": (lax.shift_left, [(U, ()), (U, ())], 0),
    "shift_left of signed numbers": (lax.shift_left, [(I, ()), (I, ())], 0),
    "shift_right_arithmetic": (lax.shift_right_arithmetic, [(I, ()), (I, ())], 0),
    "shift_right_arithmetic without sign": (lax.shift_right_arithmetic, [(U, ()), (U, ())], 0),
    "shift_right_arithmetic of bytes": (lambda a, b: lax.shift_right_arithmetic(a.astype("uint8"), b.astype("uint8")), [(U, ()), (U, ())], 0),
    "shift_right_logical": (lax.shift_right_logical, [(U, ()), (U, ())], 0),
    "shift_right_logical of signed numbers": (lax.shift_right_logical, [(I, ()), (I, ())], 0),
    "sign": (jnp.sign, [(F, ())], 0),
    "sign of integers": (jnp.sign, [(I, ())], 0),
    "sine": (domain(-9, 9)(jnp.sin), [(F, ())], 4),
    "sinh": (domain(-9, 9)(jnp.sinh), [(F, ())], 16),
    "slice": (lambda x: x[1:4:2], [(F, (5, 2))], 0),
    "sort": (lambda x: jnp.sort(x), [(F, (5,))], 0),
    "sort with NaN": (lambda x: jnp.sort(jnp.where(jnp.abs(x) > 3, jnp.nan * x, x)), [(F, (5,))], 0),
    "searchsorted": (lambda x: jnp.searchsorted(jnp.arange(20.0).astype(x.dtype), x), [(F, (3,))], 0),
    "sort along an axis": (lambda x: jnp.sort(x, axis=0, descending=True), [(I, (3, 2))], 0),
    "sort of pairs": (lambda i, x: jnp.argsort(i % 3), [(U, (6,)), (F, ())], 0),
    "sqrt": (jnp.sqrt, [(F, ())], 0),
    "square": (lax.square, [(F, ())], 0),
    "subtract": (jnp.subtract, [(F, ()), (F, ())], 0),
    "tan": (domain(-1.5, 1.5)(jnp.tan), [(F, ())], 16),
    "tanh": (jnp.tanh, [(F, ())], 16),
    "transpose": (lambda x: jnp.transpose(x, (2, 0, 1)) * 1, [(F, (2, 3, 1))], 0),
    "while": (domain(-9, 9)(lambda x, n: lax.while_loop(lambda c: c[1] < n % 50, lambda c: (jnp.cos(c[0]), c[1] + 1), (x, n * 0))[0]), [(F, ()), (U, ())], None),
    "while of known length": (lambda x: lax.scan(lambda y, a: (y * 0.5 + a, y), x[0], x)[1], [(F, (4,))], 2),
    "while of known and long length": (lambda x: lax.fori_loop(0, 30, lambda i, y: y * 0.5 + x[i % 4], x[0]), [(F, (4,))], None),
    "xor": (jnp.bitwise_xor, [(U, ()), (U, ())], 0),
}  # fmt: skip


# In single precision Dr.Jit takes these from a GPU's hardware, whose error is absolute.
HARDWARE = (
    "sine", "cosine", "exponential", "log", "log_plus_one", "exponential_minus_one",
    "sinh", "tanh", "erfc",
)  # fmt: skip


# Those with the same arguments are one program.
PROGRAMS = {}
for name, (_, kinds, _) in CASES.items():
    PROGRAMS.setdefault(str(kinds), []).append(name)


def wrong(name, dtype, args, actual, exact) -> str | None:
    """How far the results are from those of JAX, if that is too far."""
    _, _, ulps = CASES[name]
    try:
        if ulps is None:
            # Sums in another order. Of what overflows or cancels nothing is promised.
            eps = np.finfo(dtype).eps
            ok = np.all(
                [
                    np.abs(x.reshape(LANES, -1)).max(1) < 1e6
                    for x in args
                    if x.dtype == dtype
                ],
                axis=0,
            )
            np.testing.assert_allclose(actual[ok], exact[ok], rtol=0, atol=200 * eps)
        elif (
            name in HARDWARE and dtype == np.float32 and jax.default_backend() != "cpu"
        ):
            ok = np.isfinite(exact)
            np.testing.assert_allclose(actual[ok], exact[ok], rtol=1e-6, atol=1e-6)
        else:
            assert_close(actual, exact, ulps)
    except AssertionError as error:
        return f"{name}: {error}"


@pytest.mark.parametrize("dtype", slow_except([np.float64], DTYPES), ids=["f32", "f64"])
@pytest.mark.parametrize("names", PROGRAMS.values(), ids=PROGRAMS)
def test_replayed_operations_give_what_jax_gives(names, dtype):
    _, kinds, _ = CASES[names[0]]
    args = [values(kind, s, dtype, seed=i) for i, (kind, s) in enumerate(kinds)]
    results = replayed_and_by_jax({name: CASES[name][0] for name in names}, *args)
    found = [wrong(name, dtype, args, *both) for name, *both in results]
    assert not any(found), "\n".join(filter(None, found))


@in_both_precisions
def test_rounding_away_from_zero_is_exact_where_half_cannot_be_added(dtype):
    info = np.finfo(dtype)
    # The spacing of numbers is one, and half a number more would be rounded itself.
    ones = 2.0**info.nmant + np.array([1, 3])
    below_half = np.nextafter(dtype(0.5), dtype(0))
    x = np.array([*ones, below_half, 0.5, 1.5, np.inf], dtype)
    exact = np.array([*ones, 0, 1, 2, np.inf], dtype)
    fn = lambda x: lax.round(x, lax.RoundingMethod.AWAY_FROM_ZERO)
    (rounded,) = replayed(fn, np.concatenate([x, -x]))
    np.testing.assert_array_equal(rounded, np.concatenate([exact, -exact]))


@in_both_precisions
def test_hyperbolic_functions_are_finite_where_the_exponential_is_not(dtype):
    x = dtype({np.float32: 89.0, np.float64: 710.2}[dtype]) * np.array([1, -1], dtype)
    size = np.exp(np.abs(x).astype(np.longdouble)) / 2
    info = np.finfo(dtype)
    assert np.all(info.max / 2 < size) and np.all(size < info.max)
    hardware = dtype == np.float32 and jax.default_backend() != "cpu"
    rtol = 2e-5 if hardware else 8 * info.eps
    actual = replayed(lambda x: (jnp.cosh(x), jnp.sinh(x)), x)
    exact = np.array([size, np.sign(x) * size]).astype(dtype)
    np.testing.assert_allclose(actual, exact, rtol=rtol)


def test_the_inverse_error_function_is_one_to_rounding_in_its_tails():
    x = np.concatenate([s * (1 - 10.0 ** -np.linspace(1, 15, LANES)) for s in (-1, 1)])
    (y,) = replayed(lax.erf_inv, x)
    # Backward: the last digits of `x` are many of `y`.
    assert np.max(np.abs(np.asarray(lax.erf(y)) - x)) <= 8 * np.finfo(float).eps


@in_both_precisions
def test_the_complementary_error_function_has_all_digits_in_its_tails(dtype):
    x = np.concatenate([np.linspace(-30, 30, LANES), [np.inf, -np.inf]]).astype(dtype)
    (actual,) = replayed(lax.erfc, x)
    # JAX's own and SciPy's round the square in the exponent: in double precision they are
    # off by up to 505 units.
    exact = np.array([math.erfc(number) for number in x.tolist()]).astype(dtype)
    if dtype == np.float32 and jax.default_backend() != "cpu":
        np.testing.assert_allclose(actual, exact, rtol=0, atol=2e-6)
    else:
        assert_close(actual, exact, 16)


@in_both_precisions
def test_lanes_fail_whose_angles_are_too_large_for_sine_and_cosine(dtype):
    largest = dtype({np.float32: 2**13, np.float64: 2**31}[dtype])
    beyond = np.nextafter(largest, dtype(np.inf))
    sizes = [largest, beyond, 3 * largest, 1e30, 1e6, 3000]
    x = np.array([*sizes, *np.negative(sizes)], dtype)
    waves = {
        "itself": lambda x: jnp.stack([jnp.sin(x), jnp.cos(x)]),
        "in a branch": lambda x: lax.cond(x > 0, jnp.sin, jnp.cos, x),
        "in a loop": lambda x: lax.while_loop(
            lambda y: y != jnp.cos(x), lambda y: jnp.cos(x), jnp.zeros_like(x)
        ),
        "of a loop that goes on": lambda x: lax.while_loop(
            lambda y: jnp.sin(x * y) != 0, lambda y: y - 1, jnp.ones_like(x)
        ),
        "of complex numbers": lambda x: jnp.real(jnp.exp(lax.complex(x * 0, x))),
    }
    every = jax.jit(jax.vmap(lambda x: [fn(x) for fn in waves.values()]))(x)
    for (name, fn), exact in zip(waves.items(), map(np.asarray, every)):
        (actual,), lost = replayed_lanes(fn, x)
        np.testing.assert_array_equal(lost, np.abs(x) > largest, name)
        np.testing.assert_allclose(
            actual[~lost], exact[~lost], rtol=0, atol=4 * np.finfo(dtype).eps
        )


@in_both_precisions
def test_lanes_fail_whose_quotients_are_too_large_for_a_remainder(dtype):
    largest = {np.float32: 2.0**24, np.float64: 2.0**53}[dtype]
    quotients = np.array([1.5, 0.3 * largest, 0.9 * largest, 1.1 * largest, 1e30])
    x = np.array([*quotients, *np.negative(quotients), np.inf, 0.0], dtype) * dtype(0.7)
    (actual,), lost = replayed_lanes(lambda x: lax.rem(x, dtype(0.7)), x)
    too_large = np.isinf(x) | (np.abs(x) > 0.7 * largest)
    np.testing.assert_array_equal(lost, too_large)
    exact = np.fmod(x[~lost], dtype(0.7))
    np.testing.assert_array_equal(actual[~lost], exact)
    # Without a quotient there is no limit.
    (actual,), lost = replayed_lanes(lambda x: lax.rem(x, dtype(0)), x)
    assert not np.any(lost) and np.all(np.isnan(actual))


NONE = jnp.zeros(0)
EMPTY = {
    "itself": lambda x: jnp.stack([x])[:0],
    "compare": lambda x: jnp.stack([x])[:0] > 1,
    "convert": lambda x: jnp.stack([x])[:0].astype("int32"),
    "complex": lambda x: jnp.real(lax.complex(NONE + x, NONE) * 1j),
    "sort": lambda x: jnp.argsort(NONE + x),
    "sum": lambda x: x + jnp.sum(jnp.zeros((0, 3)) + x, axis=0),
    "concatenate": lambda x: jnp.concatenate([NONE, jnp.stack([x, x])]),
    "gather": lambda x: jnp.stack([x, x])[NONE.astype("int32")],
    "scatter": lambda x: jnp.stack([x, x]).at[NONE.astype("int32")].add(1.0),
    "dot_general": lambda x: (jnp.zeros((2, 0)) + x) @ jnp.zeros((0, 3)),
    "if": lambda x: lax.cond(x > 0, lambda: NONE + x, lambda: NONE),
    "while": lambda x: lax.scan(lambda y, a: (y + x, y * a), NONE, jnp.ones(12))[1],
    "solve": lambda x: jnp.linalg.solve(jnp.zeros((0, 0)) + x, NONE),
    "det": lambda x: jnp.linalg.det(jnp.zeros((0, 0)) + x),
}


def test_arrays_may_be_empty():
    for _, x, y in replayed_and_by_jax(EMPTY, np.array([-1.0, 0.5, 3.0])):
        np.testing.assert_array_equal(x, y)


def test_every_operation_of_the_table_is_tested():
    tested = {name.split()[0] for name in CASES} - {"searchsorted"}
    # Tested by `test_linear_algebra` and `test_complex`; the last has no value.
    elsewhere = {"custom_call", "complex", "imag", "real", "sharding_constraint"}
    names = {*elementwise(), *complex_functions(), *RULES}
    assert names == tested | elsewhere
