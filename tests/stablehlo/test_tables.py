"""Arrays that all paths share stay in memory, and each path reads its own place."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest
from jax import lax

import diffrax_symplectic as ds

from ..drjit_here import needs_drjit
from ..families import slow_except
from .replayed import replayed


pytestmark = needs_drjit

GRID = np.linspace(-4, 4, 300)
MEASURED = -np.cos(GRID)
FORCES = np.sin(np.arange(100_000) / 10)
PHASES = np.exp(1j * GRID)
MAP = np.outer(MEASURED, np.sin(GRID))


def energy(potential):
    return lambda t, p, q, args: p**2 / 2 + potential(t, q, args)


def recorded(t, q, args):
    return q**2 / 2 - q * args[jnp.int32(1000 * t)]


def field(t, q, args):
    place = (q + 4) * 299 / 8
    i = jnp.clip(jnp.int32(place), 0, 298)
    rest = place - i
    return (1 - rest) * args[i, 200 - i // 2] + rest * args[i + 1, 200 - i // 2]


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
    "in a branch": (branched, MEASURED),
    "in branches of several": (mapped, MEASURED),
    "at small indices": (by_bytes, MEASURED),
    "of complex numbers": (rotated, None),
    "constants": (lambda t, q, args: jnp.interp(q, GRID, MEASURED), None),
    "every second entry": (
        lambda t, q, args: jnp.interp(q, GRID[5:290:2], args[5:290:2]),
        MEASURED,
    ),
}


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("name", POTENTIALS)
def test_forces_are_the_same_as_in_jax(name, dtype):
    potential, table = POTENTIALS[name]
    args = None if table is None else jnp.asarray(table, dtype)
    force = jax.grad(lambda q: potential(0.3, q, args))
    q = np.linspace(-3.21, 3.21, 300).astype(dtype)
    (actual,) = replayed(force, q)
    exact = jax.jit(jax.vmap(force))(q)
    np.testing.assert_allclose(actual, exact, rtol=0, atol=200 * np.finfo(dtype).eps)


# As many paths as entries, fewer, and more.
FIELDS = {
    "interpolated": (
        lambda t, q, args: jnp.interp(q, *args), (GRID, MEASURED), 300, jnp.float64
    ),
    "recorded in time": (recorded, FORCES, 40, jnp.float64),
    "field map": (field, MAP, 700, jnp.float32),
}  # fmt: skip


@pytest.mark.parametrize("name", slow_except(["recorded in time"], FIELDS))
def test_paths_are_the_same_as_in_jax(name):
    potential, args, number, dtype = FIELDS[name]
    args = jax.tree.map(lambda x: jnp.asarray(x, dtype), args)
    noise = lambda t, p, q, args: 0.3 * q
    path = ds.WeakBrownianPath(jax.ShapeDtypeStruct((), dtype), jr.key(0))
    terms = ds.hamiltonian_terms(energy(potential), noise, path)
    y0 = (jnp.asarray(0.5, dtype), jnp.asarray(0.7, dtype))
    # A step of a power of two: all times are exact.
    given = terms, ds.StormerVerlet(), 0, 1, 0.125, y0, args
    fused, plain = (
        ds.ensemble(*given, key=jr.key(1), num_paths=number, engine=engine)
        for engine in ("drjit", "jax")
    )
    assert fused.num_failed == 0 and fused.num_stragglers == 0
    for x, y in zip(fused.ys, plain.ys):
        # A path that rounding errors move across a node of the grid differs there.
        close = np.abs(x - y) <= 200 * np.finfo(dtype).eps
        assert np.mean(close) > 0.98


def test_a_table_of_the_paths_own_numbers_is_refused_by_name():
    def potential(t, q, args):
        table = jnp.cos(q + jnp.arange(100.0))
        return table[jnp.int32(10 * q)]

    terms = ds.hamiltonian_terms(
        energy(potential), lambda t, p, q, args: q, ds.WeakBrownianPath((), jr.key(0))
    )
    given = terms, ds.StormerVerlet(), 0, 1, 0.1, (0.0, 1.0)
    with pytest.raises(
        ValueError, match="`stablehlo.*with an index per path, among 100"
    ):
        ds.ensemble(*given, key=jr.key(0), num_paths=10, engine="drjit")


def test_an_error_of_dr_jit_is_reported_with_the_operation(monkeypatch):
    from diffrax_symplectic._stablehlo import operation
    from diffrax_symplectic._stablehlo.operation import NotReplayed

    def mistaken(o, *xs):
        raise TypeError("UInt(-1)")

    monkeypatch.setitem(operation.RULES, "reverse", mistaken)
    with pytest.raises(NotReplayed, match=r"`stablehlo.reverse`.*UInt\(-1\)"):
        replayed(lambda x: x[::-1], np.ones((5, 3)))
