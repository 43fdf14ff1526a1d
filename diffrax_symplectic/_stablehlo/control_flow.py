"""Operations with regions: conditionals and loops."""

from typing import Any

from .backend import drjit
from .operation import rule
from .tensor import copied, flat, known, Tensor, unflat


@rule
def _optimization_barrier(o, *xs):
    return [*xs]


@rule
def _sharding_constraint(o, x):
    return [x]


def _raises(region: Any) -> bool:
    """Whether it calls back to Python, as `equinox.error_if` does to raise an error."""
    calls = [op for op in region.blocks[0].operations if "custom_call" in op.name]
    return any("callback" in op.attributes["call_target_name"].value for op in calls)


@rule
def _case(o, index):
    value, number = known(index), len(o.op.regions)
    if value is not None:
        return o.run(int(value) if 0 <= value < number else number - 1, [])
    branches = [i for i in range(number) if not _raises(o.op.regions[i])]
    o.errors.extend(index.item() == i for i in range(number) if i not in branches)

    def taken(left: list[int]) -> tuple:
        """The first of the branches, or one of the others."""
        first, *others = left
        if not others:
            return copied(o.run(first, []))
        here = index.item() == first
        run, rest = lambda: copied(o.run(first, [])), lambda: taken(others)
        return o.recorded(drjit().if_stmt, (), here, run, rest)

    return unflat(taken(branches), o.shapes())


@rule
def _if(o, condition):
    value = known(condition)
    if value is not None:
        return o.run(0 if value else 1, [])
    yes, no = (lambda i=i: copied(o.run(i, [])) for i in (0, 1))
    out = o.recorded(drjit().if_stmt, (), condition.item(), yes, no)
    return unflat(out, o.shapes())


# The most iterations to unroll, of a loop whose condition is known.
_WRITTEN_OUT = 8
# Of one that moves indices only, such as a bisection or the exchanges of rows of a matrix.
# Written out, most of its operations are folded.
_INDICES_WRITTEN_OUT = 32


@rule
def _while(o, *xs):
    body = o.op.regions[1].blocks[0]
    returned = [*[*body.operations][-1].operands]
    # Values that do not change stay out of the loop's state, so that constants stay known.
    moves = [a != b for a, b in zip(returned, body.arguments)]
    moving = lambda xs: [x for x, m in zip(xs, moves) if m]
    floats = any(drjit().is_float_v(e) for e in flat(moving(xs)))
    most = _WRITTEN_OUT if floats else _INDICES_WRITTEN_OUT
    xs, number = [*xs], 0
    while (go := known(o.run(0, xs)[0])) is not None and number < most:
        if not go:
            return xs
        xs, number = o.run(1, xs), number + 1
    start, fixed = moving(xs), xs
    shapes = [x.shape for x in start]

    def whole(entries) -> list[Tensor]:
        left = iter(unflat(entries, shapes))
        return [next(left) if m else x for x, m in zip(fixed, moves)]

    on = lambda *y: o.run(0, whole(y))[0].item()
    once = lambda *y: copied(moving(o.run(1, whole(y))))
    out = o.recorded(drjit().while_loop, flat(start), on, once, compress=False)
    return whole(out)
