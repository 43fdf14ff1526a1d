"""A stochastic nonlinear Schroedinger lattice: 1,024 sites, a noise on each.

i d psi_j = -(psi_(j+1) - 2 psi_j + psi_(j-1)) / (2 dx^2) dt - |psi_j|^2 psi_j dt
            + s psi_j o dw_j, on a ring; psi = q + i p.
"""

import time
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np

import diffrax_symplectic as ds

from .._orders import FinePath
from ..stability._page import fill, Page, table


N = 1024
DX = 0.25


# psi = (q + i p) / sqrt(2) is sqrt(2) times smaller than the psi of the equation, so that
# a field v(psi) = sqrt(2) psi has the equation above.


def hopping(psi, dx: float = DX):
    """The linear part of H0."""
    return jnp.sum(jnp.abs(jnp.roll(psi, -1) - psi) ** 2) / (2 * dx**2)


def attraction(t, psi, s):
    """What is left of the energy."""
    return -jnp.sum(jnp.abs(psi) ** 4)


def noise(t, psi, s):
    return s * jnp.abs(psi) ** 2


def make_terms(path, dx: float = DX):
    H0 = lambda t, psi, s: hopping(psi, dx) + attraction(t, psi, s)
    return ds.wave_terms(H0, noise, path)


def make_rest(path):
    """The terms without the linear part."""
    return ds.wave_terms(attraction, noise, path)


def hopping_flow(n: int = N, dx: float = DX):
    """The exact flow of the linear part, by a Fourier transform."""
    energies = (1 - np.cos(2 * np.pi * np.arange(n) / n)) / dx**2

    def flow(time, y, args):
        waves = jnp.fft.fft(ds.from_pair(y))
        return ds.to_pair(jnp.fft.ifft(jnp.exp(-1j * energies * time) * waves))

    return flow


def start(n: int = N, dx: float = DX):
    """A soliton of height 1 in the middle that moves to the right."""
    x = dx * (np.arange(n) - n / 2)
    return ds.to_pair(jnp.asarray(np.exp(0.5j * x) / np.cosh(x) / np.sqrt(2)))


# No dense matrix of 2,048 unknowns, should fixed points not contract.
_MATRIX_FREE = ds.PicardNewton(linear_solver=lx.GMRES(rtol=1e-9, atol=1e-9))
MIDPOINT = ds.ImplicitMidpoint(root_finder=_MATRIX_FREE)


def split(dx: float = DX):
    return ds.LinearFlow(ds.ImplicitMidpoint(), hopping_flow(dx=dx))


class Ends(NamedTuple):
    # psi at t = 1 of each path.
    psi: np.ndarray
    # Of a path, the best of all.
    seconds: float

    def distance(self, other: "Ends") -> float:
        """Root mean square, relative to |psi|."""
        size = lambda x: np.sum(np.abs(x) ** 2, axis=1)
        return np.sqrt(np.mean(size(self.psi - other.psi) / size(other.psi)))


def ends(solver, steps: int, dx: float, s: float, paths: list[FinePath]) -> Ends:
    """Until t = 1 along each of the paths."""

    @jax.jit
    def solve(path):
        terms = make_rest(path)
        if not isinstance(solver, ds.LinearFlow):
            terms = make_terms(path, dx)
        sol = diffrax.diffeqsolve(
            terms, solver, 0.0, 1.0, 1 / steps, start(dx=dx), s, max_steps=steps + 1,
            adjoint=diffrax.ForwardMode(),
        )  # fmt: skip
        assert sol.ys is not None
        return ds.from_pair(sol.ys)[-1]

    compiled = solve.lower(paths[0]).compile()
    psi, seconds = [], np.inf
    for path in paths:
        begin = time.perf_counter()
        psi.append(np.asarray(compiled(path)))
        seconds = min(seconds, time.perf_counter() - begin)
    return Ends(np.array(psi), seconds)


def section(page: Page) -> str:
    s = 0.1
    fine, number = (2**8, 1) if page.quick else (2**13, 2)
    draw = jax.jit(lambda key: FinePath.draw(key, fine, N, 1.0))
    paths = [draw(jr.key(i)) for i in range(number)]
    # Each against the other solver, or where that is too slow against itself.
    cases = (
        (DX, MIDPOINT, (32, 256), (64, 256)),
        (DX / 10, split(DX / 10), (256,), (4096,)),
    )
    print(f"\nSchroedinger lattice: errors at t = 1 along {number} paths")
    rows = []
    for dx, reference, of_split, of_midpoint in cases[: 1 if page.quick else 2]:
        exact = ends(reference, fine, dx, s, paths)
        for name, solver, many in (
            ("LinearFlow(ImplicitMidpoint)", split(dx), of_split),
            ("ImplicitMidpoint", MIDPOINT, of_midpoint),
        ):
            for steps in many[:1] if page.quick else many:
                found = ends(solver, steps, dx, s, paths)
                error = f"{found.distance(exact):.1e}"
                rows.append(
                    (f"{dx:g}", name, f"1/{steps}", error, f"{found.seconds:.3f}")
                )
    shown = table(("$\\Delta$", "solver", "$h$", "error", "seconds"), rows)
    return fill(__file__, table=shown, s=s, n=f"{N:,}", frequency=f"{2 / DX**2:g}")
