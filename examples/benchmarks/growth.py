"""How cost grows with degrees of freedom, and with noises:

    python -m examples.benchmarks.growth

Writes `docs/benchmarks/growth.md`.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_symplectic as ds

from ._timing import DOCS, keys, machine, race


PATHS, H, STEPS = 64, 0.01, 100
HEUN = diffrax.Heun()


def chain(path, d: int):
    """Quartic springs between fixed ends; the noise stretches the phase space."""

    def H0(t, p, q, args):
        stretch = jnp.diff(q, prepend=0.0, append=0.0)
        return jnp.sum(p**2) / 2 + jnp.sum(stretch**2 / 2 + stretch**4 / 4)

    return ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.1 * jnp.sum(p * q), path)


def ring(path, d: int):
    """A Schroedinger lattice with a cubic nonlinearity and multiplicative noise: not
    separable, with couplings between neighbours only."""

    def H0(t, p, q, args):
        bonds = jnp.sum((p - jnp.roll(p, 1)) ** 2 + (q - jnp.roll(q, 1)) ** 2)
        return bonds / 2 + jnp.sum((p**2 + q**2) ** 2) / 4

    noise = lambda t, p, q, args: 0.1 * jnp.sum(p**2 + q**2)
    return ds.hamiltonian_terms(H0, noise, path)


def network(path, d: int):
    """A network of one layer of 2 d neurons as the potential: every coordinate acts on
    every other, and matrix products are most of the cost."""
    weights = np.random.default_rng(d).normal(size=(2 * d, d)) / np.sqrt(d)
    out = np.random.default_rng(d + 1).normal(size=2 * d)

    def H0(t, p, q, args):
        return jnp.sum(jnp.sqrt(1 + p**2)) + jnp.tanh(weights @ q) @ out

    return ds.hamiltonian_terms(H0, lambda t, p, q, args: 0.1 * jnp.sum(p * q), path)


def solve(system: Callable, d: int, solver) -> Callable:
    """Takes a key and the initial positions to a function of the end of the path."""

    def end(key, q0):
        terms = system(ds.WeakBrownianPath((), key), d)
        y0 = (jnp.zeros(d), q0)
        sol = diffrax.diffeqsolve(terms, solver, 0.0, H * STEPS, H, y0, max_steps=STEPS)
        assert sol.ys is not None
        return jnp.sum(sol.ys[1][-1] ** 2)

    return jax.vmap(end, (0, None))


class Program(NamedTuple):
    """A compiled program as a call, the processor time of tracing and compiling it, and the
    bytes that it sets aside."""

    call: Callable
    preparation: float
    memory: int


def program(fn: Callable, d: int, paths: int = PATHS, repeats: int = 1) -> Program:
    args = keys(paths), jnp.sin(jnp.arange(d) + 1.0)

    def prepare():
        jax.clear_caches()
        begin = time.process_time()
        compiled = jax.jit(lambda *args: fn(*args)).lower(*args).compile()
        return time.process_time() - begin, compiled

    attempts = [prepare() for _ in range(repeats)]
    compiled = attempts[0][1]
    memory: Any = compiled.memory_analysis()
    call = lambda: jax.block_until_ready(compiled(*args))
    return Program(call, min(t for t, _ in attempts), memory.temp_size_in_bytes)


def row(system: Callable, d: int) -> list[str]:
    fn = lambda solver: solve(system, d, solver)

    def gradient(solver):
        mean = lambda keys: lambda q0: jnp.mean(fn(solver)(keys, q0))
        return lambda keys, q0: jax.value_and_grad(mean(keys))(q0)

    # Compilation of one program differs by a tenth from run to run.
    repeats = 2 if d <= 16 else 1
    solvers = {"Heun": HEUN, "ImplicitMidpoint": ds.ImplicitMidpoint()}
    programs = {
        name: program(fn(solver), d, repeats=repeats)
        for name, solver in solvers.items()
    }
    seconds = race({name: p.call for name, p in programs.items()})
    heun, ours = programs.values()
    ratio = lambda a, b: f"{a / b:.1f}"
    slopes = "–"
    if d <= 1024:
        pair = {name: program(gradient(s), d) for name, s in solvers.items()}
        times = race({name: p.call for name, p in pair.items()})
        slopes = ratio(times["ImplicitMidpoint"], times["Heun"])
    return [
        str(d),
        f"{seconds['Heun'] / PATHS / STEPS * 1e6:.2f}",
        ratio(seconds["ImplicitMidpoint"], seconds["Heun"]),
        ratio(ours.preparation, heun.preparation),
        slopes,
        ratio(ours.memory, heun.memory),
    ]


def many_noises(m: int) -> list[str]:
    """The chain of 16 with `m` noises, each with a wave number of its own."""
    waves = jnp.cos(jnp.outer(jnp.arange(1, m + 1), jnp.arange(16)))

    def end(solver):
        def end(key, q0):
            noise = lambda t, p, q, args: 0.1 * waves @ jnp.cos(q) / m
            drift = lambda t, p, q, args: jnp.sum(p**2 + q**2) / 2 + jnp.sum(q**4) / 4
            terms = ds.hamiltonian_terms(drift, noise, ds.WeakBrownianPath((m,), key))
            y0 = (jnp.zeros(16), q0)
            sol = diffrax.diffeqsolve(terms, solver, 0.0, H * STEPS, H, y0)
            assert sol.ys is not None
            return sol.ys[1][-1]

        return jax.vmap(end, (0, None))

    solvers = {
        "Heun": HEUN,
        "ImplicitMidpoint": ds.ImplicitMidpoint(),
        "SRKw3": ds.SRKw3("c"),
        "SRKw2": ds.SRKw2(),
    }
    seconds = race({name: program(end(s), 16).call for name, s in solvers.items()})
    unit = PATHS * STEPS * 1e-6
    return [str(m), *(f"{seconds[name] / unit:.2f}" for name in solvers)]


CASES = {
    "chain, quartic springs": (chain, (1, 256, 1024, 4096)),
    "Schrödinger ring": (ring, (1, 16, 1024)),
    "network as the potential": (network, (4, 64, 256)),
}
COLUMNS = ("$d$", "Heun, µs", "time", "compile", "value and gradient", "memory")
INTRODUCTION = """\
`ImplicitMidpoint` costs {least} to {most} times as much as Diffrax's `Heun`, from 1 to
4,096 degrees of freedom $d$.

