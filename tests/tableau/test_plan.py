"""Plans compute what their tableaus say, with the fewest stages and the fewest unknowns.
Nothing here is traced."""

import dataclasses
import itertools

import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._solver import SOLVERS
from diffrax_symplectic._tableau import FlatTableau, make_plan, plan as plans, Stage


BOTH = ("h", "W")
# Stages that nearly equal each other. `_base` gives some of them equal rows, columns or
# weights, too, but what differs in any two of them forbids to merge them.
STAGES = (
    *[Stage(BOTH, c, "q", "p") for c in (0.1, 0.2, 0.1, 0.3)],
    *[Stage(BOTH, 0.3, "", part) for part in "pq"],
    *[Stage(BOTH, c, "p", "q") for c in (0.4, 0.4 + 1e-9)],
    *[Stage((name,), 0.5, "p", "q") for name in BOTH],
    *[Stage((name,), 0.6, "p", "q") for name in BOTH],
)


def _base(rng) -> FlatTableau:
    """A tableau in which no stage is unused and none can be merged with another."""
    n = len(STAGES)
    matrix, weights = rng.uniform(0.5, 1.5, (n, n)) / n, rng.uniform(0.5, 1.5, n)
    matrix[1] = matrix[0]
    matrix[3:6] = 0
    matrix[[7, 9, 11]] = matrix[[6, 8, 10]]
    # Drift and noise at one point: with different weights, and with different columns.
    matrix[:, 9], weights[11] = matrix[:, 8], weights[10]
    # The end of the step depends on stage 4 by way of two others only.
    weights[[4, 6, 7]], matrix[8:, 4] = 0, 0
    tableau = FlatTableau(STAGES, matrix, weights)
    return dataclasses.replace(tableau, matrix=np.where(tableau.reads_from, matrix, 0))


def _end(tableau: FlatTableau):
    """The end of a step of a linear system, with other vector fields for each channel: the
    stages by one linear solve."""
    rng = np.random.default_rng(1)
    field = {name: rng.normal(size=(2, 2)) for name in BOTH}
    push = {name: rng.normal(size=2) for name in BOTH}
    n, y0 = len(tableau.stages), rng.normal(size=2)
    part = {"p": np.array([1, 0]), "q": np.array([0, 1]), "": np.zeros(2)}
    A, b = np.zeros((n, 2, n, 2)), np.zeros((n, 2))
    for i, (channels, c, reads, writes) in enumerate(tableau.stages):
        slope = np.diag(part[writes]) @ sum(field[x] for x in channels)
        slope = slope @ np.diag(part[reads])
        A[i] = np.einsum("ab,j->ajb", slope, tableau.matrix[i])
        b[i] = slope @ y0 + c * part[writes] * sum(push[x] for x in channels)
    k = np.linalg.solve(np.eye(2 * n) - A.reshape(2 * n, 2 * n), b.ravel())
    return y0 + tableau.weights @ k.reshape(n, 2)


def _in_more_words(tableau: FlatTableau, rng) -> FlatTableau:
    """The same method: values in two parts, drift apart from noise, unused stages, and
    coefficients of values that are not read."""
    n = len(tableau.stages)
    for i in rng.permutation(n)[:6].tolist():
        new = len(tableau.stages)
        tableau = tableau.take([*range(new), i])
        share = rng.uniform(0.2, 0.4)
        shares = share, 1 - share
        if tableau.stages[i].channels == BOTH and rng.random() < 0.5:
            stages, shares = list(tableau.stages), (1, 1)
            stages[i], stages[new] = [stages[i]._replace(channels=(x,)) for x in BOTH]
            tableau = dataclasses.replace(tableau, stages=tuple(stages))
        for x in (tableau.matrix, tableau.weights):
            x[..., [i, new]] *= shares
    # The second of the unused stages is used by the first alone.
    used = len(tableau.stages)
    tableau = tableau.take([*range(used), 0, 1])
    tableau.matrix[:, used:], tableau.weights[used:] = 0, 0
    tableau.matrix[used, used + 1] = 1
    junk = np.where(
        tableau.reads_from, tableau.matrix, rng.normal(size=tableau.matrix.shape)
    )
    order = rng.permutation(used + 2).tolist()
    return dataclasses.replace(tableau, matrix=junk).take(order)


def test_what_a_tableau_says_twice_or_in_vain_is_left_out():
    rng = np.random.default_rng(0)
    for _ in range(20):
        base = _base(rng)
        longer = _in_more_words(base, rng)
        plan = make_plan(longer)
        assert len(plan.tableau.stages) == len(base.stages) < len(longer.stages)
        for tableau in (longer, plan.tableau):
            np.testing.assert_allclose(_end(tableau), _end(base), atol=1e-12)
        _check_blocks(plan)


