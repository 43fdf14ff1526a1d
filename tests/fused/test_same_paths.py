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

N, H = 12, 1 / 16
# Of one step they differ by a few roundings, and eight steps of these systems, which are
# stiff by nothing, carry them on: so many units in the last place of the largest number.
ULPS = 64


def flat(paths) -> np.ndarray:
    one = lambda i: jfu.ravel_pytree(jax.tree.map(lambda x: x[i], paths.ys))[0]
    return np.stack([one(i) for i in range(N)])


def assert_same_paths(terms, solver, structure="any", dtype=jnp.float64):
    y0, args = SYSTEMS[structure].draw(jr.key(3), 2, 2, dtype)
    # With a root finder that is compiled sooner; on other devices it does not come to
    # rounding error.
    simple = repr(solver) not in CORE and jax.default_backend() == "cpu"
    atol = 1e-15 if dtype == jnp.float64 else 1e-6
    reference = by_picard(solver, atol) if simple else solver
    given = 0.0, 8 * H, H, y0, args
    options = dict(key=jr.key(5), num_paths=N, ts=[4 * H, 8 * H])
    with exact():
        fused = ds.ensemble(terms, solver, *given, **options, engine="drjit")
        plain = ds.ensemble(terms, reference, *given, **options, engine="jax")
    assert fused.num_failed == plain.num_failed == 0
    # Otherwise those of JAX would be looked at.
    assert fused.num_stragglers == 0
    found, expected = flat(fused), flat(plain)
    assert found.dtype == expected.dtype == dtype
    assert np.all(np.isfinite(expected))
    size = np.max(np.abs(expected), axis=1, keepdims=True)
    assert np.max(np.abs(found - expected) / size) <= ULPS * np.finfo(dtype).eps


# One with friction; another in single precision.
@each(marked(STEPS, ["BAOAB()"]))
def test_of_every_solver(solver):
    terms = terms_for(solver, solver.path((2,), jr.key(0)))
    assert_same_paths(terms, solver, solver.structure)


@each(marked([ds.ImplicitMidpoint(), ds.StormerVerlet()], CORE[2:3]))
def test_of_solvers_in_single_precision(solver):
    # Of cells, which are drawn together.
    path = gaussian(
        jr.key(0), shape=jax.ShapeDtypeStruct((2,), jnp.float32), cell=H / 4
    )
    assert_same_paths(terms_for(solver, path), solver, solver.structure, jnp.float32)


def gaussian(key, levy_area=diffrax.BrownianIncrement, shape=(2,), **options):
    return ds.FixedStepBrownianPath(shape, key, levy_area, **options)


def tree(key):
    return diffrax.VirtualBrownianTree(0.0, 1.0, H / 2, (2,), key)


def areas(key, **options):
    path = gaussian(key, diffrax.SpaceTimeLevyArea)
    return ds.LevyAreaBrownianPath(path, key, **options)


VERLET = ds.StormerVerlet()
PATHS = {
    "weak": (VERLET, lambda key: ds.WeakBrownianPath((2,), key)),
    "weak, order 3": (
        VERLET,
        lambda key: ds.WeakBrownianPath((2,), key, order=3, two_point=True),
    ),
    "Gaussian, with a solver of Diffrax": (diffrax.Heun(), gaussian),
    "truncated": (VERLET, lambda key: ds.TruncatedBrownianPath(gaussian(key))),
    "tree": (VERLET, tree),
    "truncated tree": (VERLET, lambda key: ds.TruncatedBrownianPath(tree(key))),
    "unsafe": (VERLET, lambda key: diffrax.UnsafeBrownianPath((2,), key)),
    "old key": (VERLET, lambda key: gaussian(jr.key_data(key))),
    "areas": (ds.LevyAreaMidpoint(), areas),
    "areas of cells": (ds.LevyAreaMidpoint(), lambda key: areas(key, cell=H / 2)),
    "areas in time of cells": (
        diffrax.SlowRK(),
        lambda key: gaussian(key, diffrax.SpaceTimeLevyArea, cell=H / 2),
    ),
}
QUICK = "Gaussian, with a solver of Diffrax", "areas"


@pytest.mark.parametrize("name", slow_except(QUICK, PATHS))
def test_of_every_brownian_path(name):
    solver, path = PATHS[name]
    structure = "any" if isinstance(solver, ds.LevyAreaMidpoint) else "separable"
    terms = SYSTEMS[structure].terms(path(jr.key(0)))
    assert_same_paths(terms, solver, structure)
