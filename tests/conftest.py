"""Settings of the suite. Nearly all of its time goes into tracing and compiling programs
that run for milliseconds, so they are compiled with little optimization.

What users run is optimized. So the tests with the mark `core` are run once more with
`JAX_DISABLE_MOST_OPTIMIZATIONS=0`, which every test then follows."""

import gc
import os


# Inherited by the processes that some tests start, too.
OPTIMIZED = os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1") == "0"
# Nobody looks up which lines an operation of a compiled program comes from, and to write
# them down takes a tenth of the time.
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")

import jax  # noqa: E402
import jaxlib  # noqa: E402
import pytest  # noqa: E402


# The older code generator compiles in a third of the time. XLA aborts for flags that it
# does not know, and they come and go with its versions.
if jaxlib.__version__.startswith("0.10.") and not OPTIMIZED:
    flags = (
        os.environ.get("XLA_FLAGS", ""),
        "--xla_cpu_use_fusion_emitters=false",
        # Otherwise parts of a program are compiled in parallel, which costs small ones a
        # tenth.
        "--xla_cpu_parallel_codegen_split_count=1",
        # These gain little without the optimization that follows them.
        "--xla_disable_hlo_passes=simplify-while-loops,while-loop-constant-sinking,"
        "while-loop-invariant-code-motion",
    )
    os.environ["XLA_FLAGS"] = " ".join(flags)

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_disable_most_optimizations", not OPTIMIZED)

# Tracing makes millions of objects that live on: to look through them every few hundred
# takes a third of its time.
gc.set_threshold(100_000, 50, 100)


def _mappings() -> float:
    """The memory mappings of this process, of which Linux allows 65,530."""
    try:
        with open("/proc/self/maps", "rb") as file:
            return sum(1 for _ in file)
    except OSError:
        return float("inf")


@pytest.fixture(autouse=True, scope="module")
def free_compiled_programs():
    """Thousands of programs in one process exhaust its memory mappings, and XLA crashes.
    They are kept until a quarter of these are used: many small ones occur in every file,
    and to free them takes seconds."""
    yield
    if _mappings() > 16_000:
        jax.clear_caches()
        gc.collect()
