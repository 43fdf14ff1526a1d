"""Suggestions of solvers for a system."""

import dataclasses
import functools as ft
import textwrap
from collections.abc import Callable, Collection, Sequence
from typing import cast, get_args

import diffrax
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import PRNGKeyArray, PyTree

from ._arguments import check_state
from ._brownian import (
    drives,
    increment_struct,
    is_random,
    WeakBrownianPath,
)
from ._custom_types import Args, RealScalarLike, Y
from ._solver import (
    AbstractSymplecticSolver,
    BAOAB,
    Damped,
    LANGEVIN,
    Record,
    SOLVERS,
    Want,
)
from ._tableau import Structure
from ._terms import (
    additive_fault,
    brownian_paths,
    check_fit,
    commuting,
    constant_fault,
    constraint_of,
    Fault,
    FRICTION,
    friction_apart,
    is_own,
    number_of_noises,
    path_numbers,
    random_paths,
    separable_fault,
    specified,
    split_terms,
    with_paths,
    without_constraint,
)


# The most that a higher order may cost: with steps of a twentieth, a step of order 2 is
# worth about twenty of order 1.
_MOST_STAGE_VECTORS = 20


@dataclasses.dataclass(frozen=True)
class Suggestion:
    """A solver for a system, as suggested by [`diffrax_symplectic.suggest_solver`][].

    - `solver`: the solver.
    - `weak_order`, `strong_order`: its orders for this system; the strong order of a weak
        method is `None`.
    - `path`: the Brownian path that it needs, as code.
    - `reason`: when to choose it, in a sentence.
    - `terms`: a function of a random key that returns the terms of the system with such
        paths. Paths of given noise, such as a record, are not replaced. A path of a class
        of your own, such as one of random kicks, is kept, with another key.
    """

    solver: AbstractSymplecticSolver
    weak_order: int
    strong_order: float | None
    path: str
    reason: str
    terms: Callable[[PRNGKeyArray], diffrax.AbstractTerm] = dataclasses.field(
        repr=False
    )


@dataclasses.dataclass(frozen=True, repr=False)
class Suggestions(Sequence[Suggestion]):
    """The suggestions of [`diffrax_symplectic.suggest_solver`][], best first. Printed, they
    are a table.

    - `system`: the structure of the system, in a sentence.
    """

    system: str
    suggestions: tuple[Suggestion, ...]

    def __getitem__(self, index):
        return self.suggestions[index]

    def __len__(self) -> int:
        return len(self.suggestions)

    def __str__(self) -> str:
        lines = textwrap.wrap(self.system, 88)
        for number, s in enumerate(self, start=1):
            strong = "" if s.strong_order is None else f", strong {s.strong_order:g}"
            orders = f"weak order {s.weak_order:g}{strong}"
            lines.append(f"{number}. {_code(s.solver):20} {orders}")
            lines.append(f"   path: {s.path}")
            lines += textwrap.wrap(
                s.reason, 88, initial_indent="   ", subsequent_indent="   "
            )
        return "\n".join(lines)

    __repr__ = __str__


