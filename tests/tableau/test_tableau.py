"""Coefficients satisfy their conditions, and only live, distinct stages are solved."""

import dataclasses
import itertools
from typing import ClassVar

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._tableau import make_plan
from examples._srkw2 import PaperSRKw2, srkw2_tableau

from ..solver.test_every_solver import TABLE


SOLVERS = [
    *(solver for solver in TABLE if hasattr(solver, "tableau")),
    *(ds.SRKs1(a=a) for a in (-0.3, 0.0, 0.4, 0.5)),
    *(ds.SRKw1(b=b) for b in (-0.3, 0.0, 0.7, 1.0)),
]
each_solver = pytest.mark.parametrize("solver", SOLVERS, ids=repr)


def _residuals(solver, tableau=None, order=None):
    """Those of the conditions for the claims of the solver."""
    tableau = solver.tableau if tableau is None else tableau
    order = min(solver.record.order("weak", True), 2) if order is None else order
    found = [*ds.weak_order_residuals(tableau, order).values()]
    if solver.record.strong is not None:
        found += ds.strong_order_residuals(tableau).values()
    found.append(np.max(np.abs(ds.symplectic_residuals(tableau))))
    return np.abs(found)


@each_solver
def test_conditions_hold_and_see_every_live_coefficient(solver):
    assert np.max(_residuals(solver)) <= 1e-14
    plan = make_plan(solver.tableau.flatten())
    for name, value in vars(solver.tableau).items():
        if name in ("noise", "constant"):
            continue
        for path, array in jax.tree_util.tree_leaves_with_path(value):
            for index in np.ndindex(array.shape):
                if array[index] == 0 and solver.structure in ("constant", "additive"):
                    # Some of these enter conditions by their squares alone.
                    continue
                moved = array.copy()
                moved[index] += 1e-6
                changed = moved if path == () else value | {path[0].key: moved}
                tableau = dataclasses.replace(solver.tableau, **{name: changed})
                # The coefficients of a stage that nothing reads are free.
                other = make_plan(tableau.flatten()).tableau
                dead = other.stages == plan.tableau.stages and all(
                    np.array_equal(getattr(other, x), getattr(plan.tableau, x))
                    for x in ("matrix", "weights")
                )
                assert dead or np.max(_residuals(solver, tableau)) >= 1e-9, name


def test_weak_order_two_has_17_conditions_which_other_tableaus_do_not_meet():
    assert len(ds.weak_order_residuals(ds.SRKw2().tableau, 2)) == 17
    for solver in SOLVERS:
        if solver.record.order("weak", True) == 1:
            assert np.max(_residuals(solver, order=2)) > 1e-2
    # Those of `PlateauGauss` are met by its brackets.
    tableau = dataclasses.replace(ds.PlateauGauss().tableau, noise=("W",))
    without = ds.weak_order_residuals(tableau, 2)
    assert sum(abs(r) > 0.05 for r in without.values()) == 5


def test_every_member_of_srkw2_satisfies_all_conditions():
    for rows in itertools.permutations((1, 2, 3, 4)):
        for conjugate in (False, True):
            tableau = srkw2_tableau(rows, conjugate)
            residuals = [*ds.weak_order_residuals(tableau, 2).values()]
            residuals.append(np.max(np.abs(ds.symplectic_residuals(tableau))))
            assert np.max(np.abs(residuals)) <= 1e-15
    solver, member = ds.SRKw2().tableau.flatten(), srkw2_tableau((1, 4, 2, 3)).flatten()
    assert np.array_equal(solver.matrix, member.matrix)


def test_only_live_distinct_stages_are_solved():
    # The numbers of unknown vectors in each block.
    for solver, numbers in (
        (ds.SRKs1(a=0.25), [1, 1]),
        (ds.SRKw1(b=0.2), [2]),
        (ds.SRKw2(), [5, 1]),
        (PaperSRKw2(), [6]),
        (ds.StrangGauss(), [1, 2, 1]),
        # The noise is read with the force; drift, then kick; kick, then drift.
        (ds.SRKw3("a"), [1]),
        (ds.SRKw3("b"), [1, 0]),
        (ds.SRKw3("c"), [0, 1]),
        (ds.PlateauVerlet(), [0] * 12),
        (ds.SRKs4(), [0, 0, 0, 0, 1, 1]),
    ):
        blocks = make_plan(solver.tableau.flatten()).blocks
        assert [sum(map(len, b.unknown)) for b in blocks] == numbers, solver


def test_parameters_and_tableaus_that_are_none_are_refused():
    for make, name in (
        *((ds.SRKs1, "a"), (ds.SRKw1, "b"), (ds.SRKw4, "a21"), (ds.SRKs3, "a")),
        *((ds.SRKs4, name) for name in ("beta1", "beta2", "b")),
    ):
        for value in (1j, np.nan, np.inf, "x"):
            with pytest.raises(ValueError, match=f"`{name}` must be a finite real num"):
                make(**{name: value})
    for variant in ("g", "A", "", None, 1):
        with pytest.raises(ValueError, match="`variant` must be one of"):
            ds.SRKw3(variant)
    with pytest.raises(ValueError, match="`beta2` must not be 0"):
        ds.SRKs4(beta2=0)
    for sign in (0, 2, True, 0.5, "-"):
        with pytest.raises(ValueError, match="`sign` must be 1 or -1"):
            ds.SRKs4(sign=sign)
    tableau = ds.ImplicitMidpoint().tableau
    for change, message in (
        (dict(A0=np.ones((2, 2))), r"`A0` must have shape \(1, 1\)"),
        (dict(A0=0.5), r"`A0` must have shape \(1, 1\); got shape \(\)"),
        (dict(beta=[np.nan]), "`beta` must be finite"),
        (dict(alpha=[1j]), "`alpha` must be real"),
        (dict(noise="W"), "`noise` must hold the names"),
        (dict(noise=[0]), "`noise` must hold the names"),
        (dict(noise=("W", "bogus")), "names among .*'W'.*; got 'bogus'."),
    ):
        with pytest.raises(ValueError, match=message):
            dataclasses.replace(tableau, **change)
    assert dataclasses.replace(tableau, noise=["W"]).noise == ("W",)


