"""The command line of a set of figures. It imports JAX only where a figure is made."""

import argparse
import contextlib
import gc
import importlib
import io
import multiprocessing
import os
import sys
import time
from concurrent.futures import as_completed, ProcessPoolExecutor
from importlib.metadata import version
from pathlib import Path


_OUTPUT = Path(__file__).parent / "output"


def _make(name: str, module: str, full: bool, output: Path) -> list[str]:
    """Makes one figure; the claims that failed, with its name."""
    gallery = importlib.import_module("._gallery", __package__)
    figure = importlib.import_module(f".{module}", __package__).FIGURES[name]
    gallery.begin(output)
    begin = time.perf_counter()
    figure(full)
    print(f"  {time.perf_counter() - begin:.1f} seconds", flush=True)
    return [f"figure {name}: {what}" for what in gallery.failed]


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


def hasten() -> None:
    # Tracing makes millions of objects that live on, which need no looking through.
    gc.set_threshold(100_000, 50, 100)


def compile_quickly() -> None:
    """To be called before JAX is used. Quick figures spend most of their time on compiling:
    the older code generator, few optimizations, and no record of the lines that an
    operation comes from."""
    os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")
    # XLA aborts for flags that it does not know, and they come and go with its versions.
    if version("jaxlib").startswith("0.10."):
        flags = (
            os.environ.get("XLA_FLAGS", ""),
            "--xla_cpu_use_fusion_emitters=false",
            "--xla_backend_optimization_level=1",
            # Of small programs the parts are not worth threads of their own.
            "--xla_cpu_parallel_codegen_split_count=1",
        )
        os.environ["XLA_FLAGS"] = " ".join(flags)


def run(figures: dict[str, str]) -> None:
    """The command line of a set of figures: the modules that make them, by their names in
    the paper."""
    parser = argparse.ArgumentParser()
    parser.add_argument("figures", nargs="*", help=f"of {', '.join(figures)}; or all")
    parser.add_argument(
        "--full", action="store_true", help="as many paths as the paper"
    )
    parser.add_argument("--output", type=Path, default=_OUTPUT, help="for the pictures")
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
    if not options.full:
        compile_quickly()
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
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(jobs, mp_context=context, initializer=hasten) as pool:
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
