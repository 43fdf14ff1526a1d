"""Functions of one number with every kind of control flow, for Hamiltonians."""

import jax
import jax.numpy as jnp
from jax import lax


# Many have a branch whose derivative is a constant, a value from outside, or the same as
# in another branch.
FUNCTIONS = []


def function(fn):
    FUNCTIONS.append(fn)
    return fn


def square(x):
    return x * x


def half(x):
    return x / 2


def zero(x):
    return 0 * x


def same(x):
    return x


def one(x):
    return jnp.ones_like(x)


def three_halves(x):
    return jnp.full_like(x, 1.5)


def either(yes, no):
    """A function that is `yes` of positive numbers and `no` of others."""
    return lambda x: lax.cond(x > 0, yes, no, x)


def one_of(*branches):
    """A function that is one of these on each interval of length 1/2."""

    def fn(x):
        place = jnp.floor(2 * x).astype(jnp.int32)
        return lax.switch(place % len(branches), branches, x)

    return fn


FUNCTIONS += [
    either(square, jnp.negative),
    either(jnp.negative, square),
    either(square, zero),
    either(zero, jnp.sin),
    either(same, jnp.negative),
    either(square, same),
    either(same, same),
    either(one, square),
    either(one, three_halves),
    either(jnp.cos, half),
    # One in another
    either(either(square, half), jnp.cos),
    either(half, lambda x: lax.cond(x > -0.5, zero, square, x)),
    either(lambda x: lax.cond(x > 0.5, half, same, x), lambda x: either(same, zero)(-x)),
    lambda x: lax.cond(
        x > 0.2,
        lambda x: lax.cond(x > 0.4, one_of(square, half), jnp.sin, x),
        lambda x: lax.cond(x < -0.2, zero, either(half, square), x),
        x,
    ),
    one_of(square, half, jnp.cos),
    one_of(one, zero, same, jnp.negative, square),
    one_of(either(square, half), jnp.sin),
    either(one_of(half, square, zero), jnp.cos),
    one_of(one_of(half, square), either(zero, same), three_halves),
    # One after another
    lambda x: either(square, half)(x) + either(half, zero)(x),
    lambda x: either(square, half)(either(same, jnp.negative)(x)),
    lambda x: either(half, square)(one_of(zero, half, same)(x)),
]  # fmt: skip


@function
def value_from_outside(x):
    y = jnp.sin(x)
    return y * lax.cond(x > 0, lambda x: x * x, lambda x: y, x) + y


@function
def two_values_from_outside(x):
    y, z = jnp.sin(x), 2 * x
    a, b = lax.cond(x > 0, lambda: (y, z), lambda: (z, y))
    return a * a + b / 2 + y * z


@function
def unused_results(x):
    a, _, b = lax.cond(
        x > 0, lambda x: (x, x * x, x / 2), lambda x: (x * x, jnp.exp(x), x), x
    )
    return a + b


@function
def unused_branch(x):
    return lax.cond(x > 99, square, half, x) + jnp.cos(x)


@function
def known_condition(x):
    return lax.cond(jnp.zeros(()) < 1, square, half, x) + lax.cond(
        False, same, square, x
    )


@function
def arrays_in_branches(x):
    y = jnp.stack([x, jnp.sin(x), x / 2])
    return jnp.sum(lax.cond(x > 0, lambda y: y * y, lambda y: y[::-1] / 2, y))


@function
def condition_of_two(x):
    return lax.cond((x > -0.3) & ~(x > 0.4), square, half, x)


@function
def integers_in_branches(x):
    n = lax.cond(x > 0, lambda: jnp.int32(2), lambda: jnp.int32(1))
    return lax.switch(n, [zero, half, square], x) * n


@function
def masks_in_branches(x):
    mask = lax.cond(x > 0, lambda x: x > 0.5, lambda x: jnp.array(True), x)
    return jnp.where(mask, x * x, x / 2)


