"""Two bodies with a fluctuating constant of gravity.

H0 = |p|^2 / 2 - 1 / |q| and H1 = -s / |q| in the plane, at eccentricity 0.6. Forces are
central, so that every path keeps its angular momentum. Energy does not stay: on average it
grows by (s^2 / 2) E |q|^-4 in each unit of time.
"""

from typing import NamedTuple

import diffrax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from .._pictures import colour, line, WIDTH
from ..stability._page import fill, Page, table
from ._ensemble import ensemble, gaussian, Mean, plateaus, truncated


ECCENTRICITY = 0.6
PERIOD = 2 * np.pi


def _potential(q):
    return -1 / jnp.sqrt(jnp.sum(q**2))


def make_terms(path):
    return ds.hamiltonian_terms(
        lambda t, p, q, s: jnp.sum(p**2) / 2 + _potential(q),
        lambda t, p, q, s: s * _potential(q),
        path,
    )


def start():
    """At the pericentre."""
    speed = np.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY))
    return jnp.array([0.0, speed]), jnp.array([1 - ECCENTRICITY, 0.0])


def midpoint_solvable(p, q, h, x=0.0):
    """Whether a midpoint step of size h with x = s I has a solution: for the length r of a
    midpoint, r + h (h + x) / (4 r^2) = |q + h p / 2|, where the left has a minimum."""
    c = jnp.sqrt(jnp.sum((q + h * p / 2) ** 2))
    return c >= 1.5 * jnp.cbrt(jnp.maximum(h * (h + x), 0) / 2)


class Orbits(NamedTuple):
    """Of the paths that did not fail, in each row one; saved after each step."""

    failed_share: float
    momentum: np.ndarray
    energy: np.ndarray
    # |q|^-4
    heat: np.ndarray
    position: np.ndarray

    @property
    def momentum_error(self) -> float:
        """The largest relative one."""
        return float(np.max(np.abs(self.momentum / self.momentum[:, :1] - 1)))

    def balance(self, h: float, s: float) -> Mean:
        """The energy gained, less what it has to be on average."""
        gained = self.energy[:, -1] - self.energy[:, 0]
        middle = (self.heat[:, 1:] + self.heat[:, :-1]) / 2
        return Mean.of(gained - s**2 / 2 * h * np.sum(middle, axis=1))


def _look(t, y, args):
    p, q = y
    squared = jnp.sum(q**2)
    energy = jnp.sum(p**2) / 2 + _potential(q)
    return q[0] * p[1] - q[1] * p[0], energy, 1 / squared**2, q


def orbits(
    solver, make_path, per_orbit: int, count: int, s: float, paths: int, seed: int = 0
) -> Orbits:
    saveat = diffrax.SaveAt(t0=True, steps=1, fn=_look)
    steps = per_orbit * count
    _, looks, failed = ensemble(
        make_terms, make_path, solver, start(), PERIOD / per_orbit, steps, paths,
        args=s, saveat=saveat, seed=seed,
    )  # fmt: skip
    momentum, energy, heat, q = (x[~failed, : steps + 1] for x in looks)
    return Orbits(float(np.mean(failed)), momentum, energy, heat, q)


SOLVERS = {
    "ImplicitMidpoint": (ds.ImplicitMidpoint(), truncated()),
    "SRKs3(a=1/4)": (ds.SRKs3(a=0.25), truncated()),
    "PlateauVerlet": (ds.PlateauVerlet(), plateaus()),
    "Heun": (diffrax.Heun(), gaussian()),
}


def section(page: Page) -> str:
    s, count, paths = (0.01, 5, 32) if page.quick else (0.01, 100, 64)
    sizes = 400, 25
    names = ["ImplicitMidpoint", "Heun"] if page.quick else SOLVERS
    print(f"\nTwo-body problem, {count} orbits, s = {s}, {paths} paths")
    rows = []
    figure, axes = plt.subplots(2, 1, figsize=(WIDTH, 7.5))
    for name in names:
        solver, make_path = SOLVERS[name]
        for per_orbit in sizes:
            # Every step is saved.
            few = max(paths * sizes[-1] // per_orbit, 16)
            r = orbits(solver, make_path, per_orbit, count, s, few)
            if per_orbit == sizes[0]:
                error = np.max(np.abs(r.momentum / r.momentum[:, :1] - 1), axis=0)
                ts = np.arange(len(error)) / per_orbit
                axes[1].loglog(ts[1:], error[1:] + 1e-17, label=name, **line(name))
                if name == "ImplicitMidpoint":
                    axes[0].plot(*r.position[0].T, color=colour(name), lw=0.3)
                    axes[0].plot(0, 0, "k+", ms=8)
                continue
            if r.failed_share == 1:
                rows.append((name, "fails", "fails"))
                continue
            assert r.failed_share == 0
            balance = r.balance(PERIOD / per_orbit, s)
            rows.append((name, f"{r.momentum_error:.1e}", str(balance)))
    axes[0].set(aspect="equal", xlabel="$q_1$", ylabel="$q_2$")
    axes[0].set_title("one path, ImplicitMidpoint")
    axes[1].set(xlabel="orbits", ylabel="error of the angular momentum")
    axes[1].set_title(f"{sizes[0]} steps per orbit")
    axes[1].legend(loc="upper left", bbox_to_anchor=(0, 0.75))
    picture = page.picture(figure, "two_body", "Two-body problem")
    shown = table(("solver", "angular momentum", "mean energy"), rows)
    return fill(
        __file__, table=shown, picture=picture, count=count, s=s, part=f"1/{sizes[-1]}"
    )