def suggest_solver(
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    y0: Y,
    args: Args = None,
    *,
    want: Want,
) -> Suggestions:
    r"""Suggests solvers for a system by the structure of its terms.

    In a heat bath, solvers with exact stationary positions of a harmonic mode come first.
    Then they are sorted by highest order; by whether noise on stiff modes comes out right;
    and by fewest stage vectors to solve for. [Measured errors](advice.md) at equal cost
    support this order.

    Whether $H_0 = V(p) + U(t, q)$ and $H_k = U_k(t, q)$, and whether the noise is additive
    or constant, is determined by tracing, as in the solvers. Whether noises commute is
    tested at random states, which is not a proof. For
    [`diffrax_symplectic.langevin_terms`][] solvers with a step of their own for friction
    come first. Nothing is solved. Stiffness cannot be detected from the terms: if the first
    suggestion is explicit and needs too many steps, use the next implicit one.

    **Arguments:**

    - `terms`: the terms of a Stratonovich system, with any Brownian path or its shape.
    - `t0`, `y0`, `args`: the initial time and state, and `args`, as for
        `diffrax.diffeqsolve`.
    - `want`: `"weak"` for expectations, or `"strong"` for single paths.

    **Returns:** a sequence of [`diffrax_symplectic.Suggestion`][]s.

    **Raises:** a `ValueError` if `want` is neither of the two, if `terms` has no Brownian
    path, or for terms and states that no solver accepts.
    """
    if want not in get_args(Want):
        raise ValueError(f"`want` must be one of {get_args(Want)}; got {want!r}.")
    # Any path serves to inspect the terms.
    terms = specified(terms, WeakBrownianPath)
    constrained = constraint_of(terms) is not None
    given_terms, terms = terms, without_constraint(terms)
    drift, noise = _parts(terms)
    check_state(y0, "suggest_solver")
    t0 = jnp.asarray(t0, jnp.result_type(*jtu.tree_leaves(y0)))
    check_fit(terms, t0, y0, args)
    not_separable = separable_fault(drift, noise, t0, y0, args)
    structures: list[Structure] = [] if not_separable else ["separable"]
    if additive_fault(noise, t0, y0, args) is None:
        structures.append("additive")
        if constant_fault(noise, t0, y0, args) is None:
            structures.append("constant")
    m = number_of_noises(terms)
    # Noise in the forces commutes, whatever the drift is.
    in_forces = separable_fault((), noise, t0, y0, args) is None
    commute = m == 1 or len(structures) > 0 or in_forces
    commute = commute or commuting(noise, t0, y0, args)
    with_friction = takes_friction_apart(terms, t0, y0, args)
    solvers = ranked(want, structures, commute, m, with_friction)
    if len(friction_apart(drift)[1]) == 0:
        # Diffrax's own terms, which only the Langevin splittings take apart.
        solvers = [solver for solver in solvers if not isinstance(solver, Damped)]
    if constrained:
        solvers = [solver for solver in solvers if solver.keeps_constraints]
        if not solvers:
            raise ValueError(
                "Solvers for terms with a `constraint` need H0 = p . M^-1 p / 2 + U(t, q), "
                "noise Hamiltonians H_k = U_k(t, q), and friction only from "
                "`langevin_terms`."
            )
    paths = brownian_paths(noise)
    if len(noise) > 1 or not jtu.all_leaves([increment_struct(paths[0])]):
        # Lévy areas are only sampled between the noises of one array.
        areas = lambda solver: "noise brackets" in map(drives, solver.variables)
        solvers = [solver for solver in solvers if not areas(solver)]
    given = [path for path in paths if not is_random(path) or is_own(path)]
    solvers = [s for s in solvers if all(_holds(path, s) for path in given)]
    numbers = path_numbers(random_paths(terms))
    with_new = lambda make: jtu.Partial(
        ft.partial(with_paths, make, numbers), given_terms
    )
    found = tuple(_suggestion(s, want, terms, commute, with_new) for s in solvers)
    noises = "one noise"
    if m > 1:
        noises = f"{m} noises that {'commute' if commute else 'do not commute'}"
    if with_friction:
        noises = f"friction and {noises}"
    if constrained:
        noises = f"constraints, {noises}"
    system = _system(structures, not_separable, noises, with_friction)
    if any(isinstance(path, diffrax.UnsafeBrownianPath) for path in paths):
        system += (
            " Its `diffrax.UnsafeBrownianPath` rounds times to 32 bits and repeats its "
            "noise late in a run (Diffrax issue 733): use one of the paths below."
        )
    return Suggestions(f"For {want} approximation. {system}", found)


def _system(
    structures: list[Structure], fault: Fault | None, noises: str, with_friction: bool
) -> str:
    """The structure of the system, in a sentence. `fault` is why it is not separable."""
    kind = " and ".join(structures) or f"general ({fault.reason if fault else ''})"
    system = f"The system is {kind}, with {noises}."
    if fault is not None and not with_friction:
        if structures and fault.wrong_way_round:
            system += f" It is not separable: {fault.reason}."
        if fault.friction:
            system += f" {FRICTION}"
    return system


def _holds(
    path: diffrax.AbstractBrownianPath, solver: AbstractSymplecticSolver
) -> bool:
    """Whether a given path has the random variables that the solver needs."""
    area = getattr(path, "levy_area", diffrax.AbstractBrownianIncrement)
    return solver.variables == ("W",) or issubclass(area, solver.minimal_levy_area)