@function
def derivative_in_a_branch(x):
    return lax.cond(x > 0, jax.grad(lambda x: x**3 / 3), jax.grad(half), x)


# Loops


@function
def short_loop(x):
    return lax.fori_loop(0, 3, lambda i, y: y / 2 + jnp.sin(x), x)


@function
def long_loop(x):
    return lax.fori_loop(0, 20, lambda i, y: y / 2 + jnp.sin(x), x)


@function
def loop_that_returns_a_value_from_outside(x):
    y = jnp.sin(x)
    return lax.fori_loop(0, 12, lambda i, z: y, x) + y


@function
def loop_that_swaps(x):
    swap = lambda i, y: (y[1], y[0] + y[1] / 9)
    a, b = lax.fori_loop(0, 15, swap, (x, jnp.cos(x)))
    return (a + b) / 9


@function
def conditional_in_a_loop(x):
    return lax.fori_loop(0, 13, lambda i, y: either(half, square)(y - 0.2), x)


@function
def conditional_of_the_counter(x):
    even = lambda i, y: lax.cond(i % 2 == 0, half, lambda y: y + x / 9, y)
    return lax.fori_loop(0, 13, even, x)


@function
def loop_in_a_branch(x):
    loop = lambda x: lax.fori_loop(0, 11, lambda i, y: y / 2 + x, x)
    return lax.cond(x > 0, loop, half, x)


@function
def loop_in_a_loop(x):
    inner = lambda i, y: y / 2 + jnp.sin(x)
    outer = lambda i, y: lax.fori_loop(0, 9, inner, y) / 3
    return lax.fori_loop(0, 10, outer, x)


@function
def loop_of_unknown_length(x):
    """The number is no function that JAX derives."""
    y = lax.stop_gradient(x)
    going = lambda state: (state[0] > 0.1) & (state[1] < 9)
    halved = lambda state: (state[0] / 2, state[1] + 1)
    _, number = lax.while_loop(going, halved, (jnp.abs(y), jnp.int32(0)))
    return x * x * (1 + number / 9)


@function
def scan_over_a_table(x):
    table = jnp.array([0.3, -0.2, 0.5, 0.1], x.dtype)
    total, each = lax.scan(lambda y, a: (y / 2 + a * x * x, y * a), x, table)
    return total + jnp.sum(each)


@function
def scan_over_a_long_table(x):
    table = jnp.linspace(-0.3, 0.3, 12, dtype=x.dtype)
    total, _ = lax.scan(lambda y, a: (either(half, same)(y + a), None), x, table)
    return total


@function
def checkpoint_of_a_conditional(x):
    return jax.checkpoint(either(square, half))(jnp.sin(x))


# Tables and what has no control flow


@function
def table(x):
    values = jnp.array([0.5, 1.0, -0.3, 0.2], x.dtype)
    return values[jnp.floor(2 * x).astype(jnp.int32) % 4] * x


@function
def window_of_a_table(x):
    values = jnp.linspace(-1, 1, 7, dtype=x.dtype)
    place = jnp.clip(jnp.floor(2 * x).astype(jnp.int32), 0, 4)
    return jnp.sum(lax.dynamic_slice(values, (place,), (3,))) * x * x


@function
def largest_of_several(x):
    y = jnp.stack([x, x * x, jnp.sin(2 * x)])
    return jnp.max(y) + jnp.min(y) / 2 + jnp.argmax(y) * x


@function
def selected(x):
    return jnp.select([x > 0.5, x > 0], [x * x, half(x)], x)


@function
def clipped(x):
    return jnp.clip(x, -0.4, 0.4) ** 2 + jnp.abs(x) + jnp.maximum(x, x * x)


@function
def mapped_conditional(x):
    return jnp.sum(jax.vmap(either(square, half))(jnp.stack([x, x - 0.3, -x])))


@function
def smooth(x):
    return jnp.exp(-x * x) + jnp.arctan(x) + jnp.tanh(x) + jnp.log1p(x * x)
