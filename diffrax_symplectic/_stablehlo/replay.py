"""Replays a program that JAX lowered for one path: runs its operations on arrays that hold
many paths, each in a *lane* of its own.

A program in MLIR consists of functions. A function has a *block*, a list of operations that
ends with what the block returns. Some operations have *regions*, such as the body of a
loop, each with a block of its own. A *variable* is an argument of a block or a result of an
operation.
"""

from collections import ChainMap
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

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

# The tensor of each variable of a block. The block of a region sees the variables of the
# block around it, which does not see those of the region. So the map of each block has the
# map of the block around it behind it.
Values: TypeAlias = ChainMap[Any, Tensor]


class Replay:
    """A program in StableHLO as a function of tensors, within a kernel of Dr.Jit that the
    caller records.

    **Arguments:**

    - `program`: the text of the program, or the object that
        `jax.jit(fn).lower(...).compiler_ir("stablehlo")` returns. Its `main` is run.
    """

    def __init__(self, program: Any):
        # Operations exist only as long as the module, so the module is kept.
        self._module = stablehlo_module(program)
        self._functions = functions_of(self._module)
        # From the variables of large constants, which have too many entries for registers,
        # to their values.
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
        """For each result, the index of the argument that the program returns unchanged as
        this result, or `None` if there is none."""
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
        # The caller makes these arrays once, and passes them to each call: a function that
        # Dr.Jit freezes may read arrays in memory only if they are its arguments.
        return [
            array_in_memory(_type_of(variable).kind, values.ravel())
            for variable, values in self._constants.items()
        ]

    def __call__(
        self, *args: Tensor, constants: Sequence[Any] = ()
    ) -> tuple[list[Tensor], list[Any]]:
        """The results, and masks of the lanes that fail, for example since the program
        would raise an error there.

        `constants` are what `self.constants()` returned. Without them, large constants are
        written into the kernel.
        """
        tables = {}
        for (variable, values), memory in zip(self._constants.items(), constants):
            table = Table(memory, np.arange(values.size), values.ravel())
            tables[variable] = Tensor(table, values.shape)
        run = _Run(self._functions, tables, failures=[])
        return run.call("main", args), run.failures


class _Run(NamedTuple):
    """One run of a program.

    - `functions`: the functions of the program, by their names.
    - `tables`: the constants that stay in memory, by their variables.
    - `failures`: masks of the lanes that fail, to which operations append.
    """

    functions: dict[str, Any]
    tables: dict[Any, Tensor]
    failures: list[Any]

    def call(self, name: str, args: Sequence[Tensor]) -> list[Tensor]:
        """The results of a function of the program."""
        # A function sees its arguments only.
        return self.run_block(block_of(self.functions[name]), args, outer=ChainMap())

    def run_block(
        self, block: Any, args: Sequence[Tensor], outer: Values
    ) -> list[Tensor]:
        """Runs the operations of a block one after another, and returns the results of the
        block. `outer` holds the variables that the block sees from outside."""
        values = outer.new_child(dict(zip(block.arguments, args)))
        # For some operations MLIR has classes of their own. Here all have the general one.
        for view in block.operations:
            op = view.operation
            operands = [values[operand] for operand in op.operands]
            if op.name in _RETURNS:
                return operands
            values.update(zip(op.results, self.results_of(op, operands, values)))
        raise AssertionError("A block ends with what it returns.")

    def results_of(
        self, op: Any, operands: list[Tensor], values: Values
    ) -> list[Tensor]:
        """The results of an operation in a block with the variables `values`: by its rule,
        unless it is

        - a call of a function of the program,
        - a large constant, which is in memory,
        - or an operation whose results have no entries: there is nothing to compute.
        """
        if op.name == "func.call":
            return self.results_of_call(op, operands)
        if op.results and op.results[0] in self.tables:
            return [self.tables[op.results[0]]]
        # A result without a shape is a token, which orders side effects: `()` stands in.
        shapes = [tuple(getattr(result.type, "shape", ())) for result in op.results]
        if shapes and all(0 in shape for shape in shapes):
            return [Tensor([], shape) for shape in shapes]

        def run_region(i: int, args: Sequence[Tensor]) -> list[Tensor]:
            return self.run_block(block_of(op, i), args, outer=values)

        operation = Operation(op, run_region, self.failures)
        rule = RULES.get(operation.name, entry_by_entry)
        try:
            return rule(operation, *operands)
        except (TypeError, RuntimeError) as error:
            # An operation in a region of this one may have been refused already.
            if _names_an_operation(error):
                raise
            # Errors of Dr.Jit name neither the operation nor its location.
            what = f"`{op.name}` of these types ({error})"
            raise NotReplayed(op, what) from error

    def results_of_call(self, op: Any, operands: list[Tensor]) -> list[Tensor]:
        """The results of an operation that calls a function of the program."""
        try:
            return self.call(callee_of(op), operands)
        except NotReplayed as error:
            # The location of an operation in the function does not say who calls it.
            error.location += str(op.location)
            raise


def _type_of(variable: Any) -> ArrayType:
    return ArrayType(tuple(variable.type.shape), str(variable.type.element_type))


def _names_an_operation(error: BaseException | None) -> bool:
    """Whether an error says which operation failed: it is a `NotReplayed`, or was raised
    from one. (If a branch or the body of a loop raises an error, Dr.Jit raises one of its
    own from it.)"""
    while error is not None and not isinstance(error, NotReplayed):
        error = error.__cause__ or error.__context__
    return error is not None


def _operations_within(op: Any) -> Iterator[Any]:
    """All operations in the regions of an operation, at any depth."""
    for region in op.regions:
        for inner in operations_in(region):
            yield inner
            yield from _operations_within(inner)
