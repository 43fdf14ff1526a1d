"""Comparisons of solvers: their errors are what they are, and their solvers are named."""

import diffrax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._compare import PathResults, strong_error, weak_error


Y0 = (jnp.array(0.0), jnp.array(1.0))


def _terms():
    """The linear oscillator: additive and separable, with E(q^2) known at t = 1."""
    H0 = lambda t, p, q, args: (p**2 + q**2) / 2
    return ds.hamiltonian_terms(H0, lambda t, p, q, args: -q, ())


@pytest.mark.core
def test_strong_errors_are_of_the_order_of_the_solver():
    solvers = [ds.StormerVerlet(), ds.SRKw5()]
    result = ds.compare_solvers(
        _terms(), solvers, 0.0, 1.0, [0.25, 0.125], Y0, key=jr.key(0), num_paths=400,
        reference=ds.PlateauVerlet(),
    )  # fmt: skip
    coarse, fine = result.steps
    # Five standard errors of the ratio are 0.25.
    assert np.log2(coarse.error / fine.error) == pytest.approx(1, abs=0.25)
    assert {s.solver for s in result.steps} == {repr(solvers[0])}
    # One that needs weak random variables is named; the other was compared.
    assert list(result.refused) == [repr(solvers[1])]
    assert repr(solvers[0]) in str(result) and "second" in str(result)
    assert all(s.seconds > 0 and s.num_failed == 0 for s in result.steps)
    pytest.importorskip("matplotlib").use("Agg")
    assert len(result.plot().get_legend().get_texts()) == 1


def test_terms_of_diffrax_may_have_a_shape_in_place_of_a_path_too():
    noise = diffrax.ControlTerm(lambda t, y, args: jnp.ones((1, 2)), (2,))
    terms = diffrax.MultiTerm(diffrax.ODETerm(lambda t, y, args: -y), noise)
    heun = diffrax.Heun()
    (step,) = ds.compare_solvers(
        terms, [heun], 0.0, 1.0, [0.5], jnp.zeros(1), key=jr.key(0), num_paths=8,
        reference=heun, phi=lambda t, y, args: y[0],
    ).steps  # fmt: skip
    assert step.error > 0 and step.num_failed == 0


def test_strong_errors_are_root_mean_squares_over_the_paths_that_both_finish():
    okay = jnp.array([True, True, True, False, True])
    solved = jnp.array([True, True, False, True, True])
    p, q = jnp.array([3.0, 0.0, 7.0, jnp.nan, 1.0]), jnp.zeros((5, 2))
    exact = jnp.zeros(5), jnp.array([[4.0, 0], [0, 0], [0, 0], [0, 0], [0, 2.0]])
    error, bar, failed = strong_error(
        PathResults((p, q), okay), PathResults(exact, solved)
    )
    squares = np.array([25.0, 0.0, 5.0])
    assert error == pytest.approx(np.sqrt(10)) and failed == 2
    assert bar == pytest.approx(np.std(squares) / np.sqrt(3) / (2 * np.sqrt(10)))


def test_weak_errors_have_the_standard_errors_of_both_means():
    okay = jnp.array([True, True, True, False])
    out, fine = jnp.array([1.0, 2.0, 3.0, jnp.nan]), jnp.array([5.0, 6.0, 5.0, 6.0])
    error, bar, failed = weak_error(
        PathResults(out, okay), PathResults(fine, jnp.ones(4, bool))
    )
    assert error == pytest.approx(3.5) and failed == 1
    assert bar == pytest.approx(np.hypot(np.std([1, 2, 3]) / np.sqrt(3), 0.5 / 2))


@pytest.mark.parametrize(
    "dts", [[0.3], [0.5, 1 / 3], [], [0.0], [0.5, 0.0], [-0.5], [np.nan], [0.5, np.nan]]
)
def test_steps_that_do_not_divide_the_interval_are_refused(dts):
    with pytest.raises(ValueError, match="`dt0`"):
        ds.compare_solvers(_terms(), None, 0.0, 1.0, dts, Y0, key=jr.key(0))


@pytest.mark.parametrize(
    "message, kwargs",
    [
        ("`dt0` must be a list of step sizes; got 0.5", dict(dt0=0.5)),
        ("`t1` must be after `t0`", dict(t1=-1.0)),
        ("with a Brownian path; got str", dict(terms="terms")),
        (
            r"a solver, such as `ImplicitMidpoint\(\)`",
            dict(solvers=[ds.ImplicitMidpoint]),
        ),
        ("`reference` must be a solver", dict(reference="ImplicitMidpoint")),
        (r"called as `phi\(t, y, args\)`; got .* `\(y\)`", dict(phi=lambda y: y)),
        ("`phi` must return one number", dict(phi=lambda t, y, args: y)),
    ],
)
def test_bad_input_is_told_what_to_pass(message, kwargs):
    given = dict(terms=_terms(), solvers=None, t1=1.0, dt0=[0.5], key=jr.key(0))
    with pytest.raises(ValueError, match=message):
        ds.compare_solvers(y0=Y0, t0=0.0, **(given | kwargs))
