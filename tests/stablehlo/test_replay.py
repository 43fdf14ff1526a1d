"""The entrance of `_stablehlo`: a program's text and arrays in, arrays out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_symplectic._stablehlo import (
    array_in_memory,
    array_types,
    dr,
    NotReplayed,
    Replay,
    scalar,
)

from ..drjit_here import needs_drjit
from .replayed import replayed, replayed_lanes, text_of


pytestmark = needs_drjit

# Written by hand: for each path x, the sum of x and 2 x and the larger of them.
BY_HAND = """
module {
  func.func private @double(%x: tensor<f64>) -> tensor<f64> {
    %two = stablehlo.constant dense<2.0> : tensor<f64>
    %y = stablehlo.multiply %x, %two : tensor<f64>
    return %y : tensor<f64>
  }
  func.func public @main(%x: tensor<f64>) -> (tensor<f64>, tensor<f64>) {
    %y = call @double(%x) : (tensor<f64>) -> tensor<f64>
    %sum = stablehlo.add %x, %y : tensor<f64>
    %larger = stablehlo.maximum %x, %y : tensor<f64>
    return %sum, %larger : tensor<f64>, tensor<f64>
  }
}
"""
X = np.array([-1.0, 0.5, 3.0])


def test_a_program_that_is_no_product_of_jax_is_run_for_each_lane():
    total, larger = replayed(BY_HAND, X)
    np.testing.assert_array_equal(total, 3 * X)
    np.testing.assert_array_equal(larger, np.maximum(X, 2 * X))


def test_the_types_of_arguments_and_results_that_are_arguments_are_known():
    structs = [((3, 2), "float32"), ((), "int32"), ((4,), "complex128")]
    structs = [jax.ShapeDtypeStruct(*struct) for struct in structs]
    replay = Replay(text_of(lambda x, i, z: (i, x[i], x, 1.0), *structs))
    named = [(of.shape, of.kind, of.size) for of in replay.arguments]
    assert named == [((3, 2), "f32", 6), ((), "i32", 1), ((4,), "complex<f64>", 4)]
    assert replay.returned_arguments == [1, None, 0, None]


def test_a_replay_is_part_of_the_loop_that_it_stands_in():
    double = Replay(text_of(lambda x: 2 * x, jnp.zeros(())))

    def once(i, x):
        ((result,), _) = double(scalar(x))
        return i + 1, result.item()

    count = array_types()["i32"](0)
    start = array_in_memory("f64", X)
    _, end = dr.while_loop((count, start), lambda i, _: i < 5, once)
    np.testing.assert_array_equal(end, 32 * X)


def test_large_constants_are_read_from_memory():
    table = np.sin(np.arange(1000.0))
    replay = Replay(text_of(lambda i: jnp.asarray(table)[i], jnp.zeros((), "int32")))
    places = np.array([3, 999, 0], np.int32)
    (in_this_array,) = replay.constants()
    np.testing.assert_array_equal(in_this_array, table)
    other = array_in_memory("f64", -table)
    index = scalar(array_in_memory("i32", places))
    for memory, exact in ((in_this_array, table), (other, -table)):
        ((found,), _) = replay(index, constants=[memory])
        np.testing.assert_array_equal(found.item(), exact[places])


def test_errors_name_the_lanes_that_raise_them():
    def checked(x):
        return eqx.error_if(2 * x, x > 1, "too large")

    def in_a_branch(x):
        return jax.lax.cond(x > 0, checked, lambda x: x, x)

    def in_a_loop(x):
        once = lambda i, y: eqx.error_if(y + x, y > 2, "too large")
        return jax.lax.fori_loop(0, 12, once, x)

    for fn, exact in (
        (checked, [-2.0, 1.0]),
        (in_a_branch, [-1.0, 1.0]),
        (in_a_loop, [-13.0]),
    ):
        (result,), lost = replayed_lanes(fn, X)
        np.testing.assert_array_equal(lost, np.arange(3) >= len(exact))
        np.testing.assert_array_equal(result[~lost], exact)


def test_python_in_each_branch_is_refused():
    def printed(x):
        jax.debug.print("{}", x)
        return x

    fn = lambda x: jax.lax.cond(x > 0, printed, lambda x: 2 * printed(x), x)
    with pytest.raises(NotReplayed, match="with a call of Python in each branch"):
        replayed_lanes(fn, np.array([1.0, -1.0]))
