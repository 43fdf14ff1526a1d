"""Replays a program that JAX lowered for one path on arrays with many paths."""

from collections import ChainMap
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np

from .._compat import stablehlo_module
from . import (  # noqa: F401 (they fill `RULES`)
    control_flow,
    linear_algebra,
    moves,
    reductions,
    windows,
)
from .mlir import block_of, callee_of, constant_values, functions_of, operations_in
from .operation import NotReplayed, Operation, RULES
from .operations import entry_by_entry
from .tensor import array_in_memory, ArrayType, MOST_IN_REGISTERS, Table, Tensor


_RETURNS = ("func.return", "stablehlo.return")

# From a variable of the program to its tensor. Regions see the variables of the block that
# they stand in, but not the other way round.
Values: TypeAlias = ChainMap[Any, Tensor]


class Replay:
    """A program in StableHLO as a function of tensors, within a kernel of Dr.Jit that the
    caller records.

    **Arguments:**

    - `program`: the text of the program, or the object that
        `jax.jit(fn).lower(...).compiler_ir("stablehlo")` returns. Its `main` is run.
    """

    def __init__(self, program: Any):
        # The module owns the operations, so that it must be kept.
        self._module = stablehlo_module(program)
        self._functions = functions_of(self._module)
        # The constants of more entries than stay in registers, by their variables.
        self._constants = {
            op.results[0]: constant_values(op)
            for op in _operations_within(self._module.operation)
            if op.name == "stablehlo.constant"
            and _type_of(op.results[0]).size > MOST_IN_REGISTERS
        }

    @property
    def arguments(self) -> list[ArrayType]:
        """The type of each argument."""
        return [_type_of(argument) for argument in self._main.arguments]

    @property
    def results(self) -> list[ArrayType]:
        """The type of each result."""
        *_, last = self._main.operations
        return [_type_of(result) for result in last.operands]

    @property
    def returned_arguments(self) -> list[int | None]:
        """For each result, the number of the argument that is returned unchanged as this
        result, or `None`."""
        arguments = [*self._main.arguments]
        *_, last = self._main.operations
        return [
            arguments.index(result) if result in arguments else None
            for result in last.operands
        ]

    @property
    def _main(self) -> Any:
        """The block of the function `main`, in MLIR."""
        return block_of(self._functions["main"])

    def constants(self) -> list[Any]:
        """The large constants of the program, as arrays of Dr.Jit in memory."""
        # The caller makes them once, and passes them to each call: a frozen function of
        # Dr.Jit takes arrays in memory as arguments only.
        return [
            array_in_memory(_type_of(variable).kind, values.ravel())
            for variable, values in self._constants.items()
        ]

    def __call__(
        self, *args: Tensor, constants: Sequence[Any] = ()
    ) -> tuple[list[Tensor], list[Any]]:
        """The results, and masks of the lanes that raise an error.

        `constants` are what `self.constants()` returned. Without it, large constants are
        written into the kernel.
        """
        memory = dict(zip(self._constants, constants))
        # Operations that fail append their masks.
        failures: list[Any] = []

        def call(name: str, args: Sequence[Tensor]) -> list[Tensor]:
            # A function of the program sees its arguments only.
            return run_block(block_of(self._functions[name]), args, ChainMap())

        # The results of a block, whose operations run one after another. `outer` holds the
        # variables that it sees from outside.
        def run_block(
            block: Any, args: Sequence[Tensor], outer: Values
        ) -> list[Tensor]:
            values = outer.new_child(dict(zip(block.arguments, args)))
            for view in block.operations:
                # The general form of an operation, for which MLIR may have a class of its
                # own.
                op = view.operation
                operands = [values[operand] for operand in op.operands]
                if op.name in _RETURNS:
                    return operands
                values.update(zip(op.results, results_of(op, operands, values)))
            raise AssertionError("A block ends with what it returns.")

        def results_of(op: Any, operands: list[Tensor], values: Values) -> list[Tensor]:
            if op.name == "func.call":
                try:
                    return call(callee_of(op), operands)
                except NotReplayed as error:
                    # An operation in a called function has no location in its caller.
                    error.location += str(op.location)
                    raise
            # A large constant stays in memory, where the caller has put it.
            if op.results and op.results[0] in memory:
                constant = self._constants[op.results[0]]
                places = np.arange(constant.size)
                table = Table(memory[op.results[0]], places, constant.ravel())
                return [Tensor(table, constant.shape)]
            # Rules need not treat results without entries: there is nothing to compute. (A
            # token, which orders side effects, has no shape.)
            shapes = [tuple(getattr(result.type, "shape", ())) for result in op.results]
            if shapes and all(0 in shape for shape in shapes):
                return [Tensor([], shape) for shape in shapes]

            def run(i: int, args: Sequence[Tensor]) -> list[Tensor]:
                return run_block(block_of(op, i), args, values)

            operation = Operation(op, run, failures)
            rule = RULES.get(operation.name, entry_by_entry)
            try:
                return rule(operation, *operands)
            except (TypeError, RuntimeError) as error:
                if _names_an_operation(error):
                    raise
                # An error of Dr.Jit names neither the operation nor its place.
                what = f"`{op.name}` of these types ({error})"
                raise NotReplayed(op, what) from error

        return call("main", args), failures


def _type_of(variable: Any) -> ArrayType:
    return ArrayType(tuple(variable.type.shape), str(variable.type.element_type))


def _names_an_operation(error: BaseException | None) -> bool:
    """Whether an error says which operation failed: it is a `NotReplayed`, or follows from
    one in a branch or loop, for which Dr.Jit raises an error of its own."""
    while error is not None and not isinstance(error, NotReplayed):
        error = error.__cause__ or error.__context__
    return error is not None


def _operations_within(op: Any) -> Iterator[Any]:
    """All operations in the regions of an operation, and in their regions."""
    for region in op.regions:
        for inner in operations_in(region):
            yield inner
            yield from _operations_within(inner)
