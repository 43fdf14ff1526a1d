"""Operations with regions: conditionals and loops."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

from .backend import array_types, drjit
from .mlir import block_of, call_target, operations_in
from .operation import Operation, rule
from .tensor import as_own_literal, chosen, copied, flat, known, merged, Tensor, unflat


# A function that returns entries of arrays.
_Branch: TypeAlias = Callable[[], tuple[Any, ...]]


@rule
def _optimization_barrier(o, *xs):
    return [*xs]


@rule
def _sharding_constraint(o, x):
    return [x]


def _raises(region: Any) -> bool:
    """Whether it calls back to Python, as `equinox.error_if` does to raise an error."""
    calls = [op for op in operations_in(region) if "custom_call" in op.name]
    return any("callback" in call_target(op) for op in calls)


@rule
def _case(o, index):
    number = len(o.op.regions)
    value = known(index)
    if value is not None:
        # An index that is out of range stands for the last branch.
        return o.run(int(value) if 0 <= value < number else number - 1, [])
    raising = [i for i in range(number) if _raises(o.op.regions[i])]
    # A kernel cannot raise an error. Lanes that would are marked, and take another branch.
    for i in raising:
        o.fail(index.item() == i)
    branches = [i for i in range(number) if i not in raising]
    return unflat(_result_of_branch(o, index.item(), branches), o.shapes())


def _result_of_branch(
    o: Operation, index: Any, branches: Sequence[int]
) -> tuple[Any, ...]:
    """The entries that the branch with this index returns. If there is none in `branches`,
    it is the last of them."""
    first, *others = branches

    def run_first() -> tuple[Any, ...]:
        return copied(o.run(first, []))

    def run_others() -> tuple[Any, ...]:
        return _result_of_branch(o, index, others)

    if not others:
        return run_first()
    return _conditional(o, index == first, run_first, run_others)


def _conditional(
    o: Operation, condition: Any, if_true: _Branch, if_false: _Branch
) -> tuple[Any, ...]:
    """The entries that one of two functions returns: where the condition holds, those of
    the first."""

    def with_failures(branch: _Branch) -> _Branch:
        def run() -> tuple[Any, ...]:
            entries, failed = o.failing(branch)
            return *entries, failed

        return run

    # Symbolic: as part of the kernel. Otherwise Dr.Jit may run a branch at once.
    out = drjit().if_stmt(
        (),
        condition,
        with_failures(if_true),
        with_failures(if_false),
        mode="symbolic",
    )
    # A constant of the inside would abort the process if it were used outside.
    *entries, failed = map(as_own_literal, out)
    o.fail(failed)
    return tuple(entries)


@rule
def _if(o, condition):
    value = known(condition)
    if value is not None:
        return o.run(0 if value else 1, [])

    def if_true() -> tuple[Any, ...]:
        return copied(o.run(0, []))

    def if_false() -> tuple[Any, ...]:
        return copied(o.run(1, []))

    # With `select` in its place both branches run: the midpoint rule, whose sweeps have
    # such branches, took 21 ns a step in place of 13.
    out = _conditional(o, condition.item(), if_true, if_false)
    return unflat(out, o.shapes())


# The most iterations to unroll, of a loop whose condition is known.
_WRITTEN_OUT = 8
# Of one that moves indices only, such as a bisection or the exchanges of rows of a matrix.
# Written out, most of its operations are folded.
_INDICES_WRITTEN_OUT = 32


@rule
def _while(o, *xs):
    moves = _which_move(o)
    indices_only = not any(map(drjit().is_float_v, flat(chosen(xs, moves))))
    most = _INDICES_WRITTEN_OUT if indices_only else _WRITTEN_OUT
    state = [*xs]
    number = 0
    # As long as the condition is known, the loop is written out. What is left then, or
    # after too many iterations, is a loop of the kernel.
    while (go_on := known(o.run(0, state)[0])) is not None and number < most:
        if not go_on:
            return state
        state = o.run(1, state)
        number += 1
    return _loop(o, state, moves)


def _which_move(o: Operation) -> list[bool]:
    """Which values of a loop its body changes."""
    body = block_of(o.op, 1)
    *_, last = body.operations
    return [new != old for new, old in zip(last.operands, body.arguments)]


def _loop(o: Operation, state: list[Tensor], moves: Sequence[bool]) -> list[Tensor]:
    """A loop of the kernel, from this state on."""
    # Values that do not change stay out of the loop's state, so that constants stay known.
    start = chosen(state, moves)
    still = chosen(state, [not move for move in moves])
    shapes = [x.shape for x in start]

    def whole(entries: Iterable[Any]) -> list[Tensor]:
        return merged(moves, unflat(entries, shapes), still)

    def goes_on(failed: Any, *entries: Any) -> Any:
        (going,), new = o.failing(lambda: o.run(0, whole(entries)))
        # A lane that failed could go on for ever.
        return going.item() & ~(failed | new)

    def once(failed: Any, *entries: Any) -> tuple[Any, ...]:
        state, new = o.failing(lambda: o.run(1, whole(entries)))
        return failed | new, *copied(chosen(state, moves))

    # Where no lane can fail, Dr.Jit leaves the mask out.
    none = array_types()["i1"](False)
    out = drjit().while_loop((none, *flat(start)), goes_on, once, mode="symbolic")
    failed, *entries = map(as_own_literal, out)
    o.fail(failed)
    end = whole(entries)
    # A loop returns no mask of its condition, but such lanes have stopped there.
    o.run(0, end)
    return end
