"""Parts of an estimate come from the same arguments: others are refused by their names."""

import dataclasses
import io

import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._simulation import Problem


ZERO = jnp.array(0.0)
ONE = jnp.array(1.0)


def _oscillator(t, p, q, args):
    return p**2 / 2 + args * q**2 / 2


def arguments(
    k=ONE, energy=_oscillator, solver=None, dt0=0.5, t1=1.0, t0=0.0, y0=(ZERO, ONE),
    phi=None, ts=None,
):  # fmt: skip
    terms = ds.hamiltonian_terms(energy, lambda t, p, q, args: -0.1 * q, ())
    phi = phi or (lambda t, y, args: y[1])
    return phi, terms, solver or ds.StormerVerlet(), t0, t1, dt0, y0, k, ts


def part(first=0, start=None, **changes):
    *given, ts = arguments(**changes)
    return ds.expectation(
        *given, ts=ts, key=jr.key(0), sampling=ds.IndependentPaths(4), levels=1,
        first=first, start=start,
    )  # fmt: skip


# From the name of an argument to other ones.
OTHERS = {
    "args": dict(k=9 * ONE),
    "terms": dict(energy=lambda t, p, q, args: p**2 / 2 + args * q**2),
    "solver": dict(solver=ds.ImplicitMidpoint()),
    "dt0": dict(dt0=0.25),
    "t1": dict(t1=2.0),
    "t0": dict(t0=0.5, t1=1.5),
    "y0": dict(y0=(ONE, ONE)),
    "phi": dict(phi=lambda t, y, args: y[0]),
    "ts": dict(ts=[0.5]),
}


@pytest.fixture(scope="module")
def first():
    return part()


@pytest.fixture(scope="module")
def second():
    """The following part. Functions that compute the same are the same."""
    return part(4, energy=lambda t, p, q, args: p**2 / 2 + args * q**2 / 2)


@pytest.mark.parametrize("name", OTHERS)
def test_parts_of_another_problem_are_refused_by_its_argument(name, first, second):
    def with_digests(estimate, **changes):
        problem = Problem.of(*arguments(**changes), 1, key=jr.key(0))
        return dataclasses.replace(estimate, digests=problem.digests)

    # With times the estimate has another shape.
    same = dict(ts=[1.0]) if name == "ts" else {}
    one = with_digests(first, **same)
    assert one.merge(with_digests(second, **same)).num_paths == 8
    with pytest.raises(ValueError, match=f"merge was computed with another `{name}`"):
        one.merge(with_digests(second, **OTHERS[name]))


def test_what_another_problem_computed_is_not_continued(first, second):
    assert first.merge(second).num_paths == 8
    with pytest.raises(ValueError, match="`start` was computed with another `args`"):
        part(k=9 * ONE, start=first)


def test_parts_of_other_levels_are_refused(first, second):
    # Four levels have as many combinations as five.
    four, five = (
        dataclasses.replace(one, levels=levels)
        for one, levels in ((first, 4), (second, 5))
    )
    with pytest.raises(ValueError, match="another structure or other shapes"):
        four.merge(five)


def test_files_keep_what_tells_problems_apart(first, second):
    file = io.BytesIO()
    first.save(file)
    file.seek(0)
    assert ds.Expectation.load(file).digests == first.digests
    # Those of earlier versions do not have it.
    file = io.BytesIO()
    dataclasses.replace(first, digests=None).save(file)
    file.seek(0)
    with pytest.warns(UserWarning, match="without digests of its arguments"):
        old = ds.Expectation.load(file)
    assert old.merge(second).num_paths == 8
