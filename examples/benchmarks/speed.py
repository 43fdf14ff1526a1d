"""Nanoseconds per path and step, and seconds to compile, of every solver:

    python -m examples.benchmarks.speed

In one run, so that ratios mean something on a noisy machine. Writes
`docs/benchmarks/speed.md`.
"""

import functools as ft
import time
from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr

import diffrax_symplectic as ds

from . import calls
from ._timing import DOCS, ensemble, keys, machine, race


H, STEPS = 0.01, 200
PATHS = 1_000
Y0 = (jnp.array(0.0), jnp.array(1.0))


def weak(key, shape=(), **kwargs):
    return ds.WeakBrownianPath(shape, key, **kwargs)


def unsafe(key, shape=()):
    return diffrax.UnsafeBrownianPath(shape, key)


def gaussian(key, shape=()):
    return ds.FixedStepBrownianPath(shape, key)


def with_area(key, shape=()):
    return ds.SRKs4().path(shape, key)


def truncated(key):
    return ds.ImplicitMidpoint().path((), key)


def quartic(t, p, q, args):
    return (p**2 + q**2) / 2 + (p**4 + q**4) / 10


def kubo(path):
    return ds.hamiltonian_terms(quartic, lambda *args: 0.3 * quartic(*args), path)


def synchrotron(path):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: p**2 / 2 - 4 * jnp.cos(q),
        lambda t, p, q, args: jnp.stack([0.2 * jnp.sin(q), -0.1 * jnp.cos(q)]),
        path,
    )


def two_noises(path):
    return ds.hamiltonian_terms(
        quartic,
        lambda t, p, q, args: 0.2 * jnp.stack([quartic(t, p, q, args), p * q]),
        path,
    )


def additive(path):
    return ds.hamiltonian_terms(quartic, lambda t, p, q, args: -0.3 * q, path)


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


def plateaus(key):
    return ds.PlateauVerlet().path((2,), key)


def levy_areas(key):
    return ds.LevyAreaMidpoint().path((2,), key)


two = lambda path: lambda key: path(key, (2,))
MODELS = {
    "Quartic Kubo oscillator, one multiplicative noise": (
        kubo,
        [
            ("Heun, `UnsafeBrownianPath`", diffrax.Heun(), unsafe),
            ("Heun", diffrax.Heun(), gaussian),
            ("SlowRK", diffrax.SlowRK(), with_area),
            ("midpoint rule by hand", None, None),
            ("ImplicitMidpoint", ds.ImplicitMidpoint(), weak),
            (
                "ImplicitMidpoint, truncated increments",
                ds.ImplicitMidpoint(),
                truncated,
            ),
            ("SRKs1", ds.SRKs1(), weak),
            ("SRKw1", ds.SRKw1(), weak),
            ("SRKw2", ds.SRKw2(), weak),
            ("StrangGauss", ds.StrangGauss(), weak),
        ],
    ),
    "Synchrotron oscillations, two noises in the potential": (
        synchrotron,
        [
            ("Heun, `UnsafeBrownianPath`", diffrax.Heun(), two(unsafe)),
            ("Heun", diffrax.Heun(), two(gaussian)),
            ("ImplicitMidpoint", ds.ImplicitMidpoint(), two(weak)),
            ("SRKs2", ds.SRKs2(), two(weak)),
            ("SRKs3", ds.SRKs3(), two(weak)),
            ('SRKw3("c")', ds.SRKw3("c"), two(weak)),
            ("SRKw4", ds.SRKw4(), two(weak)),
            ("StormerVerlet", ds.StormerVerlet(), two(weak)),
            ("PlateauVerlet", ds.PlateauVerlet(), plateaus),
        ],
    ),
    "Quartic oscillator, two noises that do not commute": (
        two_noises,
        [
            ("Heun, `UnsafeBrownianPath`", diffrax.Heun(), two(unsafe)),
            ("Heun", diffrax.Heun(), two(gaussian)),
            ("ImplicitMidpoint", ds.ImplicitMidpoint(), two(weak)),
            (
                "NinomiyaVictoir",
                ds.NinomiyaVictoir(),
                lambda key: weak(key, (2,), two_point=True),
            ),
            ("LevyAreaMidpoint", ds.LevyAreaMidpoint(), levy_areas),
        ],
    ),
    "Quartic oscillator, additive noise": (
        additive,
        [
            ("Heun, `UnsafeBrownianPath`", diffrax.Heun(), unsafe),
            ("Heun", diffrax.Heun(), gaussian),
            ("ShARK", diffrax.ShARK(), with_area),
            ("SRKw5", ds.SRKw5(), lambda key: weak(key, second=True)),
            ("AdditiveGauss", ds.AdditiveGauss(), lambda key: weak(key, order=3)),
            ("SRKs4", ds.SRKs4(), with_area),
        ],
    ),
}


