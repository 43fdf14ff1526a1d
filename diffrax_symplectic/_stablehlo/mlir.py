"""Reads functions, regions, constants and source lines from MLIR's Python objects. The
attributes of operations are read in `operation.py`.

MLIR promises little about these objects, and gives some values only in printed form. So
each value is read by a function of its own, which `tests/stablehlo/test_mlir.py` tests by
itself: if a test there fails after an upgrade of JAX, change the function here.
"""

import re
from typing import Any, NamedTuple

import numpy as np


def functions_of(module: Any) -> dict[str, Any]:
    """The functions of an MLIR module, by their names."""
    return {
        op.attributes["sym_name"].value: op
        for op in module.body.operations
        if op.operation.name == "func.func"
    }


def callee_of(op: Any) -> str:
    """The name of the function that the operation `func.call` calls."""
    return op.attributes["callee"].value


def call_target(op: Any) -> str:
    """The name of the library function that a custom call of StableHLO calls."""
    return op.attributes["call_target_name"].value


def block_of(op: Any, region: int = 0) -> Any:
    """The block of the operation's region with the number `region`. A region of StableHLO
    has exactly one block."""
    return op.regions[region].blocks[0]


def operations_in(region: Any) -> list[Any]:
    """The operations of a region, as objects of MLIR's class of all operations."""
    return [op.operation for block in region.blocks for op in block.operations]


def constant_values(op: Any) -> np.ndarray:
    """The values of the operation `stablehlo.constant`, in the constant's shape."""
    result_type = op.results[0].type
    shape = tuple(result_type.shape)
    if str(result_type.element_type).startswith("complex"):
        return _complex_constant(str(op), shape)
    # If all entries are equal, MLIR may return a single one.
    return np.broadcast_to(np.asarray(op.attributes["value"]), shape)


def _complex_constant(text: str, shape: tuple[int, ...]) -> np.ndarray:
    """The values of a complex constant, read from the text of the operation, since MLIR
    gives them in no other way. The text has one of two forms:

    - `dense<"0x...">`, with the bytes of all numbers, if they are many;
    - `dense<[(1.0,2.0), ...]>`, with pairs of a real and an imaginary part.
    """
    # The size of a real or imaginary part.
    num_bytes = 8 if "complex<f64>" in text else 4
    if in_hexadecimal := re.search(r'dense<"0x([0-9A-F]+)">', text):
        parts = np.frombuffer(bytes.fromhex(in_hexadecimal[1]), f"<f{num_bytes}")
    else:
        # The type of the constant follows after the colon.
        pairs = re.findall(r"\(([^(),]+),([^(),]+)\)", text.split(" : ")[0])
        numbers = [_number_of(part, num_bytes) for pair in pairs for part in pair]
        parts = np.array(numbers, f"<f{num_bytes}")
    # Real and imaginary parts alternate. In `real + 1j * imag` an infinite imaginary part
    # would make the real part NaN.
    values = parts[::2] + 0j
    values.imag = parts[1::2]
    # If all entries are equal, MLIR prints a single one, which is repeated here.
    return np.resize(values, shape)


def _number_of(text: str, num_bytes: int) -> float:
    """The floating-point number of `num_bytes` bytes that MLIR printed as `text`. A number
    that is not finite is printed as its bits, in hexadecimal."""
    text = text.strip()
    if not text.startswith("0x"):
        return float(text)
    bits = np.array(int(text, 16), f"<u{num_bytes}")
    return float(bits.view(f"<f{num_bytes}"))


class SourceLine(NamedTuple):
    """A line of Python from which an operation was traced.

    - `function`: the name of the function that the line belongs to.
    - `file`: the path of the file.
    - `line`: the number of the line in the file.
    """

    function: str
    file: str
    line: int


def source_lines(location: str) -> list[SourceLine]:
    """The lines of Python from which an operation was traced: the line that made the
    operation, then the line that called the function of this line, and so on. JAX records
    as many lines as its setting `jax_traceback_in_locations_limit` says.

    `location` is the printed location of the operation, which holds each line as
    `"fn"("file.py":12:...)`.
    """
    lines = re.findall(r'"([^"]*)"\("([^"]+)":(\d+)', location)
    return [
        SourceLine(_name_of_function(name), file, int(line))
        for name, file, line in lines
    ]


# Parts of qualified names that name no function of the user: `fn.<locals>.<genexpr>` is a
# generator in `fn`.
_UNNAMED = ("<locals>", "<genexpr>", "<listcomp>", "<dictcomp>", "<setcomp>")


def _name_of_function(qualified: str) -> str:
    """The name of the innermost function in a qualified name: `fn` in
    `outer.<locals>.fn.<locals>.<genexpr>`."""
    names = [part for part in qualified.split(".") if part not in _UNNAMED]
    return names[-1] if names else qualified
