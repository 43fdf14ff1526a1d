"""How cost grows with degrees of freedom, noises and steps:

    python -m examples.benchmarks.growth

A chain of d oscillators with quartic springs and m noises, 64 paths. Writes
`docs/benchmarks/growth.md`.
"""

import diffrax
import jax.numpy as jnp

import diffrax_symplectic as ds

from ._timing import DOCS, ensemble, keys, machine, measure


PATHS, H = 64, 0.01


def chain(path):
    m = path.shape.shape[0]

    def H0(t, p, q, args):
        stretch = jnp.diff(q, prepend=0.0, append=0.0)
        return jnp.sum(p**2) / 2 + jnp.sum(stretch**2 / 2 + stretch**4 / 4)

    def noise(t, p, q, args):
        # Each noise acts on all of the chain, with a wave number of its own.
        waves = jnp.cos(jnp.outer(jnp.arange(1, m + 1), jnp.arange(q.size)))
        return 0.1 * waves @ jnp.cos(q) / m

    return ds.hamiltonian_terms(H0, noise, path)


def row(d: int, m: int, steps: int) -> list[str]:
    y0 = (jnp.zeros(d), jnp.sin(jnp.arange(d) + 1.0))
    weak = lambda key: ds.WeakBrownianPath((m,), key)
    gaussian = lambda key: diffrax.UnsafeBrownianPath((m,), key)
    cells = [str(d), str(m), f"{steps:,}"]
    for solver, path in (
        (diffrax.Heun(), gaussian),
        (ds.Midpoint(), weak),
        (ds.SRKw3("c"), weak),
        (ds.SRKw2(), weak),
    ):
        fn = ensemble(chain, path, solver, y0, H, steps)
        timing = measure(fn, keys(PATHS), repeats=3)
        microseconds = timing.seconds / PATHS / steps * 1e6
        cells.append(f"{microseconds:.2f} ({timing.trace + timing.compile:.1f})")
    return cells


def main() -> None:
    lines = [
        "# Growth of cost",
        "",
        f"{machine()}. float64, a chain of d oscillators, m noises, h = {H}, {PATHS} "
        "paths. Microseconds per path and step, and in brackets seconds to compile. Made "
        "by `python -m examples.benchmarks.growth`.",
        "",
        '| d | m | steps | Diffrax Heun | Midpoint | SRKw3("c") | SRKw2 |',
        "|---" * 7 + "|",
    ]
    cases = [(d, 1, 50) for d in (1, 4, 16, 64, 256)]
    cases += [(16, m, 50) for m in (2, 4, 16)]
    cases += [(4, 1, steps) for steps in (500, 5000)]
    for case in cases:
        lines.append("| " + " | ".join(row(*case)) + " |")
        print(lines[-1], flush=True)
    DOCS.mkdir(parents=True, exist_ok=True)
    (DOCS / "growth.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
