"""Programs in StableHLO, as functions of arrays of [Dr.Jit](https://drjit.readthedocs.io).

StableHLO is the form in which JAX hands a program to its compilers: operations on arrays of
known shapes. `Replay` takes such a program, as text or as JAX's own object, and is a
function of `Tensor`s. A `Tensor` is an array whose every entry is an array of Dr.Jit, with
one lane for each path (or whatever else there are many of): a program for one path runs for
all of them.

    lowered = jax.jit(fn).lower(jax.ShapeDtypeStruct((3,), "float32"))
    replay = Replay(lowered.as_text())
    results, failures = replay(Tensor([x, y, z], (3,)))

Dr.Jit records the operations and compiles them when values are asked for. So a replay may
stand within a loop of Dr.Jit, and becomes part of one kernel with it.

What an operation does is its *rule*. A function of single entries is a line in the table
of `elementwise.py`, or of `complex.py`; any other rule is a function with the decorator
`rule`:
`moves.py` (entries go to known places), `windows.py` (an index that differs between paths),
`reductions.py` (sums, products, sorting), `control_flow.py` (loops and branches) and
`linear_algebra.py` (what JAX calls LAPACK for). Rules read their operation through
`operation.py`, and that through `mlir.py`. Without a rule, `Replay` raises
`NotReplayed`, with the name of the operation and where it comes from.

To add an operation, write its rule, and a line in the table of
`tests/stablehlo/test_operations.py`, which compares it with JAX: a test sees that each
operation has one. The [specification](https://openxla.org/stablehlo/spec) says what it does
with NaN, infinities and integers, where Dr.Jit is often different. Where JAX itself is
inexact, as for `erfc` in its tail, compare with `math` in a test beside the table. If in
single precision Dr.Jit takes the function from a GPU's hardware, whose error is absolute,
add its name to `HARDWARE` there. Where Dr.Jit has no right answer for some numbers, mark
their lanes by `Operation.fail`: JAX gets these paths. What has no rule is listed in
`docs/ensembles.md`: take it off the list.

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
