"""What a looser tolerance of the root finder saves, and what it costs in drift:

    python -m examples.benchmarks.tolerance

Prints the table of `docs/root_finders.md`.
"""

import diffrax
import jax
import jax.numpy as jnp

import diffrax_symplectic as ds

from ._timing import keys, machine, measure


PATHS, H, STEPS = 64, 0.1, 2_000
TOLERANCES = (None, 1e-12, 1e-8, 1e-6, 1e-4)


def solve(d: int, rtol: float | None):
    """Takes keys to the relative change of the invariant |p|^2 + |q|^2, for a ring of
    oscillators that are coupled by it."""
    square = lambda p, q: jnp.sum(p**2 + q**2)
    H0 = lambda t, p, q, args: square(p, q) ** 2 / (4 * d) + square(p, q) / 2
    noise = lambda t, p, q, args: 0.3 * H0(t, p, q, args)
    y0 = (jnp.zeros(d), jnp.ones(d))
    solver = ds.ImplicitMidpoint(root_finder=ds.PicardNewton(rtol=rtol))

    def change(key):
        terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), key))
        sol = diffrax.diffeqsolve(terms, solver, 0.0, H * STEPS, H, y0, max_steps=None)
        assert sol.ys is not None
        p, q = sol.ys
        return square(p[-1], q[-1]) / square(*y0) - 1

    return jax.vmap(change)


def main() -> None:
    print(machine())
    print("| `rtol` | time, ratio to default | drift |\n|---|---|---|")
    default = None
    for rtol in TOLERANCES:
        fn = solve(256, rtol)
        seconds = measure(fn, keys(PATHS), repeats=2).seconds
        default = default or seconds
        drift = jnp.sqrt(jnp.mean(jax.jit(fn)(keys(PATHS)) ** 2))
        print(f"| {rtol} | {seconds / default:.2f} | {drift:.1e} |", flush=True)


if __name__ == "__main__":
    main()
