"""How long solves take."""

import datetime
import os
import platform
import re
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import diffrax
import jax
import jax.random as jr


jax.config.update("jax_enable_x64", True)

DOCS = Path(__file__).parents[2] / "docs" / "benchmarks"


def write(module: str, lines: Iterable[str], page: Path = DOCS / "index.md") -> None:
    """Puts the lines into the part of the page that a module makes."""
    head = f"<!-- made by {module} -->"
    part = re.compile(f"{re.escape(head)}.*?<!-- end -->", re.DOTALL)
    text = "\n".join([head, "", *lines, "", "<!-- end -->"])
    page.write_text(part.sub(lambda _: text, page.read_text()))


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """The lines of a table, printed too."""
    cells = [head, ["---"] * len(head), *rows]
    lines = [f"| {' | '.join(row)} |".replace("|  |", "| |") for row in cells]
    print("\n".join(lines), flush=True)
    return lines


class Timing(NamedTuple):
    trace: float
    compile: float
    # Of the best of several runs.
    seconds: float


def measure(
    fn: Callable,
    *args,
    repeats: int = 5,
    clock: Callable[[], float] = time.perf_counter,
) -> Timing:
    """Of `fn(*args)` under `jit`."""
    # A function of its own: nothing is taken from an earlier trace.
    jitted = jax.jit(lambda *args: fn(*args))
    start = time.perf_counter()
    lowered = jitted.lower(*args)
    traced = time.perf_counter()
    compiled = lowered.compile()
    done = time.perf_counter()
    jax.block_until_ready(compiled(*args))
    best = float("inf")
    for _ in range(repeats):
        begin = clock()
        jax.block_until_ready(compiled(*args))
        best = min(best, clock() - begin)
    return Timing(traced - start, done - traced, best)


def race(calls: dict[str, Callable[[], Any]], rounds: int = 7) -> dict[str, float]:
    """Seconds of the best run of each; they take turns, so that all of them have the same
    machine."""
    best = dict.fromkeys(calls, float("inf"))
    for i in range(rounds + 1):
        for name, call in calls.items():
            begin = time.perf_counter()
            jax.block_until_ready(call())
            if i > 0:
                best[name] = min(best[name], time.perf_counter() - begin)
    return best


def ensemble(
    make_terms, make_path, solver, y0, h: float | jax.Array, steps: int
) -> Callable:
    """Takes keys to the ends of paths; one path without a batch if there is one key."""

    def one(key):
        return diffrax.diffeqsolve(
            make_terms(make_path(key)),
            solver,
            0.0,
            h * steps,
            h,
            y0,
            max_steps=None,
            # Unlike the default adjoint this one takes any path.
            adjoint=diffrax.ForwardMode(),
        ).ys

    return lambda keys: one(keys[0]) if len(keys) == 1 else jax.vmap(one)(keys)


def keys(n: int):
    return jr.split(jr.key(0), n)


def machine() -> str:
    """The machine, the day and the versions with which a page is measured."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo") as file:
            lines = [x for x in file if x.startswith("model name")]
        name = lines[0].split(":")[1].strip()
    except (OSError, IndexError):
        pass
    kinds = sorted({d.device_kind for d in jax.devices()})
    devices = ", ".join("CPU" if kind == "cpu" else kind for kind in kinds)
    return (
        f"{name}, {os.cpu_count()} cores, {devices}; {datetime.date.today()}; Python "
        f"{platform.python_version()}, JAX {jax.__version__}, Diffrax "
        f"{diffrax.__version__}"
    )
