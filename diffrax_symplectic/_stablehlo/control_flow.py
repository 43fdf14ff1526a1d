"""Operations with regions: conditionals and loops.

If the condition is known while the kernel is recorded, only the region that it selects is
recorded, and loops are unrolled. Otherwise the operation is a conditional or a loop of the
kernel, in which each lane takes its own branch and makes its own number of iterations.
"""

import functools as ft
from collections.abc import Iterable
from typing import Any

from .backend import array_types, dr
from .mlir import block_of, call_target, operations_in
from .operation import Operation, rule
from .tensor import (
    copied_entries,
    entries_of,
    known_value,
    Tensor,
    tensors_from,
    usable_outside,
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


@rule
def _case(operation: Operation, index: Tensor) -> list[Tensor]:
    """Runs the region with the number `index`, which may differ between lanes."""
    regions = operation.mlir_op.regions
    last = len(regions) - 1
    value = known_value(index)
    if value is not None:
        # An index that is out of range selects the last region.
        return operation.run(value if 0 <= value <= last else last, [])
    # A kernel cannot raise an error. Lanes whose region would raise one are marked as
    # failed, and run the last of the other regions.
    masks = {}
    for i, region in enumerate(regions):
        if _raises(region):
            operation.fail(index.item() == i)
        else:
            masks[i] = index.item() == i
    if not masks:
        raise operation.refusal("with a call of Python in each branch")
    return tensors_from(_run_selected(operation, masks), operation.shapes)


def _raises(region: Any) -> bool:
    """Whether a region calls back to Python, as it does for `equinox.error_if`."""
    calls = [op for op in operations_in(region) if "custom_call" in op.name]
    return any("callback" in call_target(op) for op in calls)


@rule
def _if(operation: Operation, condition: Tensor) -> list[Tensor]:
    """Runs the first of two regions in the lanes where the condition is true, and the
    second in the remaining lanes."""
    value = known_value(condition)
    if value is not None:
        return operation.run(_IF_TRUE if value else _IF_FALSE, [])
    # This is a conditional of the kernel, since with `select` both regions would run. The
    # sweeps of the midpoint rule have such conditionals: with `select` a step took 21 ns in
    # place of 13.
    masks = {_IF_TRUE: condition.item(), _IF_FALSE: ~condition.item()}
    return tensors_from(_run_selected(operation, masks), operation.shapes)


def _run_selected(operation: Operation, masks: dict[int, Any]) -> tuple[Any, ...]:
    """Runs one of several regions in each lane, and returns the entries of its results.
    `masks` maps the number of each region to the mask of the lanes that select it:

        if masks[first]: run the first region
        elif masks[second]: run the second region
        ...
        else: run the last region

    The last mask is not read: a lane without a true mask runs the last region, too. Lanes
    that fail in the region that they run are marked as failed. (Regions of conditionals
    have no arguments. They read variables from outside.)
    """
    (region, is_selected), *others = masks.items()

    def run_region() -> tuple[Any, ...]:
        return copied_entries(operation.run(region, []))

    def run_one_of_others() -> tuple[Any, ...]:
        return _run_selected(operation, dict(others))

    if not others:
        return run_region()
    # With `mode="symbolic"` the conditional is a part of the kernel. Otherwise Dr.Jit may
    # run a branch at once.
    entries, failed = dr.if_stmt(
        args=(),
        cond=is_selected,
        true_fn=ft.partial(operation.with_failures, run_region),
        false_fn=ft.partial(operation.with_failures, run_one_of_others),
        mode="symbolic",
    )
    operation.fail(usable_outside(failed))
    return tuple(map(usable_outside, entries))


# The most iterations of a loop that are unrolled, if its condition is known.
_MOST_UNROLLED = 8
# The same for a loop that changes only integers and truth values, such as a bisection or
# the exchanges of rows of a matrix. Dr.Jit folds most operations of its iterations.
_MOST_UNROLLED_OF_INDICES = 32


@rule
def _while(operation: Operation, *start: Tensor) -> list[Tensor]:
    """A loop over a state, a list of arrays which is `start` at first. As long as the
    condition holds for the state, the body maps it to the next state.

    The first iterations are unrolled: as many as have a known condition, up to a limit. All
    iterations after them are a loop of the kernel.
    """
    changing = _indices_of_changing_arrays(operation)
    changing_entries = entries_of([start[k] for k in changing])
    has_only_indices = not any(map(dr.is_float_v, changing_entries))
    max_unrolled = _MOST_UNROLLED_OF_INDICES if has_only_indices else _MOST_UNROLLED
    state = [*start]
    for _ in range(max_unrolled):
        (condition,) = operation.run(_CONDITION, state)
        is_met = known_value(condition)
        if is_met is None:
            break
        # The loop ends within the unrolled iterations.
        if not is_met:
            return state
        state = operation.run(_BODY, state)
    return _loop(operation, state, changing)


def _indices_of_changing_arrays(operation: Operation) -> list[int]:
    """The indices, in the state of a loop, of the arrays that its body may change: all but
    those that the body returns as they are."""
    body = block_of(operation.mlir_op, _BODY)
    *_, returns = body.operations
    old_and_new = zip(body.arguments, returns.operands)
    return [k for k, (old, new) in enumerate(old_and_new) if old != new]


def _loop(
    operation: Operation, start: list[Tensor], changing: list[int]
) -> list[Tensor]:
    """The state at the end of a loop of the kernel that begins with the state `start`. The
    body changes only the arrays with the indices `changing`.

    The state of Dr.Jit's loop is not the whole state:

    - It has no arrays that do not change, so that constants among them stay known.
    - It begins with `failed`, the mask of the lanes that have failed so far, since Dr.Jit's
        loop returns its state and nothing else.
    """
    changing_arrays = [start[k] for k in changing]

    def whole_state(entries: Iterable[Any]) -> list[Tensor]:
        """The state in which the changing arrays have these entries."""
        state = [*start]
        new_arrays = tensors_from(entries, [x.shape for x in changing_arrays])
        for k, x in zip(changing, new_arrays):
            state[k] = x
        return state

    def goes_on(failed: Any, *entries: Any) -> Any:
        (condition,), fails_now = operation.with_failures(
            lambda: operation.run(_CONDITION, whole_state(entries))
        )
        # A lane that failed leaves the loop: its condition might hold forever.
        return condition.item() & ~(failed | fails_now)

    def iterate(failed: Any, *entries: Any) -> tuple[Any, ...]:
        state, fails_now = operation.with_failures(
            lambda: operation.run(_BODY, whole_state(entries))
        )
        return failed | fails_now, *copied_entries([state[k] for k in changing])

    # If no lane can fail, the mask stays constant, and Dr.Jit leaves it out.
    no_lane = array_types()["i1"](False)
    results = dr.while_loop(
        state=(no_lane, *entries_of(changing_arrays)),
        cond=goes_on,
        body=iterate,
        mode="symbolic",
    )
    failed, *entries = map(usable_outside, results)
    operation.fail(failed)
    state_at_end = whole_state(entries)
    # If a lane fails while the condition is evaluated, `goes_on` ends its loop, but cannot
    # change `failed`. So the condition is evaluated once more, only to mark such lanes.
    operation.run(_CONDITION, state_at_end)
    return state_at_end
