"""Calls of LAPACK that could run side by side wait for each other, and change nothing."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

from diffrax_symplectic import _lapack
from diffrax_symplectic._compat import Literal, programs_in
from diffrax_symplectic._lapack import lapack_in_turn


def solution(x, shift):
    matrix = 2 * jnp.eye(3) + 0.1 * jnp.cos(x[:, None] - x + shift)
    return jnp.linalg.solve(matrix, x)


def root(x, shift):
    return jnp.linalg.cholesky(jnp.diag(1 + x**2 + shift)) @ x


@jax.custom_jvp
def spectrum(x):
    return jnp.linalg.eigvalsh(x[:, None] * x)


@spectrum.defjvp
def _(primals, tangents):
    return spectrum(*primals), tangents[0]


def side_by_side(x):
    return solution(x, 0) + solution(x, 1) + spectrum(x) + jax.jit(root)(x, 1)


def in_loops(x):
    def body(carry):
        n, y, key = carry
        key, new = jr.split(key)
        y = solution(y, n) + root(y, 1) + 0.1 * jr.normal(new)
        return n + 1, y / 2, key

    # In a batch, the paths do not agree on when this ends.
    enough = lambda carry: (jnp.sum(carry[1]) > 1) & (carry[0] < 5)
    first, *_ = carry = jax.lax.while_loop(enough, body, (0, x, jr.key(1)))
    over = lambda y, shift: (solution(y, shift) - root(y, shift), jnp.sum(y))
    y, sums = jax.lax.scan(over, carry[1], jnp.arange(3.0))
    z = jax.lax.cond(jnp.max(x) > 1, root, solution, x, 0.5)
    return first, y, sums, z + solution(x, 2)


def side_by_side_calls(jaxpr):
    """How many calls of LAPACK, in a program and all programs in it, do not depend on the
    call before."""
    count = 0
    # The number of the last call that each value depends on.
    last = {}
    calls = 0
    for eqn in jaxpr.eqns:
        inputs = [x for x in eqn.invars if not isinstance(x, Literal)]
        known = max([last.get(x, 0) for x in inputs], default=0)
        if _lapack._calls_lapack(eqn):
            count += known < calls
            calls += 1
            known = calls
            count += sum(map(side_by_side_calls, programs_in(eqn)))
        last.update(dict.fromkeys(eqn.outvars, known))
    return count


def test_the_results_are_the_same_and_each_call_waits(monkeypatch):
    monkeypatch.setattr(_lapack, "has_blocking_lapack", lambda: True)
    x = jr.normal(jr.key(0), (4, 3))
    batch = jax.vmap(lambda x: (side_by_side(x), in_loops(x)))
    in_turn = lapack_in_turn(batch)
    found, expected = (jax.tree.leaves(jax.jit(fn)(x)) for fn in (in_turn, batch))
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_array_equal(a, b)
    assert side_by_side_calls(jax.make_jaxpr(in_turn)(x).jaxpr) == 0
    assert side_by_side_calls(jax.make_jaxpr(batch)(x).jaxpr) > 0


def test_a_function_without_lapack_stays_as_it_is(monkeypatch):
    monkeypatch.setattr(_lapack, "has_blocking_lapack", lambda: True)
    fn = jax.vmap(lambda x: jax.lax.fori_loop(0, 3, lambda i, x: jnp.sin(x) + i, x))
    x = jnp.linspace(0, 1, 4)
    plain, in_turn = (jax.jit(f).lower(x).as_text() for f in (fn, lapack_in_turn(fn)))
    assert in_turn == plain


@pytest.mark.parametrize("name", ["cholesky", "eigh", "eigvals", "inv", "qr", "svd"])
def test_functions_of_matrices_are_known_to_call_lapack(name):
    jaxpr = jax.make_jaxpr(getattr(jnp.linalg, name))(jnp.eye(2))
    assert any(map(_lapack._calls_lapack, jaxpr.eqns))
