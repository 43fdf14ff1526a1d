"""Replays a program that JAX lowered for one path on arrays with many paths."""

import math
from collections import ChainMap
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from .operation import NotReplayed, Operation
from .operations import rule_of
from .tensor import MOST_IN_REGISTERS, Table, Tensor


_RETURNS = ("func.return", "stablehlo.return")


class Replay:
    """A module of StableHLO as a function of tensors. Dr.Jit records the operations as part
    of the kernel of the caller."""

    def __init__(self, module: Any):
        self._module = module  # It owns the operations.
        functions = [
            f for f in module.body.operations if f.operation.name == "func.func"
        ]
        self._functions = {f.attributes["sym_name"].value: f for f in functions}
        # Large constants, by their variables. Callers keep them in memory.
        self.constants = _large_constants(functions)

    @property
    def arguments(self) -> list[tuple[tuple[int, ...], str]]:
        """The shape and type of each argument."""
        types = [x.type for x in self._main.arguments]
        return [(tuple(t.shape), str(t.element_type)) for t in types]

    @property
    def handed_on(self) -> list[int | None]:
        """For each result, the number of the argument that it equals, or `None`."""
        (*_, last), arguments = self._main.operations, [*self._main.arguments]
        where = lambda x: next((i for i, a in enumerate(arguments) if a == x), None)
        return [where(x) for x in last.operands]

    @property
    def _main(self) -> Any:
        return self._functions["main"].regions[0].blocks[0]

    def __call__(
        self, *args: Tensor, memory: Sequence[Any] = ()
    ) -> tuple[list[Tensor], list[Any]]:
        """The results, and masks of the lanes that raise an error. `memory` has the arrays
        of `constants`."""
        errors = []
        self._memory = dict(zip(self.constants, memory))
        return self._call("main", args, errors), errors

    def _call(self, name: str, args, errors: list[Any]) -> list[Tensor]:
        block = self._functions[name].regions[0].blocks[0]
        return self._block(block, args, ChainMap(), errors)

    def _block(
        self, block: Any, args, outer: ChainMap, errors: list[Any]
    ) -> list[Tensor]:
        values = outer.new_child(dict(zip(block.arguments, args)))
        for op in block.operations:
            op = op.operation
            operands = [values[x] for x in op.operands]
            if op.name in _RETURNS:
                return operands
            results = self._results(op, operands, values, errors)
            values.update(zip(op.results, results))
        raise AssertionError("A block ends with what it returns.")

    def _results(
        self, op: Any, operands: list[Tensor], values: ChainMap, errors: list[Any]
    ) -> list[Tensor]:
        if op.name == "func.call":
            try:
                return self._call(op.attributes["callee"].value, operands, errors)
            except NotReplayed as error:
                # The location of a called function does not name its caller.
                error.location += str(op.location)
                raise
        run = lambda i, args: self._block(op.regions[i].blocks[0], args, values, errors)
        if op.results and op.results[0] in self._memory:
            given = self.constants[op.results[0]]
            places = np.arange(given.size)
            table = Table(self._memory[op.results[0]], places, given.ravel())
            return [Tensor(table, given.shape)]
        operation = Operation(op, run, errors)
        rule = rule_of(operation.name)
        if rule is None:
            raise NotReplayed(op)
        try:
            return rule(operation, *operands)
        except TypeError as error:
            # Dr.Jit's own, which names neither the operation nor its place.
            raise NotReplayed(op, f"`{op.name}` of these types ({error})") from error


def _large_constants(functions: list[Any]) -> dict[Any, np.ndarray]:
    """The real constants of more entries than stay in registers."""
    out = {}
    for op in _operations(functions):
        if op.name != "stablehlo.constant":
            continue
        of = op.results[0].type
        real = "complex" not in str(of.element_type)
        if real and math.prod(of.shape) > MOST_IN_REGISTERS:
            values = np.asarray(op.attributes["value"])
            out[op.results[0]] = np.broadcast_to(values, of.shape)
    return out


def _operations(functions: list[Any]) -> Iterator[Any]:
    """All operations, those of regions included."""
    left = [f.operation for f in functions]
    while left:
        op = left.pop()
        yield op
        for region in op.regions:
            left.extend(
                x.operation for block in region.blocks for x in block.operations
            )
