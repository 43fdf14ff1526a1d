"""A free chain of four rods between five equal masses at a temperature.

The rods are a constraint, |q_(j+1) - q_j|^2 = 1, or stiff springs. Both are solved in
Cartesian coordinates. The law of the angles between neighbours is known exactly. That of
rods is not that of springs, however stiff they are, since the volume of the momenta that
rods allow depends on the angles.
"""

import itertools
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds

from .._pictures import BLUE, VERMILION
from ..benchmarks._timing import ensemble as many, keys, measure
from ..stability._page import fill, Page, table
from ._ensemble import ensemble, gaussian, Mean


RODS = 4
T = 1.0
# The frequencies of springs go up to twice the root of this.
STIFFNESS = 1_000.0
SHAPE = (RODS + 1, 3)


def bonds(q):
    return jnp.diff(q, axis=0)


def rigid(path):
    return ds.langevin_terms(
        lambda t, p, q, args: jnp.sum(p**2) / 2,
        1.0,
        T,
        path,
        constraint=lambda q, args: jnp.sum(bonds(q) ** 2, axis=1) - 1,
    )


def springs(path):
    def H0(t, p, q, args):
        lengths = jnp.sqrt(jnp.sum(bonds(q) ** 2, axis=1))
        return jnp.sum(p**2) / 2 + STIFFNESS * jnp.sum((lengths - 1) ** 2) / 2

    return ds.langevin_terms(H0, 1.0, T, path)


def start():
    """At rest, with a right angle at each inner mass."""
    steps = [jnp.eye(3)[j % 2] for j in range(RODS)]
    q = jnp.cumsum(jnp.stack([jnp.zeros(3), *steps]), axis=0)
    return jnp.zeros(SHAPE), q


def cosines(q):
    """Of the angles between neighbours."""
    steps = bonds(q)
    steps = steps / jnp.sqrt(jnp.sum(steps**2, axis=1, keepdims=True))
    return jnp.sum(steps[1:] * steps[:-1], axis=1)


def weight(c):
    """The density of the cosines of all angles, up to a factor: the root of the determinant
    of the matrix with 2 on the diagonal and -c beside it, from minor to minor."""
    minors = [1.0, 2.0]
    for cosine in c:
        minors.append(2 * minors[-1] - cosine**2 * minors[-2])
    return np.sqrt(minors[-1])


def exact_square(nodes: int = 20) -> float:
    """The mean square of a cosine, over all angles."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    total = 0.0
    squares = 0.0
    for places in itertools.product(range(nodes), repeat=RODS - 1):
        c = x[[*places]]
        density = np.prod(w[[*places]]) * weight(c)
        total += density
        squares += density * np.mean(c**2)
    return squares / total


def density_of_one(c: np.ndarray, nodes: int = 20) -> np.ndarray:
    """The density of the cosine of the first angle, at each of these."""
    x, w = np.polynomial.legendre.leggauss(nodes)

    def at(first) -> float:
        others = itertools.product(range(nodes), repeat=RODS - 2)
        return sum(
            np.prod(w[[*places]]) * weight([first, *x[[*places]]]) for places in others
        )

    whole = sum(each * at(first) for first, each in zip(x, w))
    return np.array([at(first) for first in c]) / whole


class Angles(NamedTuple):
    # The mean square of a cosine.
    square: Mean
    # Cosines of the outer angles, which have the same law.
    outer: np.ndarray
    # The kinetic energy.
    kinetic: Mean
    # The largest | |bond|^2 - 1 |.
    stretched: float


def angles(make_terms, solver, h: float, t1: float, paths: int) -> Angles:
    _, (p, q), failed = ensemble(
        make_terms, gaussian(SHAPE), solver, start(), h, round(t1 / h), paths
    )
    assert not failed.any()
    p, q = p[:, -1], q[:, -1]
    c = np.asarray(jax.vmap(cosines)(q))
    stretched = np.max(np.abs(np.sum(np.diff(q, axis=1) ** 2, axis=2) - 1))
    return Angles(
        Mean.of(np.mean(c**2, axis=1)),
        c[:, [0, -1]].ravel(),
        Mean.of(np.sum(p**2, axis=(1, 2)) / 2),
        float(stretched),
    )


# Terms, solver, step.
METHODS = {
    "BAOAB, rods": (rigid, ds.BAOAB(), 0.1),
    "BAOAB, springs": (springs, ds.BAOAB(), 0.02),
    "Heun, springs": (springs, diffrax.Heun(), 0.005),
}


# Of the same solver, for two systems.
LOOKS = {"BAOAB, rods": (BLUE, "o"), "BAOAB, springs": (VERMILION, "s")}


def seconds_per_time(name: str, repeats: int) -> float:
    """Of one path, of many at once, in each unit of time."""
    make_terms, solver, h = METHODS[name]
    steps, paths = 100, 1_000
    solve = many(make_terms, gaussian(SHAPE), solver, start(), h, steps)
    return measure(solve, keys(paths), repeats=repeats).seconds / (paths * steps * h)


def show_density(axes, samples: np.ndarray, **look) -> None:
    """With error bars of three standard errors."""
    counts, edges = np.histogram(samples, 12, (-1, 1))
    to_density = 1 / (len(samples) * np.diff(edges))
    middle = (edges[1:] + edges[:-1]) / 2
    error = 3 * np.sqrt(counts) * to_density
    axes.errorbar(middle, counts * to_density, error, ls="none", **look)


def section(page: Page) -> str:
    t1, paths = (2.0, 200) if page.quick else (10.0, 40_000)
    exact = exact_square(8 if page.quick else 20)
    print(f"\nRods at a temperature: angles at t = {t1:g}, {paths:,} paths")
    rows = []
    figure, axes = plt.subplots(figsize=(6, 4))
    for name, (make_terms, solver, h) in METHODS.items():
        r = angles(make_terms, solver, h, t1, paths)
        micro = 1e6 * seconds_per_time(name, 2 if page.quick else 20)
        square = f"{r.square.value:.4f} ± {r.square.std_error:.4f}"
        kinetic = f"{r.kinetic.value:.3f} ± {r.kinetic.std_error:.3f}"
        rows.append(
            (name, f"{h:g}", square, kinetic, f"{r.stretched:.0e}", f"{micro:.0f}")
        )
        # The angles between Heun's springs are those between others.
        if not name.startswith("Heun"):
            colour, marker = LOOKS[name]
            show_density(axes, r.outer, color=colour, marker=marker, label=name)
    c = np.linspace(-1, 1, 41)
    density = density_of_one(c, 6 if page.quick else 20)
    axes.plot(c, density, color=BLUE, label="rods, exact")
    axes.axhline(0.5, color=VERMILION, ls="--", label="springs, exact")
    axes.set(xlabel="cosine of an outer angle", ylabel="density", ylim=(0.43, 0.56))
    figure.legend(loc="outside upper center", ncols=2)
    picture = page.picture(figure, "rods", "Angles between rods and between springs")
    header = (
        "method", "$h$", r"$\langle c^2 \rangle$", "kinetic energy", "stretched",
        "µs per unit of time",
    )  # fmt: skip
    shown = table(header, rows)
    return fill(
        __file__, table=shown, picture=picture, t1=f"{t1:g}", paths=f"{paths:,}",
        exact=f"{exact:.4f}", stiffness=f"{STIFFNESS:g}",
    )  # fmt: skip
