"""Checks are made once for each signature of their arguments."""

import jax.numpy as jnp
import numpy as np
import pytest

from diffrax_symplectic._programs import once_for_each_signature


def counted():
    """A check that refuses one word, and the arguments that it got."""
    seen = []

    @once_for_each_signature
    def check(*args):
        seen.append(args)
        if any(isinstance(x, str) for x in args):
            raise ValueError("wrong")

    return check, seen


def square(x):
    return x**2


@pytest.mark.parametrize(
    "first, second",
    [
        ((jnp.zeros(2),), (jnp.ones(2),)),
        ((np.zeros(2),), (np.ones(2),)),
        ((square, {"a": jnp.zeros(())}), (square, {"a": jnp.ones(())})),
        ((0.1,), (0.1,)),
    ],
)
def test_arguments_of_the_same_signature_are_checked_once(first, second):
    check, seen = counted()
    check(*first)
    check(*second)
    assert len(seen) == 1


@pytest.mark.parametrize(
    "first, second",
    [
        ((jnp.zeros(2),), (jnp.zeros(3),)),
        ((jnp.zeros(2, jnp.float32),), (jnp.zeros(2, jnp.int32),)),
        ((square,), (lambda x: x**2,)),
        ((1,), (1.0,)),
        ((1,), (True,)),
        (((0.1,),), ([0.1],)),
        ((jnp.asarray(0.5),), (jnp.asarray(0.5, jnp.float32),)),
    ],
)
def test_arguments_of_another_signature_are_checked_again(first, second):
    check, seen = counted()
    check(*first)
    check(*second)
    assert len(seen) == 2


def test_arguments_that_fail_are_checked_again():
    check, seen = counted()
    for _ in range(2):
        with pytest.raises(ValueError, match="wrong"):
            check("wrong")
    assert len(seen) == 2


def test_arguments_that_cannot_be_hashed_are_checked_each_time():
    check, seen = counted()
    check(Unhashable())
    check(Unhashable())
    assert len(seen) == 2


class Unhashable:
    __hash__ = None  # type: ignore[assignment]
