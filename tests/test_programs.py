"""Programs are found by what functions compute, as they are when they are called."""

import contextlib
import functools as ft
import gc
import os
import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
import pytest

from diffrax_symplectic import _programs
from diffrax_symplectic._batch import materialize
from diffrax_symplectic._programs import (
    compiled,
    current_traces,
    digest,
    note_call,
    once_for_each_signature,
    traced,
)


ONE = jnp.array(1.0)
strength = 1.0


class Spring(eqx.Module):
    """A function with an array of its own."""

    k: jax.Array

    def __call__(self, x):
        return self.k * x**2

    def energy(self, x):
        return self(x) / 2

    def strength(self):
        return 2 * self.k


def reads_global(x):
    return strength * x


def closes_over(k):
    return lambda x: k * x


@pytest.mark.parametrize(
    "first, second",
    [
        (closes_over(jnp.array(2.0)), closes_over(jnp.array(3.0))),
        (closes_over(np.float64(2.3)), closes_over(np.float64(3.1))),
        (closes_over(2.3), closes_over(3.1)),
        (Spring(jnp.array(2.0)), Spring(jnp.array(3.0))),
        (Spring(jnp.array(2.0)).energy, Spring(jnp.array(3.0)).energy),
        (jtu.Partial(jnp.multiply, ONE), jtu.Partial(jnp.multiply, 2 * ONE)),
        (lambda x: jnp.where(x > 0.7, x, 0), lambda x: jnp.where(x > 0.3, x, 0)),
        (lambda x: x / 0.7, lambda x: x / 1.3),
        (lambda x: 0.7, lambda x: 1.3),
    ],
    ids="array numpy python module method partial comparison divisor result".split(),
)
def test_other_numbers_are_another_input_of_the_same_program(first, second):
    one = traced(first, ONE)
    other = traced(second, ONE)
    assert one.program is other.program
    for fn, program in ((first, one), (second, other)):
        # As in a program: there XLA divides by multiplying with the inverse.
        assert program(0.5) == eqx.filter_jit(fn)(jnp.array(0.5))
    assert digest(one) != digest(other)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_divisor_as_data_gives_the_results_of_a_constant_bit_by_bit(dtype):
    xs = jr.normal(jr.key(0), 1000, dtype)
    divide = lambda x: x / 0.7
    np.testing.assert_array_equal(traced(divide, xs)(xs), jax.jit(divide)(xs))


def with_rule(factor):
    @jax.custom_jvp
    def square(x):
        return x**2

    square.defjvp(lambda x, dx: (square(*x), factor * x[0] * dx[0]))
    return square


def with_callback(fn):
    return lambda x: jax.pure_callback(fn, x, x)


@pytest.mark.parametrize(
    "first, second",
    [
        (lambda x: x**2, lambda x: x**3),
        (lambda x: x / 2, lambda x: x / 3),
        (lambda x: -0.0 * x, lambda x: 0.0 * x),
        (lambda x: 2 * x, lambda x: 2 + x),
        (lambda x: x - 2 * ONE, lambda x: 2 * ONE - x),
        (lambda x: (x, 1), lambda x: (x, 2)),
        (lambda x: (x, "a"), lambda x: (x, "b")),
        (with_rule(2.0), with_rule(3.0)),
        (jax.jit(closes_over(2 * ONE)), jax.jit(closes_over(3 * ONE))),
        (with_callback(np.sin), with_callback(np.cos)),
    ],
)  # fmt: skip
def test_functions_that_compute_something_else_are_other_programs(first, second):
    one = traced(first, ONE)
    other = traced(second, ONE)
    assert one.program is not other.program
    assert jtu.tree_leaves(one(0.5)) == jtu.tree_leaves(first(jnp.array(0.5)))
    assert jtu.tree_leaves(other(0.5)) == jtu.tree_leaves(second(jnp.array(0.5)))


def test_the_rules_of_custom_derivatives_are_those_of_the_same_function():
    square = with_rule(5.0)
    once = traced(square, ONE)
    assert traced(square, ONE).program is once.program
    assert jax.grad(once)(2.0) == 10


def test_programs_work_under_transformations():
    program = traced(Spring(jnp.array(3.0)), ONE)
    xs = jnp.arange(3.0)
    np.testing.assert_allclose(jax.vmap(program)(xs), 3 * xs**2)
    np.testing.assert_allclose(jax.vmap(jax.grad(program))(xs), 6 * xs)
    by_k = jax.grad(lambda k: traced(closes_over(k), ONE)(2.0))
    assert by_k(jnp.array(1.0)) == 2


# Contracted, free and common axes, none of them, and more than one of each.
@pytest.mark.parametrize(
    "subscripts", ["ab,b->a", "ab,bc->ac", "a,a->", "ab,c->abc", "abcd,becd->abe"]
)
def test_products_of_small_complex_arrays_are_sums(subscripts):
    product = ft.partial(jnp.einsum, subscripts)
    operands, _ = subscripts.split("->")
    sizes = dict(zip("abcde", (2, 3, 8, 4, 5)))
    left, right = (
        jr.normal(jr.key(number), [sizes[axis] for axis in axes], complex)
        for number, axes in enumerate(operands.split(","))
    )
    program = traced(product, left, right)

    def size(product, left):
        return jnp.sum(jnp.abs(product(left, right)) ** 2)

    assert "dot_general" not in str(jax.make_jaxpr(program)(left, right))
    exact = product(left, right)
    np.testing.assert_allclose(program(left, right), exact, rtol=1e-13, atol=1e-14)
    exact = jax.grad(size, argnums=1)(product, left)
    gradient = jax.grad(size, argnums=1)(program, left)
    np.testing.assert_allclose(gradient, exact, rtol=1e-13, atol=1e-13)


