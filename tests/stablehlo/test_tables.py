"""Arrays that all paths share stay in memory, and each path reads its own place."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax import lax

import diffrax_symplectic as ds
from diffrax_symplectic._stablehlo import NotReplayed
from diffrax_symplectic._stablehlo.operation import RULES

from ..drjit_here import needs_drjit
from .replayed import replayed, replayed_and_by_jax


pytestmark = needs_drjit

GRID = np.linspace(-4, 4, 300)
MEASURED = -np.cos(GRID)
FORCES = np.sin(np.arange(100_000) / 10)
PHASES = np.exp(1j * GRID)
MAP = np.outer(MEASURED, np.sin(GRID))


def recorded(t, q, args):
    return q**2 / 2 - q * args[jnp.int32(1000 * t)]


def field(t, q, args):
    table = jnp.asarray(MAP, q.dtype)
    place = (q + 4) * 299 / 8
    i = jnp.clip(jnp.int32(place), 0, 298)
    rest = place - i
    return (1 - rest) * table[i, 200 - i // 2] + rest * table[i + 1, 200 - i // 2]


def branched(t, q, args):
    read = lambda q: q * args[jnp.int32(30 * jnp.abs(q)) % 300]
    return lax.cond(q > 0, read, lambda q: q * args[3], q)


def mapped(t, q, args):
    return jnp.sum(jax.vmap(lambda q: branched(t, q, args))(jnp.stack([q, -q / 2])))


def by_bytes(t, q, args):
    place = jnp.floor(40 * jnp.abs(lax.stop_gradient(q)))
    one = args[place.astype(jnp.int8)]
    return q * one + q * args[299 - place.astype(jnp.uint8)] / 3


def rotated(t, q, args):
    phases = jnp.asarray(PHASES, jnp.result_type(q, jnp.complex64))
    return jnp.real(lax.complex(q, q**2) * phases[jnp.int32(40 * jnp.abs(q)) % 300])


POTENTIALS = {
    "of two axes": field,
    "in a branch": branched,
    "in branches of several": mapped,
    "at small indices": by_bytes,
    "of complex numbers": rotated,
    "constants": lambda t, q, args: jnp.interp(q, GRID, MEASURED),
    "every second entry": lambda t, q, args: jnp.interp(
        q, GRID[5:290:2], args[5:290:2]
    ),
}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_forces_are_the_same_as_in_jax(dtype):
    args = jnp.asarray(MEASURED, dtype)
    forces = {
        name: jax.grad(lambda q, potential=potential: potential(0.3, q, args))
        for name, potential in POTENTIALS.items()
    }
    q = np.linspace(-3.21, 3.21, 300).astype(dtype)
    atol = 200 * np.finfo(dtype).eps
    for name, x, y in replayed_and_by_jax(forces, q):
        np.testing.assert_allclose(x, y, rtol=0, atol=atol, err_msg=name)


def test_paths_along_a_recorded_force_are_the_same_as_in_jax():
    energy = lambda t, p, q, args: p**2 / 2 + recorded(t, q, args)
    path = ds.WeakBrownianPath((), jr.key(0))
    terms = ds.hamiltonian_terms(energy, lambda t, p, q, args: 0.3 * q, path)
    # A step of a power of two: all times are exact.
    given = terms, ds.StormerVerlet(), 0, 1, 0.125, (0.5, 0.7), jnp.asarray(FORCES)
    fused, plain = (
        ds.ensemble(*given, key=jr.key(1), num_paths=40, engine=engine)
        for engine in ("drjit", "jax")
    )
    assert fused.num_failed == 0 and fused.num_stragglers == 0
    np.testing.assert_allclose(
        fused.ys, plain.ys, rtol=0, atol=200 * np.finfo(float).eps
    )


def test_an_error_of_dr_jit_is_reported_with_the_operation(monkeypatch):
    def mistaken(o, *xs):
        raise TypeError("UInt(-1)")

    monkeypatch.setitem(RULES, "reverse", mistaken)
    with pytest.raises(NotReplayed, match=r"`stablehlo.reverse`.*UInt\(-1\)"):
        replayed(lambda x: x[::-1], np.ones((5, 3)))
