"""Comparisons of solvers: their errors are what they are, and their solvers are named."""

import sys
from types import SimpleNamespace

import diffrax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._compare import _strong_errors, _weak_error


Y0 = (jnp.array(0.0), jnp.array(1.0))


def _terms():
    """The linear oscillator: additive and separable, with E(q^2) known at t = 1."""
    H0 = lambda t, p, q, args: (p**2 + q**2) / 2
    path = ds.WeakBrownianPath((), jr.key(0))
    return ds.hamiltonian_terms(H0, lambda t, p, q, args: -q, path)


def test_strong_errors_are_of_the_orders_of_the_solvers():
    solvers = [ds.SRKs4(), ds.StormerVerlet(), ds.SRKw5()]
    result = ds.compare_solvers(
        _terms(), solvers, 0.0, 1.0, [0.25, 0.125], Y0, key=jr.key(0), num_paths=400,
    )  # fmt: skip
    order = {}
    for name in {s.solver for s in result.steps}:
        coarse, fine = [s.error for s in result.steps if s.solver == name]
        order[name] = np.log2(coarse / fine)
    names = [repr(solver) for solver in solvers]
    # On a linear system SRKs4 has order 2. Five standard errors of the ratio are 0.25.
    assert order[names[0]] == pytest.approx(2, abs=0.25)
    assert order[names[1]] == pytest.approx(1, abs=0.25)
    # One that needs weak random variables is named; the others were compared.
    assert list(result.refused) == [names[2]]
    assert set(order) == set(names[:2])
    assert names[0] in str(result) and "second" in str(result)
    assert all(s.seconds > 0 and s.num_failed == 0 for s in result.steps)
    pytest.importorskip("matplotlib").use("Agg")
    assert len(result.plot().get_legend().get_texts()) == 2


def test_strong_errors_are_means_over_the_paths_that_both_solvers_finish():
    def end(solver, make_path, key, dt):
        W, R = make_path((), key).evaluate(0.0, 1.0), diffrax.RESULTS
        lost = W < -1 if solver == "reference" else W > 1
        result = R.where(lost, R.internal_error, R.successful)
        return jnp.where(solver == "reference", 0.0, jnp.where(W > 0, 3.0, 1.0)), result

    n = 4000
    ((error, bar, failed),) = _strong_errors(
        end, dict(a="a"), "reference", [0.5], 0.5, jr.key(0), n
    )["a"]
    # A normal variable beyond one: five standard errors.
    assert abs(failed / n - 0.3173) <= 5 * np.sqrt(0.3173 * 0.6827 / n)
    # Squares are 9 with a probability that the mean tells, and 1 otherwise.
    often = (error**2 - 1) / 8
    number = often * (n - failed)
    assert abs(number - round(number)) <= 1e-6
    assert abs(often - 0.5) <= 5 * np.sqrt(0.25 / (n - failed))
    deviation = 8 * np.sqrt(often * (1 - often) / (n - failed))
    assert bar == pytest.approx(deviation / (2 * error))


def test_weak_errors_have_the_bars_of_both_means():
    one = SimpleNamespace(mean=np.array(3.0), std_error=np.array(0.3), num_failed=7)
    other = SimpleNamespace(mean=np.array(5.0), std_error=np.array(0.4), num_failed=9)
    assert _weak_error(one, other) == pytest.approx((2.0, 0.5, 7))  # pyright: ignore


def test_weak_error_is_within_its_bars(monkeypatch):
    result = ds.compare_solvers(
        _terms(), [ds.SRKw1()], 0.0, 1.0, [0.5], Y0, key=jr.key(1),
        phi=lambda t, y, args: t * y[1] ** 2, num_paths=4000,
    )  # fmt: skip
    (step,) = result.steps
    # The exact error of the midpoint rule at h = 1/2, by its matrix.
    h = 0.5
    K = np.array([[1, h / 2], [-h / 2, 1]])
    step_map = np.linalg.solve(K, K.T)
    forced = np.linalg.solve(K, np.array([1.0, 0.0]))
    second = np.diag([0.0, 1.0])
    for _ in range(2):
        second = step_map @ second @ step_map.T + h * np.outer(forced, forced)
    exact = abs(second[1, 1] - (np.cos(1) ** 2 + 1 / 2 - np.sin(2) / 4))
    assert abs(step.error - exact) < 5 * step.std_error
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"diffrax_symplectic\[examples\]"):
        result.plot()


@pytest.mark.parametrize("dts", [[0.3], [0.5, 1 / 3], [], [0.0], [-0.5]])
def test_steps_that_do_not_divide_the_interval_are_refused(dts):
    with pytest.raises(ValueError, match="`dt0`"):
        ds.compare_solvers(_terms(), None, 0.0, 1.0, dts, Y0, key=jr.key(0))


@pytest.mark.parametrize(
    "message, kwargs",
    [
        ("`dt0` must be a list of step sizes; got 0.5", dict(dt0=0.5)),
        ("`t1` must be after `t0`", dict(t1=-1.0)),
        ("with a Brownian path; got str", dict(terms="terms")),
        ("`solvers` must be a list of solvers", dict(solvers=ds.ImplicitMidpoint())),
        (r"a solver, as `ImplicitMidpoint\(\)`", dict(solvers=[ds.ImplicitMidpoint])),
        ("`reference` must be a solver", dict(reference="ImplicitMidpoint")),
        (
            r"called as `phi\(t, y, args\)`; got .* `\(y\)`",
            dict(phi=lambda y: y),
        ),
        ("`phi` must return one number", dict(phi=lambda t, y, args: y)),
    ],
)
def test_bad_input_is_told_what_to_pass(message, kwargs):
    given = dict(terms=_terms(), solvers=None, t1=1.0, dt0=[0.5], key=jr.key(0))
    with pytest.raises(ValueError, match=message):
        ds.compare_solvers(y0=Y0, t0=0.0, **(given | kwargs))
