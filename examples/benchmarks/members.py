"""The members of families that the order conditions leave free, by their errors:

    python -m examples.benchmarks.members

Weak families by the leading term of the exact local error, strong ones by the
root-mean-square error at t = 1 with h = 1/16, each relative to the paper's member. Prints
a table.
"""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np

import diffrax_symplectic as ds

from .._srkw2 import srkw2_tableau


class Scene(NamedTuple):
    name: str
    d: int
    H0: Callable
    noise: Callable


def _scene(name: str, d: int, H0: Callable, *noise: Callable) -> Scene:
    return Scene(
        name,
        d,
        lambda t, p, q, args: H0(p, q),
        lambda t, p, q, args: args * jnp.stack([H(p, q) for H in noise]),
    )


_kinetic = lambda p: jnp.sum(p**2) / 2
_relativistic = lambda p: jnp.sum(jnp.sqrt(1 + p**2))
_henon_heiles = lambda q: jnp.sum(q**2) / 2 + q[0] ** 2 * q[1] - q[1] ** 3 / 3
_two_wells = lambda q: jnp.sum(q**4) / 4 - jnp.sum(q**2) / 2
_quartic = lambda x: jnp.sum(x**2) / 2 + jnp.sum(x**4) / 10

GENERAL = [
    _scene(
        "quartic Kubo",
        1,
        lambda p, q: _quartic(p) + _quartic(q),
        lambda p, q: _quartic(p) + _quartic(q),
    ),
    _scene(
        "double well",
        1,
        lambda p, q: _kinetic(p) + _two_wells(q),
        lambda p, q: jnp.sum(p * q),
    ),
    _scene(
        "pendulum",
        1,
        lambda p, q: _kinetic(p) - jnp.sum(jnp.cos(q)),
        lambda p, q: jnp.sum(jnp.sin(q) + p),
    ),
    _scene(
        "Hénon-Heiles",
        2,
        lambda p, q: _kinetic(p) + _henon_heiles(q),
        lambda p, q: q[0] * p[1] + jnp.sum(q**2),
    ),
    _scene(
        "moving mass",
        1,
        lambda p, q: jnp.sum(p**2 * (1 + q**2)) / 2 + jnp.sum(q**2) / 2,
        lambda p, q: jnp.sum(p * jnp.sin(q)),
    ),
    _scene(
        "relativistic",
        1,
        lambda p, q: _relativistic(p) + jnp.sum(q**2) / 2,
        lambda p, q: jnp.sum(q * jnp.cos(p)),
    ),
]
SEPARABLE = [
    _scene(
        name,
        d,
        lambda p, q, V=V, U=U: V(p) + U(q),
        lambda p, q: jnp.sum(jnp.sin(q)),
        lambda p, q: jnp.sum(q**2) / 2,
    )
    for name, d, V, U in (
        ("oscillator", 1, _kinetic, lambda q: jnp.sum(q**2) / 2),
        ("double well", 1, _kinetic, _two_wells),
        ("pendulum", 1, _kinetic, lambda q: -4 * jnp.sum(jnp.cos(q))),
        ("Hénon-Heiles", 2, _kinetic, _henon_heiles),
        ("quartic", 1, _quartic, _quartic),
        ("relativistic", 1, _relativistic, lambda q: jnp.sum(q**2) / 2),
    )
]
ADDITIVE = [
    Scene(
        s.name,
        s.d,
        s.H0,
        lambda t, p, q, args: args * jnp.stack([jnp.sum(q), jnp.sum(p)]),
    )
    for s in GENERAL
]


