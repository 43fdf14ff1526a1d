"""Programs in StableHLO, as functions of arrays of [Dr.Jit](https://drjit.readthedocs.io).

StableHLO is the form in which JAX hands a program to its compilers: operations on arrays of
known shapes. `Replay` takes such a program, as text or as JAX's own object, and is a
function of `Tensor`s. A `Tensor` is an array whose every entry is an array of Dr.Jit, with
one *lane*, an element, for each path (or whatever else there are many of). So a program for
one path runs for all paths.

    lowered = jax.jit(fn).lower(jax.ShapeDtypeStruct((3,), "float32"))
    replay = Replay(lowered.as_text())
    results, failures = replay(Tensor([x, y, z], (3,)))

Dr.Jit *records* operations, and compiles them to a *kernel* when values are asked for. So a
replay may stand within a loop of Dr.Jit, and becomes part of the same kernel.

The *rule* of an operation maps the operation and its operands to its results. A function
of single entries is a line in the table of `elementwise.py` or of `complex.py`. Any other
rule is a function with the decorator `rule`:

- `moves.py`: the same entries move in all paths.
- `windows.py`: an index may differ between paths.
- `reductions.py`: sums, products of matrices, sorting.
- `control_flow.py`: loops and branches.
- `linear_algebra.py`: operations for which JAX calls LAPACK.

`operation.py` and `mlir.py` read an operation from MLIR, in which JAX holds programs.
`tensor.py` has the tensors, and `backend.py` Dr.Jit and its types of arrays. If an
operation has no rule, `Replay` raises a `NotReplayed` with the name of the operation and
the location that it comes from.

To add an operation:

- Write its rule. The [specification](https://openxla.org/stablehlo/spec) says what the
    operation does with NaN, infinities and integers, where Dr.Jit is often different.
- If Dr.Jit has no right answer for some numbers, mark their lanes by `Operation.fail`: JAX
    computes these paths.
- Add a line to the table of `tests/stablehlo/test_operations.py`, by which the operation is
    compared with JAX. (A test fails if an operation has no line.) Where JAX itself is
    inexact, as for `erfc` in its tail, compare with `math` in a test beside the table.
- If Dr.Jit takes the function in single precision from a GPU's hardware, whose error is
    absolute, add its name to `HARDWARE` in the same file.
- Take the operation off the list in `docs/ensembles.md` of operations without a rule.

This folder knows nothing of differential equations.
"""

from .backend import array_types, dr
from .mlir import source_lines
from .operation import NotReplayed
from .replay import Replay
from .tensor import (
    array_in_memory,
    ArrayType,
    entries_of,
    MOST_IN_REGISTERS,
    scalar,
    Table,
    Tensor,
    tensors_from,
)