RESIDUALS = [
    ds.strong_order_residuals,
    lambda x: ds.weak_order_residuals(x, 1),
    lambda x: ds.weak_order_residuals(x, 2),
]


def test_general_conditions_are_refused_unless_the_increment_drives_the_noise():
    for noise in (("W", "H"), ("H",), ("A",), ("W", "W"), ("two_point",)):
        tableau = dataclasses.replace(ds.SRKw2().tableau, noise=noise)
        for residuals in RESIDUALS:
            with pytest.raises(ValueError, match=r'variable "W", .*weak_order_defect'):
                residuals(tableau)
    with pytest.raises(ValueError, match="`order` must be 1 or 2"):
        ds.weak_order_residuals(ds.ImplicitMidpoint().tableau, 3)


def test_conditions_are_known_for_known_tableaus_and_variables():
    class Other(ds.AbstractTableau):
        def flatten(self):
            return ds.ImplicitMidpoint().tableau.flatten()

    for residuals in RESIDUALS:
        with pytest.raises(ValueError, match="got `Other`"):
            residuals(Other())

    class Mine(ds.AbstractSymplecticRungeKutta):
        tableau = Other()

    drift = diffrax.ODETerm(lambda t, y, args: -y)
    with pytest.raises(
        ValueError, match="`structure` of the tableau of `Mine` must be one of"
    ):
        Mine().init(drift, 0.0, 1.0, jnp.ones(2), None)
    own = ds.AdditiveTableau([1], {"W": [1]}, [[0.5]], {"W": [[1]], "mine": [[1]]}, [0])
    with pytest.raises(ValueError, match="got a tableau with `mine`"):
        ds.weak_order_residuals(own, 2)
    # Without space-time area there is no strong order 3/2.
    strong = ds.strong_order_residuals(ds.SRKw5().tableau)
    assert abs(strong["beta[H].c1 + 1"]) == 1


def test_strong_order_three_halves_has_no_place_for_further_variables():
    """The variable takes the place of the space-time area in the variances. Strong errors
    of this tableau halve with the step."""
    tableau = ds.AdditiveTableau(
        alpha=[1],
        beta={"W": [1], "H": [0], "sign": [0]},
        A=[[0.5]],
        B={"W": [[0.5]], "H": [[1]], "sign": [[(1 / 6) ** 0.5]]},
        c1=[0.5],
        constant=True,
    )
    # Constant noise does not need the condition on times.
    residuals = ds.strong_order_residuals(tableau)
    assert residuals.pop("beta[H].c1 + 1") == 1
    assert residuals.pop("alpha.B[sign]e") == pytest.approx(6**-0.5)
    assert np.max(np.abs([*residuals.values()])) < 1e-14
    in_time = ds.AdditiveTableau(
        [1], {"W": [1], "sign": [1]}, [[0.5]], {"W": [[0.5]]}, [0.5]
    )
    assert ds.strong_order_residuals(in_time)["beta[sign].c1"] == 0.5


def test_weights_of_the_increment_need_no_condition_with_its_third_power():
    """Its term is odd in `W`, so it has no mean at weak order 2. Other variables are
    functions of `W`: there it counts."""
    d = np.sqrt(3 / 8)
    total = -1.0
    first = (total - 1 / (4 * d)) / 2
    odd = ds.SeparableTableau(
        alpha=[1 / 3] * 3,
        beta=[1.0],
        A0=np.full((3, 3), 1 / 6),
        B0=[[1 / 2 + d], [1 / 2], [1 / 2 - d]],
        A1=[[first, 1 / 2 - total, total - first]],
    )
    third_power = odd.beta["W"] @ odd.A1 @ odd.B0["W"].sum(axis=1) ** 2
    assert abs(third_power) > 0.3
    assert np.max(np.abs([*ds.weak_order_residuals(odd, 2).values()])) < 1e-14

    class Method(ds.AbstractSymplecticRungeKutta, ds.AbstractImplicitStages):
        tableau: ClassVar[ds.SeparableTableau] = odd

    H0 = lambda t, p, q, args: jnp.sqrt(1 + p**2) + p**3 / 5 + jnp.cos(q)
    noise = lambda t, p, q, args: jnp.sin(q) + q**2 / 3
    path = ds.WeakBrownianPath((), jax.random.key(0))
    terms = ds.hamiltonian_terms(H0, noise, path)
    y0 = jnp.array(0.3), jnp.array(0.7)
    defect = lambda h: ds.weak_order_defect(
        terms, Method(), 0, h, y0, fn=lambda t, y, args: y[0] * y[1] ** 2, order=2
    )
    coarse, fine = jax.vmap(defect)(jnp.array([0.01, 0.005]))
    # A step's error of the third order.
    assert np.log2(abs(coarse / fine)) > 2.9
    others = odd.beta | {"sqrt": [1.0]}
    with_sqrt = dataclasses.replace(odd, beta=others)
    assert "beta[sqrt].A1((B0e)^2)" in ds.weak_order_residuals(with_sqrt, 2)