class Member(diffrax.AbstractStratonovichSolver):
    """One step of a flat tableau whose coefficients are arrays, so that all members of a
    family are one program. Every stage is iterated, a fixed number of times."""

    stages: tuple[tuple[str, str], ...] = eqx.field(static=True)
    matrix: jax.Array
    weights: jax.Array
    term_structure = diffrax.AbstractTerm
    interpolation_cls = diffrax.LocalLinearInterpolation

    def order(self, terms):
        return 2

    def init(self, terms, t0, t1, y0, args):
        return None

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        drift, noise = terms.terms
        flat, unravel = jfu.ravel_pytree(y0)
        increment = noise.contr(t0, t1, use_levy=True)
        half = np.arange(flat.size) < flat.size // 2
        written = {"y": half | True, "p": half, "q": ~half}

        def value(stage, y):
            channel, writes = stage
            if channel == "h":
                out = drift.vf_prod(t0, unravel(y), args, t1 - t0)
            else:
                control = getattr(increment, channel)
                out = noise.vf_prod(t0, unravel(y), args, control)
            return jnp.where(written[writes], jfu.ravel_pytree(out)[0], 0)

        def sweep(_, values):
            positions = flat + self.matrix @ values
            return jnp.stack([value(s, y) for s, y in zip(self.stages, positions)])

        zeros = jnp.zeros((len(self.stages), flat.size))
        values = jax.lax.fori_loop(0, 40, sweep, zeros)
        y1 = unravel(flat + self.weights @ values)
        return y1, None, dict(y0=y0, y1=y1), None, diffrax.RESULTS.successful


def stack(tableaus: list[ds.AbstractTableau]) -> Member:
    """The members of a family, along the leading axis of one."""
    flats = [tableau.flatten() for tableau in tableaus]
    stages = flats[0].stages
    # Variables of the paper that cancel have names no increment knows.
    live = [i for i, s in enumerate(stages) if s.channels[0] in ("h", "W", "H")]
    flats = [flat.take(live) for flat in flats]
    return Member(
        tuple((s.channels[0], s.writes) for s in flats[0].stages),
        jnp.stack([jnp.asarray(flat.matrix) for flat in flats]),
        jnp.stack([jnp.asarray(flat.weights) for flat in flats]),
    )


def _starts(d: int):
    p, q = 0.5 * jr.normal(jr.key(0), (2, 8, d)) + 0.5
    return p, q


def weak_constants(
    members: Member, scene: Scene, order: int, strength: float
) -> np.ndarray:
    """Root mean square, over starts and test functions, of local error / h^(order+1)."""
    h = 0.01
    noise = lambda *x: scene.noise(*x)[:1]
    terms = ds.hamiltonian_terms(scene.H0, noise, ds.WeakBrownianPath((1,), jr.key(0)))

    def functions(t, y, args):
        p, q = y
        both = jnp.concatenate([p, q])
        return jnp.concatenate([both, jnp.outer(both, both).reshape(-1)])

    def constant(matrix, weights, y0):
        solver = Member(members.stages, matrix, weights)
        defect = ds.weak_order_defect(
            terms, solver, 0.0, h, y0, strength, fn=functions, order=order
        )
        return jnp.mean(defect**2)

    over_members = jax.vmap(constant, in_axes=(0, 0, None))
    over_starts = jax.vmap(over_members, in_axes=(None, None, 0))
    squares = jax.jit(over_starts)(members.matrix, members.weights, _starts(scene.d))
    return np.sqrt(np.mean(squares, axis=0)) / h ** (order + 1)


def strong_errors(
    members: Member, scene: Scene, first: Member, m: int, strength: float
) -> np.ndarray:
    """Root mean square error at t = 1 with h = 1/16, of 400 paths with random starts."""
    h, cells = 1 / 16, 2**9
    noise = lambda *x: scene.noise(*x)[:m]

    def squares(key):
        k_path, k_start = jr.split(key)
        levy = diffrax.SpaceTimeLevyArea
        path = diffrax.VirtualBrownianTree(0.0, 1.0, 1 / cells, (m,), k_path, levy)
        terms = ds.hamiltonian_terms(scene.H0, noise, path)
        y0 = tuple(0.5 * jr.normal(k_start, (2, scene.d)) + 0.5)
        solve = lambda solver, h: jfu.ravel_pytree(
            diffrax.diffeqsolve(
                terms, solver, 0.0, 1.0, h, y0, strength, adjoint=diffrax.ForwardMode()
            ).ys
        )[0]
        exact = solve(first, 1 / cells)
        end = lambda matrix, weights: solve(Member(members.stages, matrix, weights), h)
        ends = jax.vmap(end)(members.matrix, members.weights)
        return jnp.sum((ends - exact) ** 2, axis=-1)

    all_squares = jax.jit(jax.vmap(squares))(jr.split(jr.key(0), 400))
    return np.sqrt(np.mean(all_squares, axis=0))


