"""What a step costs, against its size and the number of unknowns:

    python -m examples.benchmarks.step_sizes measure
    python -m examples.benchmarks.step_sizes

The first measures, on a quiet machine, and keeps what it measures in
`docs/benchmarks/step_sizes.json`. Both write `step_sizes.md` and a picture from that.
"""

import json
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jax import lax
from matplotlib.ticker import LogLocator, StrMethodFormatter

import diffrax_symplectic as ds

from .._pictures import style, WIDTH
from ._timing import DOCS, keys, machine, race
from .growth import chain, network, ring


KEPT = DOCS / "step_sizes.json"
SIZES = (0.01, 0.05, 0.1, 0.2, 0.4)
# The table has these, the picture all of them.
SHOWN = (0.01, 0.1, 0.4)
STEPS = 32
# The table has the other systems.
PICTURED = ("quartic Kubo", "Hénon-Heiles", "rigid body", "chain, d = 16")
HEUN, BY_HAND = "`Heun`", "midpoint by hand"


class System(NamedTuple):
    """`terms` makes them from a Brownian path, with any function around a Hamiltonian."""

    title: str
    terms: Callable
    y0: Any
    solvers: tuple[diffrax.AbstractSolver, ...]
    paths: int
    # The largest frequency near the initial state.
    frequency: float
    shape: tuple[int, ...] = ()


def _quartic(t, p, q, args):
    return jnp.sum(p**2 + q**2) / 2 + jnp.sum(p**4 + q**4) / 10


def _henon_heiles(t, p, q, args):
    return jnp.sum(p**2 + q**2) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3


