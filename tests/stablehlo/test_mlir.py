"""What the replay of programs reads of the operations of MLIR. If one of these tests fails
after an upgrade of JAX, its name says what broke; other failures follow from it."""

import jax
import jax.numpy as jnp
import numpy as np

from diffrax_symplectic._compat import stablehlo_module
from diffrax_symplectic._stablehlo import mlir


# A module of MLIR owns its operations, and frees them.
_MODULES = []


def _lowered(fn, *shapes):
    structs = [jax.ShapeDtypeStruct(shape, "float32") for shape in shapes]
    return jax.jit(fn).lower(*structs)


def _operation(lowered, name: str):
    """The first operation with this name in the main function of a program."""
    _MODULES.append(lowered.compiler_ir("stablehlo"))
    main = mlir.functions_of(_MODULES[-1])["main"]
    operations = mlir.operations_in(main.operation.regions[0])
    return next(op for op in operations if op.name == name)


def test_a_program_in_stablehlo_is_the_same_as_text_and_as_a_module():
    """If this fails: find how JAX parses MLIR now, and adapt `stablehlo_module`."""
    square = jax.jit(lambda x: x @ x)
    lowered = _lowered(lambda x: square(square(x)), (2, 2))
    module = lowered.compiler_ir("stablehlo")
    assert stablehlo_module(module) is module
    parsed = stablehlo_module(lowered.as_text())
    functions = mlir.functions_of(parsed)
    assert functions.keys() == mlir.functions_of(module).keys() > {"main"}
    inside = mlir.operations_in(functions["main"].operation.regions[0])
    called = {mlir.callee_of(op) for op in inside if op.name == "func.call"}
    assert len(called) == 1 and called < {*functions}
    (argument,) = mlir.block_of(functions["main"]).arguments
    assert list(argument.type.shape) == [2, 2]
    assert str(argument.type.element_type) == "f32"


CONSTANTS = [
    np.array([[1.5, np.inf], [-0.0, np.nan]], np.float32),
    np.array([True, False]),
    np.zeros((2, 3)),
    np.array(2 - 1j, np.complex64),
    np.full((2, 2), 0.1 + 3j),
    np.array([1e300 - 1j, complex(np.inf, -0.0), complex(0, np.nan)]),
    np.arange(100) * (1 + 2j),
]


def test_values_of_constants_are_read():
    """If this fails: print the constant, and adapt `constant_values`."""
    for values in CONSTANTS:
        lowered = _lowered(lambda: jnp.asarray(values))
        found = mlir.constant_values(_operation(lowered, "stablehlo.constant"))
        assert found.dtype == values.dtype and found.shape == values.shape
        for part in (np.real, np.imag):
            np.testing.assert_array_equal(part(found), part(values))
            if values.dtype != bool:
                signs = np.signbit(part(found)), np.signbit(part(values))
                np.testing.assert_array_equal(*signs)
