"""What a solve costs beside a loop that is written by hand:

    python -m examples.benchmarks.scan

A pendulum with noise in its force, by the Störmer--Verlet method: as a `lax.scan` over
increments that were drawn before, as one that draws each by itself, and by
`diffrax.diffeqsolve`, as in https://github.com/patrick-kidger/diffrax/issues/517. Writes
its part of `docs/benchmarks/index.md`.
"""

import functools as ft
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
from jax import lax

import diffrax_symplectic as ds

from ._timing import keys, machine, race, table, write


STEPS, H, DTYPE = 1000, 1e-4, jnp.float32
BATCH = 1000
LENGTH = jnp.asarray(STEPS * H, DTYPE)
STRUCT = jax.ShapeDtypeStruct((), DTYPE)


def verlet(y, dw):
    """A step of dp = -sin(q) dt - cos(q) dw / 5, dq = p dt."""
    p, q = y
    h = jnp.asarray(H, DTYPE)
    q = q + h / 2 * p
    p = p - h * jnp.sin(q) - dw * jnp.cos(q) / 5
    return p, q + h / 2 * p


Y0 = (jnp.zeros((), DTYPE), jnp.ones((), DTYPE))
ROOT = jnp.asarray(H, DTYPE) ** 0.5


def scan_drawn(key):
    increments = ROOT * jr.normal(key, (STEPS,), DTYPE)
    return lax.scan(lambda y, dw: (verlet(y, dw), None), Y0, increments)[0]


def scan_drawing(key):
    """Each step splits the key, and draws an increment."""

    def body(carry, _):
        y, key = carry
        key, now = jr.split(key)
        return (verlet(y, ROOT * jr.normal(now, (), DTYPE)), key), None

    return lax.scan(body, (Y0, key), None, length=STEPS)[0][0]


def solve(make_path):
    """Takes a key to the end of a path."""

    def end(key):
        terms = ds.hamiltonian_terms(
            lambda t, p, q, args: p**2 / 2 - jnp.cos(q),
            lambda t, p, q, args: jnp.sin(q) / 5,
            make_path(key),
        )
        zero, h = jnp.zeros((), DTYPE), jnp.asarray(H, DTYPE)
        options: dict[str, Any] = dict(
            max_steps=None, adjoint=diffrax.ForwardMode(), throw=False
        )
        solver = ds.StormerVerlet()
        return diffrax.diffeqsolve(terms, solver, zero, LENGTH, h, Y0, **options).ys

    return end


fixed = lambda key: ds.FixedStepBrownianPath(STRUCT, key)
unsafe = lambda key: diffrax.UnsafeBrownianPath(STRUCT, key)
tree = lambda key: diffrax.VirtualBrownianTree(0, LENGTH, H / 2, STRUCT, key)
WAYS = {
    "scan, all increments drawn at once": scan_drawn,
    "scan, splitting a key and drawing in each step": scan_drawing,
    "solve, `FixedStepBrownianPath`": solve(fixed),
    "solve, `diffrax.UnsafeBrownianPath`": solve(unsafe),
    "solve, `diffrax.VirtualBrownianTree`": solve(tree),
}


def main() -> None:
    one = {name: ft.partial(jax.jit(fn), keys(1)[0]) for name, fn in WAYS.items()}
    all_keys = keys(BATCH)
    many = {
        name: ft.partial(jax.jit(jax.vmap(fn)), all_keys) for name, fn in WAYS.items()
    }
    alone, each = race(one, 15), race(many)
    rows = []
    for name in WAYS:
        one_step = alone[name] / STEPS * 1e9
        of_many = each[name] / STEPS / BATCH * 1e9
        rows.append((name, f"{one_step:,.0f}", f"{of_many:,.1f}"))
    lines = [
        "A solve costs less than a scan that splits a key and draws in each step: a path "
        "takes one hash of the key and the time. Nanoseconds per step of a pendulum, "
        f"{STEPS:,} steps in float32. {machine()}.",
        "",
        *table(("", "one path", f"per path, of {BATCH:,}"), rows),
    ]
    write("examples.benchmarks.scan", lines)


if __name__ == "__main__":
    main()
