"""Whether Dr.Jit can compile here."""

import pytest

from diffrax_symplectic._stablehlo.backend import array_types


def _missing() -> str:
    try:
        array_types()
    except ImportError as error:
        return str(error)
    return ""


needs_drjit = pytest.mark.skipif(bool(_missing()), reason=_missing())
