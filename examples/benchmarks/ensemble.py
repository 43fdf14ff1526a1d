"""Ten million paths of 100 steps through `monte_carlo`: time, memory, cores in use:

    python -m examples.benchmarks.ensemble

Writes `docs/benchmarks/ensemble.md`.
"""

import os
import resource
import time

import jax.random as jr

import diffrax_symplectic as ds

from ._timing import DOCS, ensemble, machine
from .speed import kubo, weak, Y0


PATHS, STEPS, H = 10**7, 100, 0.01


def main() -> None:
    solve = ensemble(kubo, weak, ds.ImplicitMidpoint(), Y0, H, STEPS)

    def phi(key):
        _, q = solve(key[None])
        return q[-1] ** 2

    ds.monte_carlo(phi, key=jr.key(1), num_paths=10**6)  # compiles
    begin, before = time.perf_counter(), os.times()
    estimate = ds.monte_carlo(phi, key=jr.key(0), num_paths=PATHS)
    seconds, after = time.perf_counter() - begin, os.times()
    busy = after.user + after.system - before.user - before.system
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    lines = [
        "# A large ensemble",
        "",
        f"{machine()}. ImplicitMidpoint on the quartic Kubo "
        f"oscillator, {PATHS:,} paths of {STEPS} steps through `monte_carlo`. Made by "
        "`python -m examples.benchmarks.ensemble`.",
        "",
        "| seconds | ns per path and step | cores busy | peak memory | $\\mathbb E q^2$ |",
        "|---" * 5 + "|",
        f"| {seconds:.1f} | {seconds / PATHS / STEPS * 1e9:.1f} | "
        f"{busy / seconds / (os.cpu_count() or 1):.0%} | {peak:.2f} GiB | "
        f"{estimate.mean:.6f} ± {estimate.std_error:.6f} |",
    ]
    print(lines[-1])
    DOCS.mkdir(parents=True, exist_ok=True)
    (DOCS / "ensemble.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
