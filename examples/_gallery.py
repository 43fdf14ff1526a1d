"""What the figures share: solves, pictures, claims and the command line."""

import argparse
import contextlib
import gc
import io
import multiprocessing
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import as_completed, ProcessPoolExecutor
from importlib.metadata import version
from pathlib import Path
from typing import Any

import diffrax
import jax.numpy as jnp
import jax.random as jr

import diffrax_symplectic as ds


_output = Path(__file__).parent / "output"
_failed: list[str] = []

# The paper's members of these families; the defaults are others.
PAPER_SRKW2 = ds.SRKw2(rows=(1, 2, 3, 4))
PAPER_SRKS3 = ds.SRKs3(a=0.25)


def weak(m: int | None = None, **kwargs) -> Callable[[Any], ds.WeakBrownianPath]:
    """Paths of `m` noises (one, without an axis, if `None`) from keys."""
    return lambda key: ds.WeakBrownianPath(() if m is None else (m,), key, **kwargs)


def gaussian(m: int | None = None, area: bool = False) -> Callable:
    levy_area = diffrax.SpaceTimeLevyArea if area else diffrax.BrownianIncrement
    return lambda key: diffrax.UnsafeBrownianPath(
        () if m is None else (m,), key, levy_area=levy_area
    )


def truncated(key) -> ds.TruncatedBrownianPath:
    """One noise, with the increments that implicit strong methods are meant for."""
    return ds.TruncatedBrownianPath(gaussian()(key), k=2)


def solve(terms, solver, y0, t1, h, **kwargs) -> diffrax.Solution:
    settings: dict[str, Any] = dict(max_steps=None, adjoint=diffrax.ForwardMode())
    settings |= kwargs
    return diffrax.diffeqsolve(terms, solver, 0.0, t1, h, y0, throw=False, **settings)


def trajectory(make_terms, make_path, solver, y0, h, steps: int, every: int, seed=0):
    """One path, its start and every so many steps of it: times and states. Works under
    `vmap` over seeds."""
    saveat = diffrax.SaveAt(t0=True, steps=every)
    terms = make_terms(make_path(jr.key(seed)))
    sol = solve(terms, solver, y0, h * steps, h, saveat=saveat, max_steps=steps)
    assert sol.ts is not None and sol.ys is not None
    return sol.ts, sol.ys, sol.result == diffrax.RESULTS.successful


def claim(what: str, value, low: float = -jnp.inf, high: float = jnp.inf) -> None:
    """Says whether `low <= value <= high`; the command fails in the end if not."""
    holds = bool(low <= value <= high)
    interval = f"[{low:.4g}, {high:.4g}]"
    print(f"  {'ok' if holds else 'FAILS'}: {what}: {float(value):.4g} in {interval}")
    if not holds:
        _failed.append(what)


def save(figure, name: str) -> None:
    _output.mkdir(parents=True, exist_ok=True)
    if figure.get_layout_engine() is None:
        figure.tight_layout()
    figure.savefig(_output / name, dpi=80)
    print(f"  picture: {_output / name}", flush=True)


def _make(
    name: str, figure: Callable[[bool], None], full: bool, output: Path
) -> list[str]:
    """Makes one figure; the claims that failed, with its name."""
    global _output
    _output = output
    _failed.clear()
    begin = time.perf_counter()
    figure(full)
    print(f"  {time.perf_counter() - begin:.1f} seconds", flush=True)
    return [f"figure {name}: {what}" for what in _failed]


def _make_quietly(*args) -> tuple[str, list[str]]:
    with contextlib.redirect_stdout(io.StringIO()) as text:
        failed = _make(*args)
    return text.getvalue(), failed


def _progress(names: list[str], done: set[str], jobs: int, start: float) -> None:
    """Says what runs, and how long the rest will take at the pace so far."""
    rest = [name for name in names if name not in done]
    bar = "#" * len(done) + "." * len(rest)
    passed = time.perf_counter() - start
    left = f", about {passed / len(done) * len(rest):.0f} s to go" if done else ""
    running = f"; running: {', '.join(rest[:jobs])}" if rest else ""
    print(
        f"[{bar}] {len(done)}/{len(names)} in {passed:.0f} s{left}{running}", flush=True
    )


def _hasten() -> None:
    # Tracing makes millions of objects that live on, which need no looking through.
    gc.set_threshold(100_000, 50, 100)


def run(figures: dict[str, Callable[[bool], None]]) -> None:
    """The command line of a set of figures, by their names in the paper."""
    parser = argparse.ArgumentParser()
    parser.add_argument("figures", nargs="*", help=f"of {', '.join(figures)}; or all")
    parser.add_argument(
        "--full", action="store_true", help="as many paths as the paper"
    )
    parser.add_argument("--output", type=Path, default=_output, help="for the pictures")
    parser.add_argument(
        "--jobs", type=int, help="processes; by default two, with --full one"
    )
    options = parser.parse_args()
    names = options.figures or list(figures)
    if unknown := set(names) - set(figures):
        parser.error(f"no figure {', '.join(unknown)}; there are {', '.join(figures)}")
    # Quick figures spend their time on tracing and compiling, which take one core. Full
    # ones use all cores anyway.
    jobs = options.jobs or (1 if options.full else min(2, len(names)))
    start = time.perf_counter()
    args = options.full, options.output.resolve()
    failed = []
    done: set[str] = set()
    _progress(names, done, jobs, start)
    if jobs == 1:
        for name in names:
            failed += _make(name, figures[name], *args)
            done.add(name)
            _progress(names, done, jobs, start)
    else:
        if not options.full and version("jaxlib").startswith("0.10."):
            # The older code generator compiles faster. XLA aborts for flags that it does
            # not know, and they come and go with its versions.
            flags = (
                os.environ.get("XLA_FLAGS", ""),
                "--xla_cpu_use_fusion_emitters=false",
            )
            os.environ["XLA_FLAGS"] = " ".join(flags)
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(jobs, mp_context=context, initializer=_hasten) as pool:
            running = {
                pool.submit(_make_quietly, name, figures[name], *args): name
                for name in names
            }
            for future in as_completed(running):
                text, some = future.result()
                print(text, end="", flush=True)
                failed += some
                done.add(running[future])
                _progress(names, done, jobs, start)
    print(f"\nAll done in {time.perf_counter() - start:.0f} seconds.")
    if failed:
        sys.exit("Claims that fail:\n  " + "\n  ".join(failed))
