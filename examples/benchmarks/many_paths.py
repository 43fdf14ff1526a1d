"""Whether many paths cost more, each, than few: processor time per path and step of
`ensemble`, by both engines, and of `ArrayRQMC`.

    python -m examples.benchmarks.many_paths measure
    python -m examples.benchmarks.many_paths

The first measures, and keeps what it measures in `docs/benchmarks/many_paths.json`. Both
write `many_paths.md` and the chart beside it from that. Processor time counts all
cores, and does not count other programs that take turns on them.
"""

import functools as ft
import json
import sys
import time
from collections.abc import Callable
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt

import diffrax_symplectic as ds

from .._pictures import style, WIDTH
from ._timing import DOCS, machine
from .fused import Case, CASES


KEPT = DOCS / "many_paths.json"
NUMBERS = [2**k for k in range(6, 21, 2)]
# The table has these, the chart all of them.
SHOWN = [2**6, 2**10, 2**16, 2**20]
# The start of a path, which draws its random keys, costs as much as ten steps of
# `StormerVerlet`. It should not count for much, and for as much everywhere.
STEPS = 64
# So many that the time of a call no longer counts.
MANY = 2**16
# A call that takes longer is not repeated.
PATIENCE = 5.0
ROUNDS = 5
SYSTEMS = [
    "pendulum, `StormerVerlet`",
    "Kubo, `ImplicitMidpoint`, h = 0.2",
    "Kubo, `StrangGauss`, h = 0.1",
    "Henon-Heiles, `ImplicitMidpoint`, h = 0.1",
    "spin, `ImplicitMidpoint`, h = 0.1",
    "chain of 4, `StormerVerlet`",
]
# The number of replicates, so that the variance can be estimated at all.
REPLICATES = 2


def by_ensemble(case: Case, number: int, engine: str) -> Callable:
    given = arguments(case)

    def call() -> None:
        ds.ensemble(*given, key=jr.key(1), num_paths=number, engine=engine)

    return call


def by_array_rqmc(case: Case, number: int) -> Callable:
    given = arguments(case)
    sampling = ds.ArrayRQMC(num_paths=number // REPLICATES, replicates=REPLICATES)

    def call() -> None:
        ds.expectation(first_number, *given, key=jr.key(1), sampling=sampling, levels=1)

    return call


def arguments(case: Case) -> tuple[Any, ...]:
    """From terms to the initial state."""
    terms = case.terms(jr.key(0), jnp.float64)
    y0 = case.start(jnp.float64)
    return terms, case.solver, 0.0, STEPS * case.h, case.h, y0


def first_number(t, y, args):
    return jnp.ravel(jax.tree.leaves(y)[0])[0]


def nanoseconds(call: Callable, number: int) -> float:
    """A path and step takes, at best."""
    call()  # compiles
    best = float("inf")
    for _ in range(ROUNDS):
        begin = time.process_time()
        call()
        seconds = time.process_time() - begin
        best = min(best, seconds)
        if seconds > PATIENCE:
            break
    return best * 1e9 / (number * STEPS)


WAYS: dict[str, Callable[[Case, int], Callable]] = {
    "fused": ft.partial(by_ensemble, engine="drjit"),
    "JAX": ft.partial(by_ensemble, engine="jax"),
    "`ArrayRQMC`": by_array_rqmc,
}


def measured(name: str, way: str) -> list[float]:
    """For each of `NUMBERS`; nothing if the sampling does not take the system."""
    found = []
    for number in NUMBERS:
        try:
            call = WAYS[way](CASES[name], number)
            found.append(nanoseconds(call, number))
        except ValueError:
            return []
        print(name, way, number, f"{found[-1]:.1f}", flush=True)
    return found


# By system and way, the nanoseconds for each of `NUMBERS`.
Table: TypeAlias = dict[str, dict[str, list[float]]]


def main(*kinds: str) -> None:
    if "measure" in kinds:
        table = {name: {way: measured(name, way) for way in WAYS} for name in SYSTEMS}
        kept = {"machine": machine(), "nanoseconds": table}
        KEPT.write_text(json.dumps(kept, indent=1) + "\n")
    write(**json.loads(KEPT.read_text()))


def rise(table: Table, *ways: str) -> float:
    """By how much the cost per path grows at most, as a fraction, from `MANY` paths on."""
    found = 0.0
    for by_way in table.values():
        for way in ways:
            if many := by_way[way][NUMBERS.index(MANY) :]:
                found = max(found, max(many) / many[0] - 1)
    return found


def write(machine: str, nanoseconds: Table) -> None:
    heads = " | ".join(f"{number:,}" for number in SHOWN)
    rows = [
        "# Many paths\n\n"
        f"From {MANY:,} paths to {NUMBERS[-1]:,} the cost per path rises by at most "
        f"{rise(nanoseconds, 'fused', 'JAX'):.0%} in [ensembles](../ensembles.md), and by "
        f"{rise(nanoseconds, '`ArrayRQMC`'):.0%} in `ArrayRQMC`, which sorts them.\n\n"
        "Processor nanoseconds per path and step, best of "
        f"{ROUNDS} calls of {STEPS} steps (fewer where a call exceeds {PATIENCE:.0f} s), "
        "float64. Times include the call itself, which dominates for few paths. "
        f"`ArrayRQMC` splits the paths into {REPLICATES} replicates. {machine}. Made by "
        "`python -m examples.benchmarks.many_paths measure`.\n",
        f"| paths | {heads} |",
        "|---" * (1 + len(SHOWN)) + "|",
    ]
    for system in SYSTEMS:
        rows.append(f"| **{system}** |" + " |" * len(SHOWN))
        for way, found in nanoseconds[system].items():
            if found:
                some = [found[NUMBERS.index(number)] for number in SHOWN]
                shown = " | ".join(f"{float(f'{x:.3g}'):,.10g}" for x in some)
                rows.append(f"| {way} | {shown} |")
    draw(nanoseconds)
    image = "![Processor time per path and step](many_paths.png)"
    (DOCS / "many_paths.md").write_text("\n".join([*rows, "", image, ""]))


def draw(table: Table) -> None:
    figure, axes = plt.subplots(
        3, 2, figsize=(WIDTH, 8.5), sharex=True, sharey=True, squeeze=False
    )
    for name, ax in zip(SYSTEMS, axes.flat):
        for way in WAYS:
            if nanoseconds := table[name][way]:
                label = way.strip("`")
                ax.loglog(NUMBERS, nanoseconds, label=label, **style(label))
        title = name.replace("`", "").replace("Henon", "Hénon")
        ax.set_title(title.replace(", ", ",\n", 1))
    lines, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside upper center", ncols=3)
    figure.supxlabel("number of paths", fontsize=10)
    figure.supylabel("processor nanoseconds per path and step", fontsize=10)
    figure.savefig(DOCS / "many_paths.png")
    plt.close(figure)


if __name__ == "__main__":
    main(*sys.argv[1:])
