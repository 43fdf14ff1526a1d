"""Nanoseconds per path and step of solvers for any system, next to Diffrax's:

    python -m examples.benchmarks.speed

In one run, so that ratios mean something on a noisy machine. Writes its part of
`docs/benchmarks/index.md`.
"""

import functools as ft
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr

import diffrax_symplectic as ds

from ._timing import ensemble, keys, machine, race, table, write


H, STEPS = 0.01, 200
PATHS = 1_000
Y0 = (jnp.array(0.0), jnp.array(1.0))


def unsafe(shape, key):
    return diffrax.UnsafeBrownianPath(shape, key)


def gaussian(shape, key):
    return ds.FixedStepBrownianPath(shape, key)


def quartic(t, p, q, args):
    return (p**2 + q**2) / 2 + (p**4 + q**4) / 10


def kubo(path):
    return ds.hamiltonian_terms(quartic, lambda *args: 0.3 * quartic(*args), path)


def by_hand(keys):
    """The midpoint rule on `kubo` in a bare `lax.scan`: three-point numbers drawn inside
    the loop, three Newton iterations, no check of anything."""
    gradient = jax.grad(lambda p, q: quartic(0, p, q, None), argnums=(0, 1))
    size = jnp.sqrt(3 * H)

    def one(key):
        def step(y, i):
            p, q = y
            bits = jr.bits(jr.fold_in(key, i), (), jnp.uint32)
            up = jnp.where(bits >= jnp.uint32(2**32 - 2**32 // 6), size, 0.0)
            x = H + 0.3 * jnp.where(bits < jnp.uint32(2**32 // 6), -size, up)

            def residual(kp, kq):
                dp, dq = gradient(p + kp / 2, q + kq / 2)
                return kp + x * dq, kq - x * dp

            dp, dq = gradient(p, q)
            kp, kq = -x * dq, x * dp
            for _ in range(3):
                (rp, rq), jacobian = jax.linearize(residual, kp, kq)
                (a, c), (b, d) = jacobian(1.0, 0.0), jacobian(0.0, 1.0)
                det = a * d - b * c
                kp, kq = kp - (d * rp - b * rq) / det, kq - (a * rq - c * rp) / det
            return (p + kp, q + kq), None

        return jax.lax.scan(step, Y0, jnp.arange(STEPS))[0]

    return jax.vmap(one)(keys)


SOLVERS = {
    "Heun, `UnsafeBrownianPath`": (diffrax.Heun(), unsafe),
    "Heun": (diffrax.Heun(), gaussian),
    "SlowRK": (diffrax.SlowRK(), ds.SRKs4().path),
    "midpoint rule by hand": None,
    "ImplicitMidpoint": (ds.ImplicitMidpoint(), ds.WeakBrownianPath),
    "ImplicitMidpoint, truncated increments": (
        ds.ImplicitMidpoint(),
        ds.ImplicitMidpoint().path,
    ),
    "SRKw2": (ds.SRKw2(), ds.WeakBrownianPath),
    "StrangGauss": (ds.StrangGauss(), ds.WeakBrownianPath),
}


def solve(name: str) -> Callable:
    """From nothing to the ends of all paths, compiled."""
    case, own = SOLVERS[name], keys(PATHS)
    fn = by_hand
    if case is not None:
        solver, path = case
        fn = ensemble(kubo, lambda key: path((), key), solver, Y0, H, STEPS)
    return ft.partial(jax.jit(lambda keys: fn(keys)).lower(own).compile(), own)


def main() -> None:
    seconds = race({name: solve(name) for name in SOLVERS})
    each = {name: x / PATHS / STEPS * 1e9 for name, x in seconds.items()}
    ratio = each["ImplicitMidpoint"] / each["Heun, `UnsafeBrownianPath`"]
    lines = [
        f"The midpoint rule with weak increments costs {ratio:.2f} of a step of `Heun` "
        "with Diffrax's `UnsafeBrownianPath`. Nanoseconds per path and step of a quartic "
        f"Kubo oscillator: {PATHS:,} paths, {STEPS} steps of $h = {H}$, float64, best of 7 "
        "runs; Diffrax's solvers with Gaussian increments from `FixedStepBrownianPath`, "
        f"the others with weak ones, unless noted. {machine()}.",
        "",
        *table(("solver", "ns"), [(name, f"{x:.1f}") for name, x in each.items()]),
    ]
    write("examples.benchmarks.speed", lines)


if __name__ == "__main__":
    main()
