"""Random functions of one number, made of all that has once gone wrong in the fused engine,
each in company of others.

The derivatives of these functions are of the size of one, and what they compare or convert
to integers is not within rounding of another answer, for most numbers."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


PARTS = []
# These functions take sines of angles that are too large for kernels: JAX gets such paths.
HANDED_BACK = []


def part(fn):
    PARTS.append(fn)
    return fn


def handed_back(fn):
    HANDED_BACK.append(fn)
    return part(fn)


def quarters(x):
    """A whole number, as an integer."""
    return jnp.floor(4 * lax.stop_gradient(x)).astype(jnp.int32)


def sign_of(x):
    """An infinite number for positive ones."""
    return jnp.where(x > 0, jnp.inf, jnp.ones_like(x))


# Complex constants


def constant(value, x):
    return lambda: jnp.asarray(value, jnp.result_type(x, jnp.complex64))


@part
def complex_constants_of_branches(x):
    same = constant(2 + 1j, x)
    return x * jnp.imag(lax.cond(x > 0.3, same, same) * (1 + 0.5j)) / 3


@part
def complex_constants_of_many_branches(x):
    branches = [constant(value, x) for value in (1 + 0j, 1j, 2j)]
    value = lax.switch(quarters(x) % 3, branches)
    return x * jnp.real(value) + x * x * jnp.imag(value) / 3


@part
def complex_numbers_with_one_constant_part(x):
    half = lambda: lax.complex(x, jnp.full_like(x, 0.5))
    real = lambda: lax.complex(x * x, jnp.full_like(x, 0.5))
    return jnp.imag(lax.cond(x > 0.1, half, real) ** 2)


@part
def complex_constants_of_loops(x):
    def once(i, state):
        y, _ = state
        return y / 2 + x, constant(1 + 0.5j, x)()

    y, value = lax.fori_loop(0, 12, once, (x, constant(1j, x)()))
    return jnp.real(value * y) / 3 + x * jnp.imag(value)


@part
def complex_loop(x):
    turned = lambda i, z: z * (0.8 + 0.5j) + x / 9
    z = lax.fori_loop(0, 11, turned, lax.complex(x, 1 - x))
    return jnp.real(z * jnp.conj(z)) / 4 + jnp.imag(jnp.exp(1j * z))


# Large angles


@handed_back
def sine_of_a_large_angle(x):
    return x * jnp.sin(3e9 * (quarters(x) > 2))


@handed_back
def sine_of_a_large_angle_in_a_branch(x):
    large = lambda: jnp.cos(jnp.full_like(x, 1e10))
    return x * lax.cond(x > 0.8, large, lambda: jnp.sin(x))


@handed_back
def sine_of_a_large_angle_in_a_loop(x):
    # The last angle is 1.2e10, for large numbers only.
    angle = lambda i: jnp.where(x > 0.8, 1e9 * i.astype(x.dtype), 1.0)
    return x * lax.fori_loop(0, 13, lambda i, y: y / 2 + jnp.sin(angle(i)), x)


# Integers


@part
def integers_of_numbers_out_of_range(x):
    n = (1e30 * lax.stop_gradient(x)).astype(jnp.int32)
    return x * (n // 2**29) / 8


@part
def integers_of_nan(x):
    n = (jnp.nan * lax.stop_gradient(x)).astype(jnp.int32)
    return x * x * (1 + n)


@part
def unsigned_integers_of_negative_numbers(x):
    n = (100 * jnp.floor(lax.stop_gradient(4 * x))).astype(jnp.uint8)
    return x * n.astype(x.dtype) / 255


@part
def shifts_of_signed_integers(x):
    n = lax.shift_right_logical(quarters(x), jnp.int32(28))
    return x * n / 16 + x * (quarters(x) >> 1) / 4


@part
def shifts_of_unsigned_integers(x):
    n = quarters(x).astype(jnp.uint32)
    return x * (lax.shift_right_arithmetic(n, jnp.uint32(3)) & 3).astype(x.dtype) / 4


@part
def products_of_small_integers(x):
    row = jnp.stack([quarters(x), quarters(2 * x)]).astype(jnp.int8) * 20
    total = jnp.dot(row, row, preferred_element_type=jnp.int32)
    return x * total / 9000


# Zero times infinity


@part
def zero_times_infinity(x):
    return jnp.where(jnp.isnan(0 * sign_of(x)), x / 2, x * x)


@part
def zero_times_infinity_in_a_product_of_matrices(x):
    matrix = jnp.array([[0.0, 0.5], [0.5, 0.3]], x.dtype)
    first, second = matrix @ jnp.stack([sign_of(x), x])
    return jnp.where(jnp.isnan(first), x * x, first) + jnp.where(x > 0, x, second) / 3


# Empty arrays


@part
def empty_arrays(x):
    none = jnp.stack([x])[:0]
    return x * (1 + jnp.sum(none * 2)) + jnp.where(jnp.all(none > 0), x * x, 0)


# Tables

TABLE = np.sin(np.arange(200.0))
COMPLEX_TABLE = np.exp(0.3j * np.arange(100))


@part
def table_at_small_indices(x):
    table = jnp.asarray(TABLE, x.dtype)
    return x * table[quarters(x).astype(jnp.int8)] + x * table[199 - quarters(x)] / 2


@part
def table_at_small_indices_without_sign(x):
    place = (60 + quarters(x)).astype(jnp.uint8)
    return x * jnp.sum(lax.dynamic_slice(jnp.asarray(TABLE, x.dtype), (place,), (2,)))


@part
def complex_table(x):
    table = jnp.asarray(COMPLEX_TABLE, jnp.result_type(x, jnp.complex64))
    return jnp.real(table[10 + quarters(x)] * lax.complex(x, x * x))


@part
def table_in_a_branch(x):
    table = jnp.asarray(TABLE, x.dtype)
    read = lambda table: x * table[50 + quarters(x)]
    return lax.cond(x > 0, read, lambda table: x * table[3], table)


# Linear systems and sorting


@part
def linear_system(x):
    matrix = jnp.array([[2.0, 0.5], [0.0, 3.0]], x.dtype)
    shifted = matrix + x * jnp.eye(2, dtype=x.dtype) / 2
    return x * jnp.linalg.solve(shifted, jnp.stack([x, jnp.ones_like(x)]))[0]


@part
def median(x):
    return jnp.median(jnp.stack([x, x * x, jnp.sin(3 * x)]))


@part
def smooth(x):
    return jnp.tanh(x) + jnp.exp(-x * x) / 3


# What the parts stand in


def bounded(y):
    return y / (1 + y * y / 4)


def in_a_branch(rng, inner):
    edge = rng.uniform(-0.6, 0.6)
    yes = inner()
    no = inner()
    return lambda x: lax.cond(x > edge, yes, no, x)


def in_a_switch(rng, inner):
    branches = [inner(), jnp.sin, inner()]
    return lambda x: lax.switch(quarters(x) % 3, branches, x)


def in_a_loop(rng, inner):
    fn = inner()
    # Longer ones are a loop of the kernel after eight turns, and take long to compile.
    number = int(rng.choice([2, 10], p=[0.8, 0.2]))
    once = lambda x: lambda i, y: bounded(fn(y)) / 2 + x / 2
    return lambda x: lax.fori_loop(0, number, once(x), x)


def in_a_scan(rng, inner):
    fn = inner()
    table = rng.uniform(-0.3, 0.3, int(rng.choice([3, 12], p=[0.8, 0.2])))
    once = lambda y, a: (bounded(fn(y + a)) / 2, y)

    def scanned(x):
        last, each = lax.scan(once, x, jnp.asarray(table, x.dtype))
        return last + jnp.sum(each) / 9

    return scanned


def in_a_map(rng, inner):
    fn = inner()
    shifts = rng.uniform(-0.4, 0.4, 2)
    return lambda x: jnp.sum(jax.vmap(fn)(x + jnp.asarray(shifts, x.dtype))) / 2


def in_a_checkpoint(rng, inner):
    return jax.checkpoint(inner())


def in_a_row(rng, inner):
    first = inner()
    second = inner()
    return lambda x: bounded(first(x)) + second(bounded(x)) / 2


COMPANY = (
    in_a_branch,
    in_a_switch,
    in_a_loop,
    in_a_scan,
    in_a_map,
    in_a_checkpoint,
    in_a_row,
)


class Drawn(NamedTuple):
    """A random function `fn`, and the parts in it."""

    fn: Callable
    parts: list[Callable]

    @property
    def handed_back(self) -> bool:
        """Whether JAX gets many of the paths."""
        return any(part in HANDED_BACK for part in self.parts)


def drawn(rng: np.random.Generator, first: Callable, depth: int) -> Drawn:
    """A function of this depth with the part `first`, and others at random, in it."""
    parts: list[Callable] = []

    def at(depth: int) -> Callable:
        if depth > 0:
            around = COMPANY[rng.integers(len(COMPANY))]
            return around(rng, lambda: at(depth - 1))
        parts.append(PARTS[rng.integers(len(PARTS))] if parts else first)
        return parts[-1]

    return Drawn(at(depth), parts)
