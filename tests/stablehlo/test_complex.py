"""Operations of complex numbers, replayed for many paths, give what JAX gives for each."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import diffrax_symplectic as ds
from diffrax_symplectic._stablehlo import NotReplayed

from ..drjit_here import needs_drjit
from ..families import slow_except
from ..picard import by_picard
from .replayed import replayed, replayed_and_by_jax
from .test_operations import LANES


pytestmark = needs_drjit

SPIN = np.array([[1, 0.3j, 0], [-0.3j, 0, 0.5], [0, 0.5, -1]])


def energy(z):
    polar = jnp.real(jnp.vdot(z, SPIN.astype(z.dtype) @ z))
    return polar + jnp.sum(jnp.abs(z) ** 4) + jnp.sin(jnp.abs(z[0]))


def constant(a):
    return lambda: jnp.asarray(2 + 1j, a.dtype)


# Functions of two vectors of three complex numbers.
CASES = {
    "add": lambda a, b: a + b,
    "subtract": lambda a, b: a - b,
    "multiply": lambda a, b: a * b,
    "multiply by a constant": lambda a, b: a * 2j,
    "divide": lambda a, b: a / b,
    "divide by a real number": lambda a, b: a / jnp.abs(b),
    "negate": lambda a, b: -a,
    "complex, real, imag": lambda a, b: lax.complex(jnp.real(a), jnp.imag(b)),
    "conj": lambda a, b: jnp.conj(a),
    "abs": lambda a, b: jnp.abs(a),
    "angle": lambda a, b: jnp.angle(a),
    "sign": lambda a, b: jnp.sign(a),
    "square": lambda a, b: jnp.square(a),
    "power of a whole number": lambda a, b: a**3,
    "power": lambda a, b: (a + 2) ** b,
    "sqrt": lambda a, b: jnp.sqrt(a),
    "exponential": lambda a, b: jnp.exp(a),
    "log": lambda a, b: jnp.log(a),
    "sine": lambda a, b: jnp.sin(a),
    "cosine": lambda a, b: jnp.cos(a),
    "is_finite": lambda a, b: jnp.isfinite(a),
    "compare": lambda a, b: jnp.stack([a == b, a != b, a == a]),
    "select": lambda a, b: jnp.where(jnp.real(a) > 0, a, b),
    "convert": lambda a, b: jnp.real(b) + a,
    "dot_general": lambda a, b: SPIN.astype(a.dtype) @ a,
    "reduce": lambda a, b: jnp.sum(a * b),
    "gather": lambda a, b: a[np.array([2, 0])],
    "if": lambda a, b: lax.cond(jnp.real(a[0]) > 0, jnp.sin, lambda a: 2 * a, a),
    "while": lambda a, b: lax.fori_loop(0, 20, lambda i, x: x * b / jnp.abs(b), a),
    "constants of branches": lambda a, b: (
        lax.cond(jnp.real(a[0]) > 0, lambda: a * (2 + 1j), lambda: a * 0 + (2 + 1j))
        * lax.cond(jnp.real(a[0]) > 0, constant(a), constant(a))
    ),
    "one constant part": lambda a, b: (
        lax.cond(
            jnp.real(a[0]) > 0,
            lambda: lax.complex(jnp.real(a), jnp.full_like(jnp.real(a), 0.5)),
            lambda: lax.complex(jnp.real(b), jnp.full_like(jnp.real(a), 0.5)),
        )
        ** 2
    ),
    "constants of loops": lambda a, b: lax.while_loop(
        lambda state: state[0] < 9 + jnp.real(a[0]),
        lambda state: (state[0] + 1, constant(a)()),
        (jnp.zeros_like(jnp.real(a[0])), constant(a)() * 2),
    )[1],
    "constants that are not finite": lambda a, b: (
        a * 0 + np.array([np.inf, 1j, 1 + 2j], a.dtype)[1:].sum()
    ),
    "derivative": lambda a, b: jax.grad(energy)(a),
}


@pytest.mark.parametrize(
    "dtype",
    slow_except([np.complex128], [np.complex64, np.complex128]),
    ids=["c64", "c128"],
)
def test_functions_give_what_jax_gives_up_to_rounding(dtype):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, LANES, 3, 2)).view(complex)[..., 0].astype(dtype)
    # On the axes, and at zero.
    a[:5, 0] = [0, 1, -1, 1j, -1j]
    for name, x, y in replayed_and_by_jax(CASES, a, b):
        finite = np.isfinite(y)
        np.testing.assert_array_equal(np.isfinite(x), finite, name)
        # Of masks, too: to zero and one nothing is near.
        error = np.abs(x[finite] * 1 - y[finite] * 1)
        bound = 64 * np.finfo(dtype).eps * (1 + np.abs(y[finite]))
        assert np.all(error <= bound), name


def test_quotients_of_large_and_small_numbers_neither_overflow_nor_vanish():
    size = np.array([1e-200, 1.0, 1e200])[:, None]
    a, b = size * (1 + 2j), size * (3 - 1j)
    (actual,) = replayed(lambda a, b: a / b, a, b)
    np.testing.assert_allclose(actual, np.full((3, 1), (1 + 2j) / (3 - 1j)), rtol=1e-15)


def test_other_functions_of_complex_numbers_are_refused_by_name():
    with pytest.raises(NotReplayed, match="`stablehlo.tan` of complex numbers"):
        replayed(lambda a: lax.tan(a), np.ones((3, 2), complex))


def test_amplitudes_take_the_steps_that_jax_takes():
    def H0(t, psi, args):
        hop = jnp.real(args * psi[0] * jnp.conj(psi[1]))
        return hop + jnp.sum(jnp.abs(psi) ** 4) / 4

    def noise(t, psi, args):
        return 0.1 * jnp.abs(psi[0]) ** 2

    key = jax.random.key(0)
    terms = ds.wave_terms(H0, noise, ds.WeakBrownianPath((), key))
    y0 = ds.to_pair(jnp.array([0.5 + 0.1j, 0.2 + 0.6j]))
    solver = ds.ImplicitMidpoint()
    given = 0, 0.5, 0.1, y0, jnp.asarray(0.3 + 0.1j)
    run = ft.partial(ds.ensemble, terms, key=key, num_paths=50)
    fused, plain = run(solver, *given, engine="drjit"), run(by_picard(solver), *given)
    assert fused.num_failed == 0 and fused.num_stragglers == 0
    for x, y in zip(fused.ys, plain.ys):
        np.testing.assert_allclose(x, y, rtol=0, atol=1e-12)