def test_a_product_may_have_more_digits_than_its_factors():
    row = jnp.array([1, 1e-9], jnp.complex64)
    product = ft.partial(jnp.dot, preferred_element_type=jnp.complex128)
    found = traced(product, row, row[::-1])(row, jnp.ones_like(row))
    assert found.dtype == jnp.complex128 and found.real > 1


def test_products_of_large_or_real_arrays_are_left_to_xla():
    for matrix in (jnp.ones((2, 2)), jnp.ones((2, 9), complex)):
        program = traced(jnp.dot, matrix, matrix.T)
        assert "dot_general" in str(jax.make_jaxpr(program)(matrix, matrix.T))


@pytest.fixture
def only_new_garbage():
    """To look through all that other tests left takes seconds."""
    gc.freeze()
    yield
    gc.unfreeze()


def test_programs_are_dropped_with_all_that_uses_them(only_new_garbage):
    before = len(_programs._known)
    program = traced(lambda x: jnp.sinh(jnp.cosh(x)), ONE)
    assert len(_programs._known) == before + 1
    del program
    gc.collect()
    assert len(_programs._known) == before


def test_what_a_bound_method_is_bound_to_is_not_printed(monkeypatch):
    # JAX goes on if printing raises an error.
    prints = []
    monkeypatch.setattr(Spring, "__repr__", lambda self: prints.append(self))
    got = jax.jit(lambda x: materialize(Spring(x).strength))(jnp.arange(3.0))
    np.testing.assert_array_equal(got, [0.0, 2.0, 4.0])
    assert prints == []


def test_the_number_of_compiled_programs_has_a_bound(monkeypatch, only_new_garbage):
    few = _programs._Remembered(2)
    monkeypatch.setattr(_programs, "_programs", few)
    apply = compiled(lambda program, x: program(x))
    client = jax.devices()[0].client

    def run(k):
        program = traced(lambda x: x**k, ONE)
        assert apply(program, jnp.array(2.0)) == 2.0**k

    run(20)
    gc.collect()
    before = len(client.live_executables())
    for k in range(21, 29):
        run(k)
    gc.collect()
    assert len(client.live_executables()) <= before + 1


def a_digest():
    x = jnp.ones(3)
    fn = lambda x: {"a": jnp.sum(jnp.where(x > 0.3, jax.nn.relu(x), 0)), "b": x @ x}
    return digest((traced(fn, x), fn, x, "text"))


@pytest.mark.slow
def test_a_hash_of_a_program_is_the_same_in_other_processes():
    code = (
        "import jax; jax.config.update('jax_enable_x64', True)\n"
        "from tests.test_programs import a_digest; print(a_digest())"
    )
    for seed in "12":
        environment = os.environ | {"PYTHONHASHSEED": seed}
        found = subprocess.check_output([sys.executable, "-c", code], env=environment)
        assert found.decode().strip() == str(a_digest())


def test_traces_of_solves_are_used_again_while_their_functions_are_the_same():
    """The user's functions are called within a `jit`, as by `diffrax.diffeqsolve`."""
    global strength
    num_calls = 0

    @ft.partial(jax.jit, static_argnums=1)
    def inner(x, fn):
        nonlocal num_calls
        num_calls += 1
        note_call(fn, x)
        return fn(x)

    def outer(x):
        return inner(x, reads_global)

    found = []
    for new in (1.0, 1.0, 0.3, 0.3):
        strength = new
        with current_traces(outer):
            found.append(float(traced(outer, ONE)(2.0)))
    assert found == [2, 2, 0.6, 0.6]
    assert num_calls == 2


def test_traces_of_solves_leave_out_functions_of_traced_values():
    @ft.partial(jax.jit, static_argnums=1)
    def inner(x, fn):
        note_call(fn, x)
        return fn(x)

    def outer(spring, x):
        return inner(x, lambda x: spring.k * x)

    # The second time, the function of the first trace is not called again.
    for k in (1.0, 3.0):
        fn = jtu.Partial(outer, Spring(jnp.array(k)))
        with current_traces(fn):
            assert traced(fn, ONE)(2.0) == 2 * k


def square(x):
    return x**2


@pytest.mark.parametrize(
    "first, second, same",
    [
        ((jnp.zeros(2),), (jnp.ones(2),), True),
        ((np.zeros(2),), (np.ones(2),), True),
        ((square, {"a": jnp.zeros(())}), (square, {"a": jnp.ones(())}), True),
        ((0.1,), (0.1,), True),
        ((jnp.zeros(2),), (jnp.zeros(3),), False),
        ((jnp.zeros(2, jnp.float32),), (jnp.zeros(2, jnp.int32),), False),
        ((square,), (lambda x: x**2,), False),
        ((1,), (1.0,), False),
        ((1,), (True,), False),
        (((0.1,),), ([0.1],), False),
        ((jnp.asarray(0.5),), (jnp.asarray(0.5, jnp.float32),), False),
        # What is refused is checked again.
        (("wrong",), ("wrong",), False),
    ],
)
def test_arguments_of_the_same_signature_are_checked_once(first, second, same):
    seen = []

    @once_for_each_signature
    def check(*args):
        seen.append(args)
        if isinstance(args[0], str):
            raise ValueError

    for args in (first, second):
        with contextlib.suppress(ValueError):
            check(*args)
    assert len(seen) == (1 if same else 2)
