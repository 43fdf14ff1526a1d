"""Replays a program that JAX lowered for one path on arrays with many paths."""

from collections import ChainMap
from typing import Any

from ._operation import NotReplayed, Operation
from ._operations import rule_of
from ._tensor import Tensor


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

    def __call__(self, *args: Tensor) -> tuple[list[Tensor], list[Any]]:
        """The results, and masks of the lanes that raise an error."""
        errors = []
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
        operation = Operation(op, run, errors)
        rule = rule_of(operation.name)
        if rule is None:
            raise NotReplayed(op)
        return rule(operation, *operands)