Cost relative to `Heun` (its own µs per path and step in the second column); {steps} steps
of $h = {h}$, {paths} paths, float64, three-point increments. {machine}. Made by `python -m
examples.benchmarks.growth`.
"""


def main() -> None:
    lines = [f"| {' | '.join(COLUMNS)} |", "|---" * len(COLUMNS) + "|"]
    ratios = []
    for title, (system, sizes) in CASES.items():
        lines.append(f"| **{title}** |" + " |" * (len(COLUMNS) - 1))
        for d in sizes:
            cells = row(system, d)
            ratios.append(float(cells[COLUMNS.index("time")]))
            lines.append(f"| {' | '.join(cells)} |".replace("|  |", "| |"))
            print(lines[-1], flush=True)
    lines.append("")
    lines += [
        "## Many noises",
        "",
        "Microseconds per path and step for 16 oscillators with $m$ noises:",
        "",
        '| $m$ | Heun | ImplicitMidpoint | SRKw3("c") | SRKw2 |',
        "|---" * 5 + "|",
    ]
    for m in (1, 16):
        lines.append("| " + " | ".join(many_noises(m)) + " |")
        print(lines[-1], flush=True)
    text = INTRODUCTION.format(
        machine=machine(), h=H, steps=STEPS, paths=PATHS,
        least=min(ratios), most=max(ratios),
    )  # fmt: skip
    lines = ["# Growth of cost", "", text, *lines]
    DOCS.mkdir(parents=True, exist_ok=True)
    (DOCS / "growth.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
