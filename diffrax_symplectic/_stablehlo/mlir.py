"""How operations of MLIR tell what they are: names, regions, constants, and the lines that
they come from. Their attributes are read in `operation.py`.

MLIR's objects for Python promise little of this, and print some of it only. So it is used
nowhere else, and `tests/stablehlo/test_mlir.py` tests each part by itself: if one of these
tests fails after an upgrade of JAX, change the function here.
"""

import re
from typing import Any, NamedTuple

import numpy as np


def functions_of(module: Any) -> dict[str, Any]:
    """The functions of a module of MLIR, by their names."""
    return {
        op.attributes["sym_name"].value: op
        for op in module.body.operations
        if op.operation.name == "func.func"
    }


def callee_of(op: Any) -> str:
    """The name of the function that an operation of MLIR calls."""
    return op.attributes["callee"].value


def call_target(op: Any) -> str:
    """The name of what a custom call of StableHLO calls."""
    return op.attributes["call_target_name"].value


def block_of(op: Any, region: int = 0) -> Any:
    """The block of a region of an operation of MLIR: regions of StableHLO have one."""
    return op.regions[region].blocks[0]


def operations_in(region: Any) -> list[Any]:
    """The operations of a region of MLIR, in their general form."""
    return [op.operation for block in region.blocks for op in block.operations]


def constant_values(op: Any) -> np.ndarray:
    """The values of a constant of StableHLO, in its own shape."""
    result_type = op.results[0].type
    shape = tuple(result_type.shape)
    if str(result_type.element_type).startswith("complex"):
        return _complex_constant(str(op), shape)
    # If all entries are equal, MLIR stores one, and may hand out this one alone.
    return np.broadcast_to(np.asarray(op.attributes["value"]), shape)


def _complex_constant(text: str, shape: tuple[int, ...]) -> np.ndarray:
    """The values of a complex constant, of which MLIR gives only the text: either
    `dense<"0x...">` with the bytes of many, or `dense<[(1.0,2.0), ...]>`."""
    num_bytes = 8 if "complex<f64>" in text else 4
    if in_hexadecimal := re.search(r'dense<"0x([0-9A-F]+)">', text):
        parts = np.frombuffer(bytes.fromhex(in_hexadecimal[1]), f"<f{num_bytes}")
    else:
        # The type of the constant follows after the colon.
        pairs = re.findall(r"\(([^(),]+),([^(),]+)\)", text.split(" : ")[0])
        numbers = [_number_of(part, num_bytes) for pair in pairs for part in pair]
        parts = np.array(numbers, f"<f{num_bytes}")
    # Real and imaginary parts alternate. `real + 1j * imag` would turn an infinite part
    # into a NaN of the other.
    values = parts[::2] + 0j
    values.imag = parts[1::2]
    # A constant of equal entries is printed as one entry, which is repeated.
    return np.resize(values, shape)


def _number_of(text: str, num_bytes: int) -> float:
    """The number of this size that MLIR prints as this text: as hexadecimal bits if it is
    not finite."""
    text = text.strip()
    if not text.startswith("0x"):
        return float(text)
    bits = np.array(int(text, 16), f"<u{num_bytes}")
    return float(bits.view(f"<f{num_bytes}"))


class SourceLine(NamedTuple):
    """A line of a user's program.

    - `function`, `file`, `line`: where it stands.
    """

    function: str
    file: str
    line: int


def source_lines(location: str) -> list[SourceLine]:
    """The lines that an operation of MLIR comes from, innermost first, out of its printed
    location, which holds each as `"fn"("file.py":12:...)`. JAX records several lines if
    `jax_traceback_in_locations_limit` says so."""
    lines = re.findall(r'"([^"]*)"\("([^"]+)":(\d+)', location)
    return [
        SourceLine(_name_of_function(name), file, int(line))
        for name, file, line in lines
    ]


# What Python calls parts of a function: `fn.<locals>.<genexpr>` is a line of `fn`.
_UNNAMED = ("<locals>", "<genexpr>", "<listcomp>", "<dictcomp>", "<setcomp>")


def _name_of_function(qualified: str) -> str:
    """The name of the function that code of this qualified name stands in."""
    names = [part for part in qualified.split(".") if part not in _UNNAMED]
    return names[-1] if names else qualified
