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
    """Whether a region calls back to Python, as it does for `equinox.error_if`."""
    calls = [op for op in operations_in(region) if "custom_call" in op.name]
    return any("callback" in call_target(op) for op in calls)


@rule
def _case(o, index):
    num_branches = len(o.op.regions)
    value = known(index)
    if value is not None:
        # An index that is out of range stands for the last branch.
        is_in_range = 0 <= value < num_branches
        return o.run(int(value) if is_in_range else num_branches - 1, [])
    # A kernel cannot raise an error. Lanes that would are marked, and take another branch.
    branches = []
    for i, region in enumerate(o.op.regions):
        if _raises(region):
            o.fail(index.item() == i)
        else:
            branches.append(i)
    return unflat(_result_of_branch(o, index.item(), branches), o.shapes())


def _result_of_branch(
    o: Operation, index: Any, branches: Sequence[int]
) -> tuple[Any, ...]:
    """The entries that the branch of this index returns, or the last of `branches` if these
    do not contain it."""
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

    # A symbolic conditional is a part of the kernel. Otherwise Dr.Jit may run a branch at
    # once.
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
_MOST_UNROLLED = 8
# The same for a loop that changes indices only, such as a bisection or the exchanges of
# rows of a matrix. Most operations of its unrolled iterations are folded.
_MOST_UNROLLED_OF_INDICES = 32


@rule
def _while(o, *xs):
    changes = _which_change(o)
    indices_only = not any(map(drjit().is_float_v, flat(chosen(xs, changes))))
    most = _MOST_UNROLLED_OF_INDICES if indices_only else _MOST_UNROLLED
    state = [*xs]
    # As long as the condition is known, the loop is unrolled. The iterations that are left
    # then, or after too many, are a loop of the kernel.
    for _ in range(most):
        (condition,) = o.run(0, state)
        goes_on = known(condition)
        if goes_on is None:
            break
        if not goes_on:
            return state
        state = o.run(1, state)
    return _loop(o, state, changes)


def _which_change(o: Operation) -> list[bool]:
    """Which values of a loop its body changes."""
    body = block_of(o.op, 1)
    *_, last = body.operations
    return [new != old for new, old in zip(last.operands, body.arguments)]


def _loop(o: Operation, state: list[Tensor], changes: Sequence[bool]) -> list[Tensor]:
    """A loop of the kernel, from this state on."""
    # Values that do not change stay out of the loop's state, so that constants stay known.
    variables = chosen(state, changes)
    constants = chosen(state, [not change for change in changes])
    shapes = [x.shape for x in variables]

    def whole_state(entries: Iterable[Any]) -> list[Tensor]:
        return merged(changes, unflat(entries, shapes), constants)

    def goes_on(failed: Any, *entries: Any) -> Any:
        (condition,), fails_now = o.failing(lambda: o.run(0, whole_state(entries)))
        # A lane that failed could go on for ever.
        return condition.item() & ~(failed | fails_now)

    def iterate(failed: Any, *entries: Any) -> tuple[Any, ...]:
        new_state, fails_now = o.failing(lambda: o.run(1, whole_state(entries)))
        return failed | fails_now, *copied(chosen(new_state, changes))

    # Where no lane can fail, Dr.Jit leaves the mask out.
    none = array_types()["i1"](False)
    out = drjit().while_loop(
        (none, *flat(variables)), goes_on, iterate, mode="symbolic"
    )
    failed, *entries = map(as_own_literal, out)
    o.fail(failed)
    end = whole_state(entries)
    # A loop of Dr.Jit does not return the lanes that fail in its condition. They stopped
    # there, so that the condition at the end marks them once more.
    o.run(0, end)
    return end
