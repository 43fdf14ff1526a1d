"""Imports Dr.Jit, an optional dependency, on first use. Names Dr.Jit's array types by the
types of StableHLO."""

import functools as ft
import importlib
from typing import Any

import jax


_NO_DRJIT = (
    "Dr.Jit cannot be imported. Install it with `pip install '.[fused]'` in a checkout (or "
    "`pip install 'drjit>=1.5'`)"
)
_NO_LLVM = (
    "On a CPU Dr.Jit needs a shared library of LLVM, of version 15 or newer, and found "
    "none. Install one (Debian and Ubuntu: `apt-get install libllvm19`; conda-forge: "
    "`libllvm`; Homebrew: `llvm`), and if it lies where Dr.Jit does not look, set the "
    "environment variable `DRJIT_LIBLLVM_PATH` to the file before you start Python"
)
_NO_CUDA = (
    "JAX runs on a GPU, but Dr.Jit found no driver of CUDA. Start Python with "
    "`JAX_PLATFORMS=cpu` to use the CPU"
)


@ft.cache
def _drjit() -> Any:
    """The module `drjit`. Raises an `ImportError` that says how to install it."""
    try:
        return importlib.import_module("drjit")
    except ImportError as error:
        raise ImportError(_NO_DRJIT) from error


class _DrJit:
    """Stands for the module `drjit`, which is imported when one of its attributes is first
    read."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_drjit(), name)


dr: Any = _DrJit()


@ft.cache
def array_types() -> dict[str, Any]:
    """Dr.Jit's array types for JAX's default device, by StableHLO's names of the types of
    numbers in them. Raises an `ImportError` if Dr.Jit cannot compile for this device."""
    on_cpu = jax.default_backend() == "cpu"
    # Without this check `drjit.llvm` would be imported even if LLVM is missing, and the
    # first kernel would fail.
    needed = dr.JitBackend.LLVM if on_cpu else dr.JitBackend.CUDA
    if not dr.has_backend(needed):
        raise ImportError(_NO_LLVM if on_cpu else _NO_CUDA)
    types = importlib.import_module("drjit.llvm" if on_cpu else "drjit.cuda")
    return {
        "complex<f32>": types.Complex2f,
        "complex<f64>": types.Complex2f64,
        "f32": types.Float,
        "f64": types.Float64,
        "i1": types.Bool,
        "i8": types.Int8,
        "i32": types.Int,
        "i64": types.Int64,
        "ui8": types.UInt8,
        "ui32": types.UInt,
        "ui64": types.UInt64,
    }
