"""Ten million paths of 100 steps through `monte_carlo`: time, memory, cores in use:

    python -m examples.benchmarks.ensemble

Prints the figures in `docs/benchmarks/index.md`.
"""

import os
import resource
import time

import jax.random as jr

import diffrax_symplectic as ds

from ._timing import ensemble, machine
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
    print(machine())
    print(
        f"{seconds:.1f} s, {seconds / PATHS / STEPS * 1e9:.1f} ns per path and step, "
        f"{busy / seconds / (os.cpu_count() or 1):.0%} of the cores, {peak:.2f} GiB, "
        f"E q^2 = {estimate.mean:.6f} ± {estimate.std_error:.6f}"
    )


if __name__ == "__main__":
    main()