def measure(make_terms: Callable, solvers: list) -> tuple[dict, dict]:
    """The seconds of each solver, and the processor time of tracing and compiling it."""
    calls, preparation = {}, {}
    for name, solver, make_path in solvers:
        fn = by_hand
        if solver is not None:
            fn = ensemble(make_terms, make_path, solver, Y0, H, STEPS)
        begin = time.process_time()
        compiled = jax.jit(lambda keys, fn=fn: fn(keys)).lower(keys(PATHS)).compile()
        preparation[name] = time.process_time() - begin
        calls[name] = ft.partial(compiled, keys(PATHS))
    return race(calls), preparation


# Measured by hand.
SINGLE_PATH = [
    "",
    "## A single path",
    "",
    "A step of `ImplicitMidpoint` for a single path of the Kubo oscillator takes 1,487 ns "
    "with JAX 0.10, and 322 ns with JAX 0.12 (two CPU cores; 2026-11-26). With JAX 0.10, "
    "an option internal to XLA gives 328 ns: "
    "`XLA_FLAGS=--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000`.",
    "",
    "## A solve against a scan by hand",
    "",
    "A solve costs less than a scan that splits a key and draws in each step: a path takes "
    "one hash of the key and the time. Nanoseconds per step of a pendulum, 1,000 steps in "
    "float32 (two idle cores, AMD EPYC; 2026-11-28). Made by `python -m "
    "examples.benchmarks.scan`.",
    "",
    "| | one path | per path, of 1,000 |",
    "|---|---|---|",
    "| scan, all increments drawn at once | 149 | 7.6 |",
    "| scan, splitting a key and drawing in each step | 357 | 56.8 |",
    "| solve, `FixedStepBrownianPath` | 55 | 14.3 |",
    "| solve, `diffrax.UnsafeBrownianPath` | 777 | 51.2 |",
    "| solve, `diffrax.VirtualBrownianTree` | 11,200 | 1,500 |",
]


def conclusion(times: dict[str, float]) -> str:
    """The first sentence, from the seconds of the first system."""
    ratio = times["ImplicitMidpoint"] / times["Heun, `UnsafeBrownianPath`"]
    return (
        f"The midpoint rule with weak increments costs {ratio:.2f} of a step of `Heun` "
        "with Diffrax's `UnsafeBrownianPath`. (Each part of this page names its own "
        "machine.)"
    )


def main() -> None:
    head = ["system", "solver", "ns", "compile, s"]
    lines = [
        "# Speed",
        "",
        "CONCLUSION",
        "",
        f"Nanoseconds per path and step: {PATHS:,} paths, {STEPS} steps of $h = {H}$, "
        "float64, best of 7 runs; Gaussian increments from `FixedStepBrownianPath` unless "
        f"noted; compilation in processor seconds. {machine()}. Made by `python -m "
        "examples.benchmarks.speed`.",
        "",
        f"| {' | '.join(head)} |",
        "|---" * len(head) + "|",
    ]
    for title, (make_terms, solvers) in MODELS.items():
        times, preparation = measure(make_terms, solvers)
        if "CONCLUSION" in lines:
            lines[lines.index("CONCLUSION")] = conclusion(times)
        for name, *_ in solvers:
            nanoseconds = times[name] / PATHS / STEPS * 1e9
            row = [f"{nanoseconds:,.1f}", f"{preparation[name]:.2f}"]
            lines.append(
                f"| {' | '.join([title, name, *row])} |".replace("|  |", "| |")
            )
            print(lines[-1], flush=True)
            title = ""  # only in the first row of a system
    DOCS.mkdir(parents=True, exist_ok=True)
    page = DOCS / "speed.md"
    # What follows is made by `calls.py`.
    _, *rest = page.read_text().split(calls.HEADING) if page.exists() else [""]
    lines += SINGLE_PATH
    lines += ["", calls.HEADING + rest[0].rstrip()] if rest else []
    page.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