def _parts(terms: diffrax.AbstractTerm) -> tuple[tuple, tuple]:
    advice = (
        "Pass the terms of a Stratonovich system, `hamiltonian_terms(H0, noise, path)` or "
        "`MultiTerm(ODETerm(f), ControlTerm(g, path))`, with a Brownian path"
    )
    if not isinstance(terms, diffrax.AbstractTerm):
        raise ValueError(f"{advice}; got {type(terms).__name__}.")
    drift, noise = split_terms(terms)
    if len(noise) == 0 or any(len(brownian_paths(term)) == 0 for term in noise):
        raise ValueError(
            f"{advice}; got terms without one. (For a system without noise use "
            "`ImplicitMidpoint` or `StormerVerlet`.)"
        )
    return drift, noise


def takes_friction_apart(
    terms: diffrax.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args
) -> bool:
    """Whether these are Langevin terms that `BAOAB` accepts."""
    try:
        BAOAB().check(terms, t0, y0, args)
    except ValueError:
        return False
    return True


def ranked(
    want: Want,
    structures: Collection[Structure],
    commute: bool,
    num_noises: int,
    friction: bool = False,
) -> list[AbstractSymplecticSolver]:
    """The suggested solvers for these structures (`"any"` is implied) and noises, best
    first; and with `friction`, for Langevin terms whose other terms are separable."""
    structures = {"any", *structures}
    if {"separable", "constant"} <= structures:
        structures.add("separable and constant")

    def rank(solver: AbstractSymplecticSolver) -> tuple:
        systems = solver.stage_vectors(num_noises)
        # In a separable system only half of the state is solved for.
        cost = sum(systems) / (2 if solver.structure == "separable" else 1)
        order = _record(solver).order(want, commute)
        assert order is not None
        record = _record(solver)
        # In a heat bath most means are stationary ones, of positions.
        means = friction and want == "weak"
        inexact = means and "qq" not in record.stationary
        too_many = cost > _MOST_STAGE_VECTORS
        wrong = record.heats is False
        return inexact, too_many, -order, wrong, cost, max(systems, default=0)

    noises = ("any", "commuting" if commute else "not commuting")

    def fits(solver: AbstractSymplecticSolver) -> bool:
        record = _record(solver)
        return want in record.suggested and record.noises in noises

    every = [solver() for solver in SOLVERS]
    solvers = [solver for solver in every if solver.structure in structures]
    if friction:
        # Solvers for separable systems need a friction that is treated apart.
        separable = [solver for solver in every if solver.structure == "separable"]
        solvers += [solver() for solver in LANGEVIN]
        solvers += [Damped(solver) for solver in separable]
    return sorted(filter(fits, solvers), key=rank)


def _record(solver: AbstractSymplecticSolver) -> Record:
    assert solver.record is not None
    return solver.record


def _code(solver: AbstractSymplecticSolver, module: str = "") -> str:
    """The code that constructs the solver."""
    damped = isinstance(solver, Damped)
    given = _code(solver.solver, module) if damped else ""  # pyright: ignore
    return f"{module}{type(solver).__name__}({given})"


def _suggestion(
    solver: AbstractSymplecticSolver,
    want: Want,
    terms: diffrax.AbstractTerm,
    commute: bool,
    with_new: Callable,
) -> Suggestion:
    record = _record(solver)
    random = random_paths(terms)
    replaced = [path for path in random if not is_own(path)]
    if replaced:
        shape = _shape_code(increment_struct(replaced[0]))
        code = f'{_code(solver, "ds.")}.path({shape}, key, want="{want}")'
    elif random:
        code = f"the `{type(random[0]).__name__}` of the terms, with another key"
    else:
        code = "the path of the terms, which holds given noise"
    return Suggestion(
        solver=solver,
        weak_order=cast(int, record.order("weak", commute)),
        strong_order=record.order("strong", commute),
        path=code,
        reason=record.reason,
        terms=with_new(ft.partial(solver.path, want=want)),
    )


def _shape_code(shape: PyTree[jax.ShapeDtypeStruct]) -> str:
    if not isinstance(shape, jax.ShapeDtypeStruct):
        return "shape"
    if shape.dtype == jnp.result_type(float):
        return str(shape.shape)
    return f"jax.ShapeDtypeStruct({shape.shape}, jnp.{shape.dtype})"
