"""Coefficients satisfy their conditions, and only live, distinct stages are solved."""

import ast
import dataclasses
import itertools
import pathlib
import re

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._brownian import VARIABLES
from diffrax_symplectic._tableau import Block, make_plan
from diffrax_symplectic._tableau.tableau import NOISE_VARIABLES
from examples._srkw2 import PaperSRKw2, srkw2_tableau


TABLEAUS = {
    "ImplicitMidpoint": ds.ImplicitMidpoint().tableau,
    "SRKw2": ds.SRKw2().tableau,
    "StrangGauss": ds.StrangGauss().tableau,
    **{f"SRKs1({a})": ds.SRKs1(a=a).tableau for a in (-0.3, 0.0, 0.25, 0.4, 0.5)},
    **{f"SRKw1({b})": ds.SRKw1(b=b).tableau for b in (-0.3, 0.0, 0.5, 0.7, 1.0)},
}
all_tableaus = pytest.mark.parametrize(
    "tableau", TABLEAUS.values(), ids=TABLEAUS.keys()
)


@all_tableaus
def test_tableau_is_symplectic(tableau):
    assert np.max(np.abs(ds.symplectic_residuals(tableau))) <= 1e-15


@all_tableaus
def test_tableau_has_weak_order_one(tableau):
    residuals = ds.weak_order_residuals(tableau, 1)
    assert max(map(abs, residuals.values())) <= 1e-15


@pytest.mark.parametrize("name", ["SRKw2", "StrangGauss"])
def test_all_17_conditions_for_weak_order_two_are_satisfied(name):
    residuals = ds.weak_order_residuals(TABLEAUS[name], 2)
    assert len(residuals) == 17
    assert max(map(abs, residuals.values())) <= 1e-15


@pytest.mark.parametrize(
    "name", [n for n in TABLEAUS if n not in ("SRKw2", "StrangGauss")]
)
def test_other_tableaus_do_not_have_weak_order_two(name):
    residuals = ds.weak_order_residuals(TABLEAUS[name], 2)
    assert max(map(abs, residuals.values())) > 1e-2


@pytest.mark.parametrize("a", [0.0, 0.25, 0.5])
def test_strong_tableaus_have_strong_order(a):
    for tableau in (ds.ImplicitMidpoint().tableau, ds.SRKs1(a=a).tableau):
        residuals = ds.strong_order_residuals(tableau)
        assert max(map(abs, residuals.values())) <= 1e-15


@all_tableaus
@pytest.mark.parametrize("field", ["alpha", "beta", "A0", "B0", "A1", "B1"])
def test_every_perturbed_live_coefficient_is_caught(tableau, field):
    coefficients = getattr(tableau, field)
    for index in np.ndindex(coefficients.shape):
        wrong = coefficients.copy()
        wrong[index] += 1e-6
        perturbed = dataclasses.replace(tableau, **{field: wrong})
        residuals = [*ds.weak_order_residuals(perturbed, 1).values()]
        residuals.append(np.max(np.abs(ds.symplectic_residuals(perturbed))))
        # The coefficients of a stage of weight 0 that nothing reads are free.
        weights = dict(A0="alpha", B0="alpha", A1="beta", B1="beta")
        dead = field in weights and getattr(tableau, weights[field])[index[0]] == 0
        caught = np.max(np.abs(residuals)) > 1e-8
        assert caught or dead


def test_every_member_of_srkw2_satisfies_all_conditions():
    for rows in itertools.permutations((1, 2, 3, 4)):
        for conjugate in (False, True):
            tableau = srkw2_tableau(rows, conjugate)
            residuals = [*ds.weak_order_residuals(tableau, 2).values()]
            residuals.append(np.max(np.abs(ds.symplectic_residuals(tableau))))
            assert np.max(np.abs(residuals)) <= 1e-15
    solver, member = ds.SRKw2().tableau.flatten(), srkw2_tableau((1, 4, 2, 3)).flatten()
    assert np.array_equal(solver.matrix, member.matrix)


