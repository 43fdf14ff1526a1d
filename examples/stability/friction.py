"""A resolved harmonic mode with strong friction: its stationary energies, exactly."""

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np

import diffrax_symplectic as ds
from diffrax_symplectic._solver import LANGEVIN, SOLVERS
from diffrax_symplectic._suggest import FOR_MEANS, FOR_PATHS

from ._models import stationary, with_newton
from ._page import fill, merged, Page, table


# Well resolved, so that friction is all that a step may get wrong.
OMEGA_H = 0.1
# As a rate, times the step; and those of the table.
FRICTIONS = (0.5, 1.0, 2.0, 5.0, 50.0)
SHOWN = (0.5, 2.0, 50.0)
# An energy that is off by more is wrong.
TOLERANCE = 0.1


def _is_suggested_for_drift_with_friction(solver) -> bool:
    # Without brackets of noises `LevyAreaMidpoint` is `ImplicitMidpoint`.
    if solver.structure.startswith("separable") or "A" in solver.variables:
        return False
    return type(solver) in (*FOR_MEANS, *FOR_PATHS)


# All that `suggest_solver` names for Langevin terms.
CASES = {
    **{kind.__name__: kind() for kind in LANGEVIN},
    "BAOAB(ImplicitMidpoint)": ds.BAOAB(ds.ImplicitMidpoint()),
    **{
        kind.__name__: kind()
        for kind in SOLVERS
        if _is_suggested_for_drift_with_friction(kind())
    },
}
QUICK = ("BAOAB", "ImplicitMidpoint", "SRKw5")


def energies(solver, frictions=FRICTIONS) -> np.ndarray:
    """The stationary `<p^2>` and `<q^2>` for each friction at temperature 1, both of which
    should be 1."""
    path = solver.path((), jr.key(0), want="weak")
    zero = (jnp.array(0.0), jnp.array(0.0))

    def H0(t, p, q, args):
        return (p**2 + q**2) / 2

    def moments(gamma_h):
        terms = ds.langevin_terms(H0, gamma_h / OMEGA_H, 1.0, path)
        return ds.second_moment_map(terms, with_newton(solver), 0.0, OMEGA_H, zero)

    maps = np.asarray(jax.jit(jax.vmap(moments))(jnp.asarray(frictions)))
    found = np.array([stationary(K, 1.0) for K in maps])
    # pp and qq among the moments of (1, p, q).
    return found[:, [4, 8]]


def limit(found: np.ndarray) -> float | None:
    """The greatest friction up to which both energies are right, or `None` if they are
    right for all."""
    right = np.all(np.abs(found - 1) <= TOLERANCE, axis=1)
    if np.all(right):
        return None
    return FRICTIONS[int(np.argmin(right)) - 1]


def section(page: Page) -> str:
    rows = []
    print("\nStrong friction: <p^2> / T, omega^2 <q^2> / T")
    for name in QUICK if page.quick else CASES:
        found = energies(CASES[name])
        greatest = limit(found)
        cells = [
            f"{p:.3f}, {q:.3f}"
            for gamma_h, (p, q) in zip(FRICTIONS, found)
            if gamma_h in SHOWN
        ]
        last = "none" if greatest is None else f"{greatest:g}"
        rows.append((f"`{name}`", *cells, last))
    heads = ["solver", *(f"$\\gamma h = {x:g}$" for x in SHOWN), "limit"]
    return fill(
        __file__,
        table=table(heads, merged(rows)),
        omega_h=f"{OMEGA_H:g}",
        percent=f"{100 * TOLERANCE:g}",
    )
