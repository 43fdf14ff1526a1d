"""What a solve costs beside a loop that is written by hand:

    python -m examples.benchmarks.scan

The case of a discussion of Diffrax (https://github.com/patrick-kidger/diffrax/issues/517):
dX = dW in 1,000 steps, as a `lax.scan` over increments that were drawn before, as one that
draws each by itself, and by `diffrax.diffeqsolve`. Then the same for a pendulum with noise
in its force, by the Störmer--Verlet method. Prints the rows of a table.
"""

from collections.abc import Callable

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
from jax import lax

import diffrax_symplectic as ds

from ._timing import keys, machine, race


STEPS, H, DTYPE = 1000, 1e-4, jnp.float32
BATCH = 1000
LENGTH = jnp.asarray(STEPS * H, DTYPE)
STRUCT = jax.ShapeDtypeStruct((), DTYPE)


def add(x, dw):
    """A step of dX = dW."""
    return x + dw


def verlet(y, dw):
    """A step of dp = -sin(q) dt - cos(q) dw / 5, dq = p dt."""
    p, q = y
    h = jnp.asarray(H, DTYPE)
    q = q + h / 2 * p
    p = p - h * jnp.sin(q) - dw * jnp.cos(q) / 5
    return p, q + h / 2 * p


def scan_drawn(step, y0):
    """Takes increments, drawn before."""
    return lambda dw: lax.scan(lambda y, dw: (step(y, dw), None), y0, dw)[0]


def scan_drawing(step, y0):
    """Takes a key. Each step splits it, and draws an increment."""
    root = jnp.asarray(H, DTYPE) ** 0.5

    def body(carry, _):
        y, key = carry
        key, now = jr.split(key)
        return (step(y, root * jr.normal(now, (), DTYPE)), key), None

    return lambda key: lax.scan(body, (y0, key), None, length=STEPS)[0][0]


def solve(make_terms: Callable, make_path: Callable, solver, y0):
    """Takes a key."""
    return lambda key: (
        diffrax.diffeqsolve(
            make_terms(make_path(key)),
            solver,
            jnp.zeros((), DTYPE),
            LENGTH,
            jnp.asarray(H, DTYPE),
            y0,
            max_steps=None,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        ).ys
    )


def plain(path) -> diffrax.MultiTerm:
    still = diffrax.ODETerm(lambda t, y, args: jnp.zeros_like(y))
    unit = diffrax.ControlTerm(lambda t, y, args: jnp.ones_like(y), path)
    return diffrax.MultiTerm(still, unit)


def pendulum(path) -> diffrax.MultiTerm:
    return ds.hamiltonian_terms(
        lambda t, p, q, args: p**2 / 2 - jnp.cos(q),
        lambda t, p, q, args: jnp.sin(q) / 5,
        path,
    )


fixed = lambda key: ds.FixedStepBrownianPath(STRUCT, key)
unsafe = lambda key: diffrax.UnsafeBrownianPath(STRUCT, key)
tree = lambda key: diffrax.VirtualBrownianTree(0, LENGTH, H / 2, STRUCT, key)


def ways(step, make_terms, solver, y0) -> dict[str, Callable]:
    """From a key to the end of a path."""
    given = scan_drawn(step, y0)
    draw = lambda key: jnp.asarray(H, DTYPE) ** 0.5 * jr.normal(key, (STEPS,), DTYPE)
    name = type(solver).__name__
    return {
        "scan, increments drawn at once": lambda key: given(draw(key)),
        "scan, a key split and a draw in each step": scan_drawing(step, y0),
        f"`{name}`, `FixedStepBrownianPath`": solve(make_terms, fixed, solver, y0),
        f"`{name}`, `UnsafeBrownianPath`": solve(make_terms, unsafe, solver, y0),
        f"`{name}`, `VirtualBrownianTree`": solve(make_terms, tree, solver, y0),
    }


def main() -> None:
    zero, one = jnp.zeros((), DTYPE), jnp.ones((), DTYPE)
    print(f"{machine()}. float32, {STEPS} steps.\n")
    print(f"| | nanoseconds a step, one path | a step and path, {BATCH} paths |")
    print("|---|---|---|")
    for title, cases in (
        ("dX = dW", ways(add, plain, diffrax.Euler(), zero)),
        ("pendulum", ways(verlet, pendulum, ds.StormerVerlet(), (zero, one))),
    ):
        one_path = {name: jax.jit(fn) for name, fn in cases.items()}
        many = {name: jax.jit(jax.vmap(fn)) for name, fn in cases.items()}
        single, batch = keys(1)[0], keys(BATCH)
        alone = race({k: lambda f=f: f(single) for k, f in one_path.items()}, 15)
        each = race({k: lambda f=f: f(batch) for k, f in many.items()})
        for name in cases:
            print(
                f"| {title}: {name} | {alone[name] / STEPS * 1e9:.0f} | "
                f"{each[name] / STEPS / BATCH * 1e9:.1f} |"
            )


if __name__ == "__main__":
    main()
