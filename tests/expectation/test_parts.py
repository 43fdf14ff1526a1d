"""Parts of an estimate come from the same arguments: others are refused by their names."""

import dataclasses
import io

import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_symplectic as ds

from ..picard import by_picard


ZERO = jnp.array(0.0)
ONE = jnp.array(1.0)


def part(
    k=ONE,
    energy=None,
    solver=None,
    dt0=0.5,
    t1=1.0,
    t0=0.0,
    y0=(ZERO, ONE),
    phi=None,
    **options,
):
    energy = energy or (lambda t, p, q, args: p**2 / 2 + args * q**2 / 2)
    terms = ds.hamiltonian_terms(energy, lambda t, p, q, args: -0.1 * q, ())
    phi = phi or (lambda t, y, args: y[1])
    solver = solver or ds.StormerVerlet()
    return ds.expectation(
        phi, terms, solver, t0, t1, dt0, y0, k, key=jr.key(0),
        sampling=ds.IndependentPaths(4), levels=1, **options,
    )  # fmt: skip


# From the name of an argument to other ones.
OTHERS = {
    "args": dict(k=9 * ONE),
    "terms": dict(energy=lambda t, p, q, args: p**2 / 2 + args * q**2),
    "solver": dict(solver=by_picard(ds.ImplicitMidpoint())),
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
def first_with_times():
    return part(ts=[1.0])


@pytest.mark.parametrize("name", OTHERS)
def test_parts_of_another_problem_are_refused_by_its_argument(
    name, first, first_with_times
):
    one = first_with_times if name == "ts" else first
    other = part(**OTHERS[name], first=4)
    with pytest.raises(ValueError, match=f"merge was computed with another `{name}`"):
        one.merge(other)


def test_what_another_problem_computed_is_not_continued(first):
    with pytest.raises(ValueError, match="`start` was computed with another `args`"):
        part(k=9 * ONE, start=first)


def test_parts_of_other_levels_are_refused(first):
    # Four levels have as many combinations as five.
    four = dataclasses.replace(first, levels=4)
    five = dataclasses.replace(part(first=4), levels=5)
    with pytest.raises(ValueError, match="another structure or other shapes"):
        four.merge(five)


def test_functions_that_compute_the_same_are_the_same(first):
    again = lambda t, p, q, args: p**2 / 2 + args * q**2 / 2
    assert first.merge(part(energy=again, first=4)).num_paths == 8


def test_files_keep_what_tells_problems_apart(first):
    file = io.BytesIO()
    first.save(file)
    file.seek(0)
    loaded = ds.Expectation.load(file)
    assert loaded.digests == first.digests
    with pytest.raises(ValueError, match="another `args`"):
        loaded.merge(part(k=9 * ONE, first=4))


def test_files_of_earlier_versions_load_with_a_warning(first):
    file = io.BytesIO()
    dataclasses.replace(first, digests=None).save(file)
    file.seek(0)
    with pytest.warns(UserWarning, match="without digests of its arguments"):
        old = ds.Expectation.load(file)
    assert old.merge(part(first=4)).num_paths == 8


def test_functions_of_monte_carlo_are_told_apart():
    average = lambda fn, first: ds.monte_carlo(
        fn, key=jr.key(0), num_paths=4, first=first
    )
    one = average(lambda key: jr.normal(key), 0)
    assert one.merge(average(lambda key: jr.normal(key), 4)).num_paths == 8
    with pytest.raises(ValueError, match="another `fn`"):
        one.merge(average(lambda key: 2 * jr.normal(key), 4))