def test_stages_whose_values_cancel_are_left_out():
    # In floating point, 0.1 + 0.2 is not 0.3.
    stages = tuple(Stage(("h",), 0.5, "y", "y") for _ in range(4))
    weights = np.array([0.1, 0.2, -0.3, 1.0])
    matrix = np.array([[0, 0, 0, 0.0]] * 3 + [weights - [0, 0, 0, 0.5]])
    plan = make_plan(FlatTableau(stages, matrix, weights))
    assert plan.tableau.matrix.tolist() == [[0.5]] and plan.tableau.weights == 1


def _check_blocks(plan):
    """That the blocks can be carried out in order, and that the unknowns are as few as
    possible."""
    depends = plan.tableau.matrix != 0
    kind = lambda i: plan.tableau.stages[i].kind
    known: set[int] = set()
    for block in plan.blocks:
        members = [i for group in (*block.unknown, *block.explicit) for i in group]
        assert known.isdisjoint(members) and len(members) == len({*members})
        for group in (*block.unknown, *block.explicit):
            assert list(group) == sorted(group) and len({*map(kind, group)}) == 1
        unknown = [i for group in block.unknown for i in group]
        # All in one group, or of several kinds, each alone, those of a kind in a row.
        kinds = {*map(kind, unknown)}
        assert len(block.unknown) == (len(kinds) if len(kinds) < 2 else len(unknown))
        assert len(kinds) == len([*itertools.groupby(unknown, kind)])
        known |= {*unknown}
        for group in block.explicit:
            assert known.issuperset(np.flatnonzero(depends[list(group)].any(0)))
            known |= {*group}
        assert known.issuperset(np.flatnonzero(depends[unknown].any(0)))
        # It is no two blocks, and fewer unknowns leave a cycle.
        inner = depends[np.ix_(members, members)]
        power = lambda x: np.linalg.matrix_power(x.astype(float), len(x))
        assert len(members) == 1 or power(inner + np.eye(len(members))).all()
        if unknown == []:
            continue
        for fewer in itertools.combinations(range(len(members)), len(unknown) - 1):
            rest = np.delete(np.delete(inner, fewer, 0), fewer, 1)
            assert power(rest).any()
    assert known == {*range(len(depends))}


def test_blocks_are_solved_in_order_for_the_fewest_unknowns():
    rng = np.random.default_rng(0)
    for density in np.linspace(0.1, 0.9, 40):
        parts = rng.choice([*"pq"], (2, 8)).tolist()
        stages = tuple(
            Stage(("h",), i / 8, *part) for i, part in enumerate(zip(*parts))
        )
        matrix = np.where(rng.random((8, 8)) < density, rng.normal(size=(8, 8)), 0)
        _check_blocks(make_plan(FlatTableau(stages, matrix, np.ones(8))))


def test_the_search_for_few_unknowns_is_bounded(monkeypatch):
    # Six stages are read by ten others, each of which one of the six reads, and so closes a
    # cycle. The last of the ten reads only one of them. Twelve more stages read the ten.
    six, ten, more = np.split(np.arange(28), [6, 16])
    matrix = np.zeros((28, 28))
    matrix[np.ix_(ten, six)] = 0.1
    matrix[15, six] = np.where(six == 15 % 6, 0.1, 0)
    matrix[ten % 6, ten] = 0.1
    matrix[np.ix_(more, ten)] = 0.1
    stages = tuple(Stage(("h",), c, "y", "y") for c in np.linspace(0, 1, 28))
    tableau, tried = FlatTableau(stages, matrix, np.ones(28)), []
    rounds = plans._rounds
    monkeypatch.setattr(plans, "_rounds", lambda *a: tried.append(a) or rounds(*a))
    first, *rest = make_plan(tableau).blocks
    # Nothing is wrong with more unknowns than needed.
    assert first.unknown == ((*six, *ten),) and first.explicit == ()
    assert all(block.unknown == () for block in rest) and len(rest) == len(more)
    assert len(tried) < 1000


@pytest.mark.parametrize("solver", [s for s in SOLVERS if hasattr(s, "tableau")])
def test_the_fewest_unknowns_of_every_solver_are_found(solver):
    _check_blocks(make_plan(solver().tableau.flatten()))


def test_plans_of_equal_tableaus_are_made_once():
    tableau = ds.SRKw2().tableau.flatten()
    assert make_plan(tableau) is make_plan(ds.SRKw2().tableau.flatten())
