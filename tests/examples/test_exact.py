"""The exact value that the gallery compares rigid bodies with."""

import numpy as np
import pytest

import diffrax_symplectic as ds
from examples import rigid_body
from examples._gallery import weak
from examples._transfer import transfer_expectations
from examples.benchmarks import _exact


@pytest.mark.slow
def test_the_rigid_body_by_spherical_harmonics_is_that_by_steps():
    make_terms = lambda path: rigid_body.make_terms(path, 0.5)
    coarse, fine = transfer_expectations(
        make_terms, weak(), ds.StrangGauss(), rigid_body.X0, lambda X: X[0] ** 2,
        [1 / 16, 1 / 32], (1.0,) * 3, 6, 0.25,
    )  # fmt: skip
    got = _exact.rigid_body_square(0.5, 0.25, degree=30)
    # Without noise it would differ by 1e-3.
    np.testing.assert_allclose(got, fine + (fine - coarse) / 3, atol=2e-7)
