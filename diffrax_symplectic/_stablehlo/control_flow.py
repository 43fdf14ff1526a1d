"""Operations with regions: conditionals and loops."""

from collections.abc import Callable, Iterable
from typing import Any

from .backend import array_types, dr
from .mlir import block_of, call_target, operations_in
from .operation import Operation, rule
from .tensor import (
    as_own_literal,
    copied_entries,
    entries_of,
    known_value,
    Tensor,
    tensors_from,
)


# The numbers of the regions of a conditional, and of a loop.
_IF_TRUE = 0
_IF_FALSE = 1
_CONDITION = 0
_BODY = 1


@rule
def _optimization_barrier(operation: Operation, *xs: Tensor) -> list[Tensor]:
    return [*xs]


@rule
def _sharding_constraint(operation: Operation, x: Tensor) -> list[Tensor]:
    return [x]


def _raises(region: Any) -> bool:
    """Whether a region calls back to Python, as it does for `equinox.error_if`."""
    calls = [op for op in operations_in(region) if "custom_call" in op.name]
    return any("callback" in call_target(op) for op in calls)


@rule
def _case(operation: Operation, index: Tensor) -> list[Tensor]:
    regions = operation.mlir_op.regions
    last = len(regions) - 1
    value = known_value(index)
    if value is not None:
        # An index that is out of range stands for the last branch.
        return operation.run(value if 0 <= value <= last else last, [])
    # A kernel cannot raise an error. Lanes whose branch would raise one are marked as
    # failed, and take the last of the other branches.
    branches = {}
    for i, region in enumerate(regions):
        if _raises(region):
            operation.fail(index.item() == i)
        else:
            branches[i] = index.item() == i
    return tensors_from(_results_of_branch(operation, branches), operation.shapes)


@rule
def _if(operation: Operation, condition: Tensor) -> list[Tensor]:
    value = known_value(condition)
    if value is not None:
        return operation.run(_IF_TRUE if value else _IF_FALSE, [])
    # With `select` in its place both branches run: the midpoint rule, whose sweeps have
    # such branches, took 21 ns a step in place of 13.
    branches = {_IF_TRUE: condition.item(), _IF_FALSE: ~condition.item()}
    return tensors_from(_results_of_branch(operation, branches), operation.shapes)


def _results_of_branch(
    operation: Operation, branches: dict[int, Any]
) -> tuple[Any, ...]:
    """The entries that a branch returns: for each lane the first whose mask is true, or
    the last. `branches` has their masks, by the numbers of their regions. Lanes that fail
    in their branch are marked."""
    (first, is_first), *others = branches.items()

    def run_first() -> tuple[Any, ...]:
        return copied_entries(operation.run(first, []))

    def run_one_of_others() -> tuple[Any, ...]:
        return _results_of_branch(operation, dict(others))

    def with_failures(branch: Callable[[], tuple[Any, ...]]) -> Callable:
        def run() -> tuple[Any, ...]:
            entries, failed = operation.with_failures(branch)
            return *entries, failed

        return run

    if not others:
        return run_first()
    # A symbolic conditional is a part of the kernel. Otherwise Dr.Jit may run a branch at
    # once.
    results = dr.if_stmt(
        args=(),
        cond=is_first,
        true_fn=with_failures(run_first),
        false_fn=with_failures(run_one_of_others),
        mode="symbolic",
    )
    # A constant of the inside would abort the process if it were used outside, so constants
    # are made anew.
    *entries, failed = map(as_own_literal, results)
    operation.fail(failed)
    return tuple(entries)


# The most iterations to unroll, of a loop whose condition is known.
_MOST_UNROLLED = 8
# The same for a loop that changes indices only, such as a bisection or the exchanges of
# rows of a matrix. Most operations of its unrolled iterations are folded.
_MOST_UNROLLED_OF_INDICES = 32


@rule
def _while(operation: Operation, *xs: Tensor) -> list[Tensor]:
    body = block_of(operation.mlir_op, _BODY)
    # The last operation returns the new state.
    *_, last = body.operations
    is_changing = [new != old for new, old in zip(last.operands, body.arguments)]
    changing = [k for k, is_new in enumerate(is_changing) if is_new]
    changing_entries = entries_of([xs[k] for k in changing])
    has_only_indices = not any(map(dr.is_float_v, changing_entries))
    max_unrolled = _MOST_UNROLLED_OF_INDICES if has_only_indices else _MOST_UNROLLED
    state = [*xs]
    # As long as the condition is known, the loop is unrolled. The iterations that are left
    # then, or after too many, are a loop of the kernel.
    for _ in range(max_unrolled):
        (condition,) = operation.run(_CONDITION, state)
        goes_on = known_value(condition)
        if goes_on is None:
            break
        if not goes_on:
            return state
        state = operation.run(_BODY, state)
    return _loop(operation, state, changing)


def _loop(
    operation: Operation, start: list[Tensor], changing: list[int]
) -> list[Tensor]:
    """The state at the end of a loop of the kernel, which starts from `start`. The values
    of the state that its body changes have the numbers `changing`."""
    # Values that do not change stay out of the loop's state, so that constants stay known.
    variables = [start[k] for k in changing]

    def whole_state(entries: Iterable[Any]) -> list[Tensor]:
        state = [*start]
        new = tensors_from(entries, [x.shape for x in variables])
        for k, x in zip(changing, new):
            state[k] = x
        return state

    # The mask of the lanes that failed so far is part of the state of Dr.Jit's loop, which
    # returns nothing else.
    def goes_on(failed: Any, *entries: Any) -> Any:
        (condition,), fails_now = operation.with_failures(
            lambda: operation.run(_CONDITION, whole_state(entries))
        )
        # A lane that failed could go on for ever.
        return condition.item() & ~(failed | fails_now)

    def iterate(failed: Any, *entries: Any) -> tuple[Any, ...]:
        state, fails_now = operation.with_failures(
            lambda: operation.run(_BODY, whole_state(entries))
        )
        return failed | fails_now, *copied_entries([state[k] for k in changing])

    # Where no lane can fail, Dr.Jit leaves the mask out.
    no_lane = array_types()["i1"](False)
    results = dr.while_loop(
        state=(no_lane, *entries_of(variables)),
        cond=goes_on,
        body=iterate,
        mode="symbolic",
    )
    failed, *entries = map(as_own_literal, results)
    operation.fail(failed)
    state_at_end = whole_state(entries)
    # What fails in the last test of the condition is not in the state. The condition is run
    # once more, to fail in these lanes; its value is not used.
    operation.run(_CONDITION, state_at_end)
    return state_at_end