def _systems() -> list[System]:
    of = lambda H0, noise: lambda path: ds.hamiltonian_terms(H0, noise, path)
    one = jnp.array(0.0), jnp.array(1.0)
    two = jnp.array([0.2, 0.1]), jnp.array([0.0, -0.15])
    three = ds.ImplicitMidpoint(), ds.StrangGauss(), ds.SRKw2()
    inertia = jnp.array([0.8, 0.6, 0.2])

    def rigid_body(path):
        turn = lambda t, y, args: jnp.cross(y, y / inertia)
        kick = lambda t, y, args: 0.5 * jnp.cross(y, jnp.eye(3)[0])
        return diffrax.MultiTerm(diffrax.ODETerm(turn), diffrax.ControlTerm(kick, path))

    top = jnp.array([jnp.cos(1.1), 0.0, jnp.sin(1.1)])
    kubo = of(_quartic, lambda t, p, q, args: 0.3 * _quartic(t, p, q, args))
    general = ds.ImplicitMidpoint(), ds.SRKs1(), ds.SRKw1(), *three[1:]
    several_noises = ds.NinomiyaVictoir(), ds.LevyAreaMidpoint(), ds.PlateauGauss()
    separable = ds.SRKs2(), ds.SRKw4()
    additive = ds.AdditiveGauss(), ds.SRKs4(), ds.SRKw5()
    pair = of(_quartic, lambda t, p, q, args: 0.3 * jnp.stack([p * q, q]))
    stretch = of(_henon_heiles, lambda t, p, q, args: 0.2 * jnp.sum(p * q))
    kicks = of(_henon_heiles, lambda t, p, q, args: 0.1 * jnp.sum(q))
    systems = [
        System("quartic Kubo", kubo, one, general, 512, 1.4),
        System("quartic, two noises", pair, one, several_noises, 512, 1.4, (2,)),
        System("Hénon-Heiles", stretch, two, three, 512, 1.0),
        System("Hénon-Heiles, kicks", kicks, two, (*additive, *separable), 512, 1.0),
        System("rigid body", rigid_body, top, three, 512, 4.0),
    ]
    several = ds.ImplicitMidpoint(), ds.StrangGauss()
    for title, make, frequency, sizes in (
        ("chain", chain, 2.0, (16,)),
        ("Schrödinger ring", ring, 5.0, (64,)),
        ("network", network, 1.0, (64,)),
    ):
        for d in sizes:
            terms = lambda path, make=make, d=d: make(path, d)
            y0 = jnp.zeros(d), jnp.sin(jnp.arange(d) + 1.0)
            paths = max(8, 2048 // d)
            systems.append(
                System(f"{title}, d = {d}", terms, y0, several, paths, frequency)
            )
    return systems


def _terms(system: System, solver, key):
    if isinstance(solver, diffrax.Heun):
        return system.terms(ds.WeakBrownianPath(system.shape, key))
    return system.terms(solver.path(system.shape, key, want="weak"))


def _solve(system: System, solver) -> Callable:
    """Takes keys and a step size to the ends of paths, and whether each was reached."""

    @jax.jit
    def solve(keys, h):
        def one(key):
            sol = diffrax.diffeqsolve(
                _terms(system, solver, key), solver, 0.0, STEPS * h, h, system.y0,
                max_steps=STEPS + 2, adjoint=diffrax.ForwardMode(), throw=False,
            )  # fmt: skip
            return sol.ys, sol.result == diffrax.RESULTS.successful

        return jax.vmap(one)(keys)

    return solve


def _gradient(system: System, solver) -> Callable:
    """Takes keys and a step size to the mean of a quadratic function of the ends, and its
    derivative in reverse mode with respect to the initial state."""

    def loss(y0, keys, h):
        def one(key):
            sol = diffrax.diffeqsolve(
                _terms(system, solver, key), solver, 0.0, STEPS * h, h, y0,
                max_steps=STEPS + 2, throw=False,
            )  # fmt: skip
            return sum(jnp.sum(y**2) for y in jax.tree.leaves(sol.ys))

        return jnp.mean(jax.vmap(one)(keys))

    return jax.jit(lambda keys, h: jax.value_and_grad(loss)(system.y0, keys, h))


def _by_hand(system: System) -> Callable:
    """The midpoint rule as one would write it: fixed-point iteration, the same number of
    iterations for all steps, and nobody looks whether they were enough."""
    iterations = 12

    @jax.jit
    def solve(keys, h):
        def one(key):
            terms = system.terms(ds.WeakBrownianPath(system.shape, key))

            def step(y, i):
                t0, t1 = i * h, (i + 1) * h
                control = terms.contr(t0, t1)

                def improve(_, k):
                    middle = jax.tree.map(lambda y, k: y + k / 2, y, k)
                    return terms.vf_prod((t0 + t1) / 2, middle, None, control)

                zero = jax.tree.map(jnp.zeros_like, y)
                k = lax.fori_loop(0, iterations, improve, zero)
                return jax.tree.map(jnp.add, y, k), None

            return lax.scan(step, system.y0, jnp.arange(STEPS))[0], True

        return jax.vmap(one)(keys)

    return solve


class Row(NamedTuple):
    # The title of the system, and its largest frequency.
    system: str
    frequency: float
    name: str
    nanoseconds: tuple[float, ...]
    # Value and gradient as a multiple of that, at the least and the largest step size.
    gradient: tuple[float, ...]
    failed: tuple[float, ...]


def measure(system: System) -> list[Row]:
    calls: dict[str, Callable] = {
        HEUN: _solve(system, diffrax.Heun()),
        BY_HAND: _by_hand(system),
    }
    calls |= {f"`{type(s).__name__}`": _solve(system, s) for s in system.solvers}
    gradients = {f"`{type(s).__name__}`": _gradient(system, s) for s in system.solvers}
    batch = keys(system.paths)
    times = {name: [] for name in calls}
    failed = {name: [] for name in calls}
    for h in SIZES:
        bound = {name: lambda call=call: call(batch, h) for name, call in calls.items()}
        seconds = race(bound, rounds=5)
        for name, call in calls.items():
            times[name].append(seconds[name] / system.paths / STEPS * 1e9)
            failed[name].append(1 - float(jnp.mean(call(batch, h)[1])))
    rows = []
    for name in calls:
        row = Row(
            system.title, system.frequency, name, tuple(times[name]),
            _over_value(name, calls, gradients, batch), tuple(failed[name]),
        )  # fmt: skip
        print(row[1:], flush=True)
        rows.append(row)
    return rows


def _over_value(name: str, calls, gradients, batch) -> tuple[float, ...]:
    if name not in gradients:
        return ()
    ratios = []
    for h in (SIZES[0], SIZES[-1]):
        pair = {"value": lambda: calls[name](batch, h)}
        pair["gradient"] = lambda: gradients[name](batch, h)
        seconds = race(pair, rounds=3)
        ratios.append(seconds["gradient"] / seconds["value"])
    return tuple(ratios)


INTRODUCTION = """\
# Cost against step size

From $h = 0.01$ to 0.4 an implicit step becomes {least:.1f} to {most:.1f} times as
expensive, more where steps fail.

Nanoseconds per path and step with random numbers, {steps} steps, 512 paths ($2048/d$ for
size $d$), float64. Percentages: paths with a failed step. Gradient: value and reverse-mode
gradient, relative to the value, at $h = 0.01$ and 0.4. `Heun` costs nearly the same at
every step. The picture's "midpoint by hand" makes twelve fixed-point iterations per step.
{machine}. Made by `python -m examples.benchmarks.step_sizes measure`.

![Cost of a step against frequency times step size](step_sizes.png)

| solver | {sizes} | gradient |
|---|{lines}---|
"""


def page(machine: str, rows: list[Row]) -> str:
    sizes = " | ".join(f"$h = {h}$" for h in SHOWN)
    lines = "---|" * len(SHOWN)
    growth = [
        row.nanoseconds[-1] / row.nanoseconds[0]
        for row in rows
        if row.name not in (HEUN, BY_HAND)
        and row.system not in PICTURED
        and not any(row.failed)
    ]
    text = INTRODUCTION.format(
        machine=machine, steps=STEPS, sizes=sizes, lines=lines,
        least=min(growth), most=max(growth),
    )  # fmt: skip
    for row in rows:
        if row.name == BY_HAND or row.system in PICTURED:
            continue
        if row.name == HEUN:
            text += f"| **{row.system}** |{' |' * (len(SHOWN) + 1)}\n"
        cells = [
            f"{x:,.0f}" + (f" ({share:.1%})" if share > 0 else "")
            for h, x, share in zip(SIZES, row.nanoseconds, row.failed)
            if h in SHOWN
        ]
        gradient = "/".join(f"{x:.1f}" for x in row.gradient)
        line = row.name, *cells, gradient
        text += f"| {' | '.join(line)} |\n".replace("|  |", "| |")
    return text


def draw(rows: list[Row]) -> None:
    figure, axes = plt.subplots(2, 2, figsize=(WIDTH, 7))
    for ax, title in zip(axes.flat, PICTURED):
        shown = [row for row in rows if row.system == title]
        x = shown[0].frequency * np.array(SIZES)
        for row in shown:
            label = row.name.strip("`")
            ax.loglog(x, row.nanoseconds, label=label, **style(label))
        ax.set(title=title, xlabel=r"$\omega h$")
        ax.set_xticks(x, [f"{each:g}" for each in x])
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.yaxis.set_major_formatter(StrMethodFormatter("{x:,.0f}"))
        ax.minorticks_off()
    lines, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside lower center", ncols=3)
    figure.supylabel("nanoseconds per path and step", fontsize=10)
    figure.savefig(DOCS / "step_sizes.png")
    plt.close(figure)


def main(*kinds: str) -> None:
    if "measure" in kinds:
        measured = [row for system in _systems() for row in measure(system)]
        kept = {"machine": machine(), "rows": [row._asdict() for row in measured]}
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    kept = json.loads(KEPT.read_text())
    rows = [Row(**row) for row in kept["rows"]]
    (DOCS / "step_sizes.md").write_text(page(kept["machine"], rows))
    draw(rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
