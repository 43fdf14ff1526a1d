"""A fused kernel takes the same paths as JAX, whatever solver and path it is. (Those of JAX
are those of `diffeqsolve` by `test_ensemble`.)"""

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..drjit_here import needs_drjit
from ..families import slow_except
from ..picard import by_picard
from ..problems import SYSTEMS
from ..solver.test_every_solver import CORE, each, marked, STEPS, terms_for


pytestmark = needs_drjit
# Of GPUs, products of matrices in single precision are less precise by default.
exact = lambda: jax.default_matmul_precision("highest")

N, STEPS_TAKEN, H, TIMES = 12, 8, 1 / 16, [0.25, 0.5]
# Of one step they differ by a few roundings, and eight steps of these systems, which are
# stiff by nothing, carry them on: so many units in the last place of the largest number.
ULPS = 64


def follow(terms, solver, y0, args, engine="drjit", **kwargs) -> ds.Ensemble:
    kwargs = dict(key=jr.key(5), num_paths=N, ts=TIMES) | kwargs
    t1 = STEPS_TAKEN * H
    return ds.ensemble(terms, solver, 0.0, t1, H, y0, args, engine=engine, **kwargs)


def assert_same(ys, others, dtype):
    one = lambda ys, i: jfu.ravel_pytree(jax.tree.map(lambda x: x[i], ys))[0]
    flat = lambda ys: np.stack([one(ys, i) for i in range(N)])
    a, b = flat(ys), flat(others)
    assert a.dtype == b.dtype == dtype
    assert np.all(np.isfinite(b))
    size = np.max(np.abs(b), axis=1, keepdims=True)
    assert np.max(np.abs(a - b) / size) <= ULPS * np.finfo(dtype).eps


def assert_same_paths(terms, solver, y0, args, dtype, reference=None):
    with exact():
        paths = follow(terms, solver, y0, args)
        others = follow(terms, reference or solver, y0, args, engine="jax")
    assert paths.num_failed == others.num_failed == 0
    # Otherwise those of JAX would be looked at.
    assert paths.num_stragglers == 0
    assert_same(paths.ys, others.ys, dtype)


def quick(solver, dtype=jnp.float64):
    """The same solver, with a root finder that is compiled sooner; on other devices it
    does not come to rounding error."""
    atol = 1e-15 if dtype == jnp.float64 else 1e-6
    return by_picard(solver, atol) if jax.default_backend() == "cpu" else solver


def problem(structure: str, dtype, m: int = 2):
    return SYSTEMS[structure].draw(jr.key(3), 2, m, dtype)


# Without equations, and with friction; those below solve equations.
QUICK = CORE[2], "BAOAB()"


@each(marked(STEPS, QUICK))
def test_of_every_solver(solver):
    _assert_of_solver(solver, jnp.float64)


@each(marked([ds.ImplicitMidpoint(), ds.StormerVerlet()], CORE[2:3]))
def test_of_solvers_in_single_precision(solver):
    _assert_of_solver(solver, jnp.float32)


def _assert_of_solver(solver, dtype):
    y0, args = problem(solver.structure, dtype)
    path = solver.path(jax.ShapeDtypeStruct((2,), dtype), jr.key(0))
    terms = terms_for(solver, path)
    reference = solver if repr(solver) in CORE else quick(solver, dtype)
    assert_same_paths(terms, solver, y0, args, dtype, reference)


PATHS = {
    "weak": lambda key: ds.WeakBrownianPath((2,), key),
    "weak, order 3": lambda key: ds.WeakBrownianPath(
        (2,), key, order=3, two_point=True
    ),
    "Gaussian": lambda key: ds.FixedStepBrownianPath((2,), key),
    "Gaussian of cells": lambda key: ds.FixedStepBrownianPath((2,), key, cell=H / 4),
    "truncated": lambda key: ds.TruncatedBrownianPath(
        ds.FixedStepBrownianPath((2,), key)
    ),
    "tree": lambda key: diffrax.VirtualBrownianTree(0.0, 1.0, H / 2, (2,), key),
    "truncated tree": lambda key: ds.TruncatedBrownianPath(
        diffrax.VirtualBrownianTree(0.0, 1.0, H / 2, (2,), key)
    ),
    "unsafe": lambda key: diffrax.UnsafeBrownianPath((2,), key),
    "old key": lambda key: ds.FixedStepBrownianPath((2,), jr.key_data(key)),
}


@pytest.mark.parametrize("name", slow_except(["Gaussian of cells"], PATHS))
def test_of_every_brownian_path(name):
    y0, args = problem("any", jnp.float64)
    terms = SYSTEMS["any"].terms(PATHS[name](jr.key(0)))
    solver = ds.ImplicitMidpoint()
    assert_same_paths(terms, solver, y0, args, jnp.float64, quick(solver))


AREAS = ds.LevyAreaMidpoint(), diffrax.SlowRK()


@pytest.mark.parametrize("cell", slow_except([None], [None, H / 2]))
@pytest.mark.parametrize("solver", slow_except(AREAS[:1], AREAS), ids=repr)
def test_of_paths_with_areas(solver, cell):
    gaussian = lambda cell: ds.FixedStepBrownianPath(
        (2,), jr.key(0), diffrax.SpaceTimeLevyArea, cell=cell
    )
    path, reference = gaussian(cell), solver
    if isinstance(solver, ds.LevyAreaMidpoint):
        path = ds.LevyAreaBrownianPath(gaussian(None), jr.key(0), cell=cell)
        reference = quick(solver)
    y0, args = problem("any", jnp.float64)
    terms = SYSTEMS["any"].terms(path)
    assert_same_paths(terms, solver, y0, args, jnp.float64, reference)


OF_DIFFRAX = diffrax.Heun(), diffrax.EulerHeun()


@pytest.mark.parametrize("solver", slow_except(OF_DIFFRAX[:1], OF_DIFFRAX), ids=repr)
def test_of_solvers_of_diffrax(solver):
    y0, args = problem("any", jnp.float64)
    path = ds.FixedStepBrownianPath((2,), jr.key(0))
    assert_same_paths(SYSTEMS["any"].terms(path), solver, y0, args, jnp.float64)