@pytest.mark.parametrize(
    "solver, blocks",
    [
        (ds.ImplicitMidpoint(), [1]),
        (ds.SRKs1(a=0.0), [1]),
        (ds.SRKs1(a=0.5), [1]),
        (ds.SRKs1(a=0.25), [1, 1]),
        (ds.SRKw1(b=0.5), [1]),
        (ds.SRKw1(b=0.0), [1, 1]),
        (ds.SRKw1(b=1.0), [1, 1]),
        (ds.SRKw1(b=0.2), [2]),
        (ds.SRKw2(), [5, 1]),
        (PaperSRKw2(), [6]),
        (ds.StrangGauss(), [1, 2, 1]),
    ],
)
def test_only_live_distinct_stages_are_solved(solver, blocks):
    plan = make_plan(solver.tableau.flatten())
    assert [sum(map(len, b.unknown)) for b in plan.blocks] == blocks
    assert all(block.explicit == () for block in plan.blocks)


def test_explicit_stages_never_reach_the_root_finder():
    # An explicit trapezoidal rule is not symplectic, but must be recognised.
    A = [[0.0, 0.0], [1.0, 0.0]]
    heun = ds.GeneralTableau.strong(A=A, B=A, alpha=[0.5, 0.5], beta=[0.5, 0.5])
    plan = make_plan(heun.flatten())
    assert plan.blocks == (Block((), ((0,),)), Block((), ((1,),)))
    assert np.max(np.abs(ds.symplectic_residuals(heun))) > 0.1


@pytest.mark.parametrize(
    "change, message",
    [
        (dict(A0=np.ones((2, 2))), r"`A0` must have shape \(1, 1\)"),
        (dict(beta=[np.nan]), "`beta` must be finite"),
        (dict(alpha=[1j]), "`alpha` must be real"),
    ],
)
def test_malformed_tableaus_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(ds.ImplicitMidpoint().tableau, **change)


@pytest.mark.parametrize("value", [1j, np.nan, np.inf, "a", None])
def test_malformed_parameters_are_refused(value):
    with pytest.raises(ValueError, match="`a` must be a finite real number"):
        ds.SRKs1(a=value)
    with pytest.raises(ValueError, match="`b` must be a finite real number"):
        ds.SRKw1(b=value)


def test_weak_order_residuals_know_orders_one_and_two():
    with pytest.raises(ValueError, match="`order` must be 1 or 2"):
        ds.weak_order_residuals(ds.ImplicitMidpoint().tableau, 3)


def test_conditions_are_known_for_known_tableaus_and_variables():
    class Other(ds.AbstractTableau):
        def flatten(self):
            return ds.ImplicitMidpoint().tableau.flatten()

    for residuals in (
        ds.strong_order_residuals,
        lambda x: ds.weak_order_residuals(x, 1),
    ):
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


def test_noise_of_a_tableau_is_a_tuple_of_names():
    one = dict(alpha=[1], beta=[1], A0=[[0.5]], B0=[[0.5]], A1=[[0.5]], B1=[[0.5]])
    assert ds.GeneralTableau(**one, noise=["W"]).noise == ("W",)
    for wrong in ("W", [0]):
        with pytest.raises(ValueError, match="`noise` must hold the names"):
            ds.GeneralTableau(**one, noise=wrong)
    with pytest.raises(ValueError, match="names among 'W', .*; got 'bogus'."):
        ds.GeneralTableau(**one, noise=("W", "bogus"))
    # Tableaus know no JAX, so they have a list of their own.
    assert set(NOISE_VARIABLES) == set(VARIABLES)


@pytest.mark.parametrize(
    "noise", [("W", "H"), ("H",), ("A",), ("W", "W"), ("two_point",)], ids=repr
)
def test_general_conditions_are_refused_unless_the_increment_drives_the_noise(noise):
    tableau = dataclasses.replace(ds.SRKw2().tableau, noise=noise)
    for residuals in (
        ds.strong_order_residuals,
        lambda x: ds.weak_order_residuals(x, 1),
        lambda x: ds.weak_order_residuals(x, 2),
    ):
        with pytest.raises(ValueError, match=r'variable "W", .*weak_order_defect'):
            residuals(tableau)


def test_tableaus_know_nothing_of_jax():
    file = pathlib.Path(ds.__file__).parent / "_tableau" / "tableau.py"
    imported = set()
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            imported |= {alias.name for alias in node.names}
        if isinstance(node, ast.ImportFrom):
            imported.add("." * node.level + (node.module or ""))
    outside = {name for name in imported if not re.match(r"\.[^.]", name)}
    assert {"dataclasses", "numpy"} <= outside
    assert outside <= {
        "abc",
        "collections.abc",
        "dataclasses",
        "jaxtyping",
        "numpy",
        "typing",
    }