# Of the noise. (Strong ones: with Gaussian increments, stages have to stay solvable.)
WEAK, STRONG = (1.0, 0.3), (0.3, 0.1)


def rows(title, names, scenes, errors: Callable, strengths: tuple[float, float]):
    """Errors relative to the first member; it, the default and the best one."""
    relative = []
    for strength in strengths:
        absolute = [errors(scene, strength) for scene in scenes]
        relative.append(np.stack([e / e[0] for e in absolute], axis=1))
    means = [np.exp(np.mean(np.log(r), axis=1)) for r in relative]
    lines = []
    order = np.argsort(sum(map(np.log, means)), kind="stable").tolist()
    for place, i in enumerate(order):
        if place == 0 or i == 0 or "default" in names[i]:
            cells = [f"{mean[i]:.2f}" for mean in means]
            lines.append(_row([title, names[i], *cells]))
    print("\n".join(lines), flush=True)
    return lines


def _row(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _grid(family: Callable, parameter: str, first: float, others: list[float]):
    values = [first, *(x for x in others if x != first)]
    default = getattr(family(), parameter)
    names = [f"{parameter} = {x:.4g}" + " (default)" * (x == default) for x in values]
    return names, stack([family(x).tableau for x in values])


def orderings() -> tuple[list[str], Member]:
    cases = [
        (rows, conjugate)
        for conjugate in (False, True)
        for rows in itertools.permutations((1, 2, 3, 4))
    ]
    names = ["".join(map(str, r)) + (" conjugate" if c else "") for r, c in cases]
    names[names.index("1423")] += " (default)"
    names[0] += " (paper)"
    return names, stack([srkw2_tableau(r, c) for r, c in cases])


def signs() -> tuple[list[str], Member]:
    names = ["sign = 1 (paper)", "sign = -1 (default)"]
    return names, stack([ds.SRKs4(sign=s).tableau for s in (1, -1)])


def main() -> None:
    eighths = [k / 8 for k in range(9)]
    gauss = [1 / 4 - np.sqrt(3) / 6, 1 / 4 + np.sqrt(3) / 6]
    weak = (
        ("SRKw2", GENERAL, 2, orderings()),
        ("SRKw1", GENERAL, 1, _grid(ds.SRKw1, "b", 0.5, eighths)),
        ("SRKw4", SEPARABLE, 2, _grid(ds.SRKw4, "a21", 0.5, [*eighths, *gauss])),
    )
    halves = [k / 16 for k in range(9)]
    strong = (
        ("SRKs1", GENERAL, 1, _grid(ds.SRKs1, "a", 0.25, halves)),
        ("SRKs3", SEPARABLE, 2, _grid(ds.SRKs3, "a", 0.25, halves)),
        ("SRKs4", ADDITIVE, 2, signs()),
    )
    lines = [
        "Errors of the best member, the default and the paper's, relative to the row with "
        "1.00: geometric means over six problems, with stronger and weaker noise "
        f"({WEAK[0]} and {WEAK[1]} for SRKw, {STRONG[0]} and {STRONG[1]} for SRKs).",
        "",
        _row(["family", "member", "stronger", "weaker"]),
        "|---|---|---|---|",
    ]
    for title, scenes, order, (names, members) in weak:
        errors = lambda s, x, m=members, o=order: weak_constants(m, s, o, x)
        lines += rows(title, names, scenes, errors, WEAK)
    for title, scenes, noises, (names, members) in strong:
        first = jtu.tree_map(lambda x: x[0], members)
        errors = lambda s, x, m=members, f=first, n=noises: strong_errors(m, s, f, n, x)
        lines += rows(title, names, scenes, errors, STRONG)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
