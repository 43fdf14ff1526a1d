"""Suggestions of solvers for a system."""

import dataclasses
import functools as ft
import textwrap
from collections.abc import Callable, Collection, Sequence
from typing import cast, get_args, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, PRNGKeyArray, PyTree

from ._arguments import check_state
from ._brownian import (
    drives,
    increment_struct,
    is_random,
    TruncatedBrownianPath,
    WeakBrownianPath,
)
from ._custom_types import Args, RealScalarLike, Terms, Y
from ._solver import (
    AbstractSymplecticSolver,
    AdditiveGauss,
    BAOAB,
    ImplicitMidpoint,
    is_solver,
    LangevinMiddle,
    LevyAreaMidpoint,
    NinomiyaVictoir,
    own_path,
    PlateauGauss,
    PlateauVerlet,
    SRKs2,
    SRKs4,
    SRKw1,
    SRKw4,
    SRKw5,
    StormerVerlet,
    StrangGauss,
    Want,
)
from ._tableau import Structure
from ._terms import (
    additive_fault,
    brownian_paths,
    check_assertions,
    check_baths_have_own_noise,
    check_drifts_differ,
    check_terms_fit_state,
    constant_fault,
    constraint_of,
    Fault,
    FRICTION,
    friction_apart,
    has_unknown_law,
    motion_numbers,
    noises_commute,
    number_of_noises,
    random_paths,
    separable_fault,
    split_terms,
    which_need_truncation,
    with_paths,
    with_paths_for_shapes,
    with_programs,
    with_truncation,
    without_constraint,
)


# The suggested solvers, best first. They are ranked by order, then by whether they give
# stiff modes the right energy, then by the size of the equations of a step.
#
# Solvers for heat baths. For means they come before all others: most means are of functions
# of positions, of which these solvers have the exact stationary law for harmonic modes.
FOR_FRICTION = (BAOAB, LangevinMiddle)
# Solvers for means. `_ranked_for_means` makes exceptions to the order.
FOR_MEANS = (
    AdditiveGauss,
    StormerVerlet,
    SRKw5,
    SRKs4,
    StrangGauss,
    NinomiyaVictoir,
    SRKw4,
    SRKw1,
)
# Solvers for single paths.
FOR_PATHS = (
    PlateauVerlet,
    SRKs4,
    PlateauGauss,
    StormerVerlet,
    *FOR_FRICTION,
    SRKs2,
    LevyAreaMidpoint,
    ImplicitMidpoint,
)
# `NinomiyaVictoir` takes a flow for each noise. At the cost of a hundred steps of the
# midpoint rule, it had 0.1, 0.16, 0.14 and 1.2 times the error of that rule for 2, 3, 4 and
# 6 noises of linear systems with two or three degrees of freedom.
_MOST_FLOWS_OF_NOISE = 4
# The solver for heat baths with any Hamiltonian that is quadratic in the momenta, such as
# one with masses that depend on positions.
_BATH_OF_ANY_ENERGY = BAOAB(ImplicitMidpoint())


@dataclasses.dataclass(frozen=True)
class Suggestion:
    """A solver for a system, as suggested by [`diffrax_symplectic.suggest_solver`][].

    - `solver`: the solver.
    - `weak_order`, `strong_order`: its orders for this system; the strong order of a weak
        method is `None`.
    - `path`: the Brownian path that it needs, as code.
    - `reason`: when to choose it, in a sentence.
    - `terms`: a function of a random key that returns the terms of the system with paths
        that the solver needs. Paths of given noise, such as a record, are not replaced. A
        path of a class of your own, such as one of random kicks, is kept, with another key.
    """

    solver: AbstractSymplecticSolver
    weak_order: int
    strong_order: int | float | None
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
        for number, suggestion in enumerate(self, start=1):
            orders = f"weak order {suggestion.weak_order:g}"
            if suggestion.strong_order is not None:
                orders += f", strong {suggestion.strong_order:g}"
            lines.append(f"{number}. {_code(suggestion.solver):20} {orders}")
            lines.append(f"   path: {suggestion.path}")
            lines += textwrap.wrap(
                suggestion.reason, 88, initial_indent="   ", subsequent_indent="   "
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
    r"""Lists the solvers that suit your terms, best first, with orders, paths and reasons.

    !!! example

        ```python
        import diffrax_symplectic as ds
        import jax.numpy as jnp

        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.1 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ())  # the shape of one noise
        y0 = (jnp.array(0.0), jnp.array(1.0))
        print(ds.suggest_solver(terms, 0.0, y0, want="weak"))
        ```

    The structure is traced, nothing is solved. Stiffness cannot be seen: if the first
    solver is explicit and needs too many steps, take the next implicit one. Whether noises
    commute is tested at random states, which is no proof.

    Solvers are ranked by order, then by whether they give stiff modes the right energy,
    then by the size of the equations of a step. There are exceptions:

    - With friction, solvers with exact stationary positions come first for means.
    - With friction and masses that depend on positions, `BAOAB(ImplicitMidpoint())` comes
        first.
    - With more than four noises, `NinomiyaVictoir` comes last.

    **Arguments:**

    - `terms`: the terms of a Stratonovich system, with any Brownian path or its shape.
    - `t0`, `y0`, `args`: the initial time and state, and `args`, as for
        `diffrax.diffeqsolve`.
    - `want`: `"weak"` for expectations, or `"strong"` for single paths.

    **Returns:** a sequence of [`diffrax_symplectic.Suggestion`][]s.

    **Raises:** a `ValueError` if `want` is neither of the two, if `terms` has no Brownian
    path, if derivatives at `y0` contradict the `structure` of the terms, or for terms and
    states that no solver accepts.
    """
    if want not in get_args(Want):
        raise ValueError(f"`want` must be one of {get_args(Want)}; got {want!r}.")
    # A user may pass the shape of a path in its place. Any path of this shape serves to
    # inspect the terms. They are inspected without their constraint.
    given_terms = with_paths_for_shapes(terms, WeakBrownianPath)
    terms = without_constraint(given_terms)
    _check_noise(terms)
    check_drifts_differ(terms)
    check_state("suggest_solver", y0)
    t0 = jnp.asarray(t0, jnp.result_type(*jtu.tree_leaves(y0)))
    terms = with_programs(terms, t0, y0, args)
    drift, noise = split_terms(terms)
    check_terms_fit_state(terms, t0, y0, args)
    check_baths_have_own_noise(terms)
    check_assertions(terms, t0, y0, args)
    constrained = constraint_of(given_terms) is not None
    system = _inspect(drift, noise, t0, y0, args, constrained)
    paths = brownian_paths(noise)
    motions = motion_numbers(random_paths(terms))
    # For each path, whether implicit steps need its increments bounded.
    needs_bounds = which_need_truncation(terms, t0, y0, args)
    suggestions = []
    for solver in _suitable(system, want, paths, one_term=len(noise) == 1):
        assert solver.record is not None
        is_implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
        terms_for = ft.partial(
            _terms_with_paths,
            make_path=ft.partial(own_path, solver, want),
            motions=motions,
            which_truncated=tuple(is_implicit and needed for needed in needs_bounds),
        )
        suggestion = Suggestion(
            solver=solver,
            weak_order=cast(int, solver.record.order("weak", system.commute)),
            strong_order=solver.record.order("strong", system.commute),
            path=_path_code(solver, want, terms, any(needs_bounds)),
            reason=solver.record.reason,
            terms=jtu.Partial(terms_for, given_terms),
        )
        suggestions.append(suggestion)
    description = f"For {want} approximation. {system.in_a_sentence()}"
    if any(isinstance(path, diffrax.UnsafeBrownianPath) for path in paths):
        description += (
            " Its `diffrax.UnsafeBrownianPath` rounds times to 32 bits and repeats its "
            "noise late in a run (Diffrax issue 733): use one of the paths below."
        )
    return Suggestions(description, tuple(suggestions))


def _terms_with_paths(
    terms: diffrax.AbstractTerm,
    key: PRNGKeyArray,
    *,
    make_path: Callable,
    motions: tuple[int, ...],
    which_truncated: tuple[bool, ...],
) -> diffrax.AbstractTerm:
    """The terms with new paths from this key.

    - `make_path(shape, key)`: makes a path.
    - `motions`: for each random path the number of the Brownian motion that it samples.
        Paths of the same number get the same key.
    - `which_truncated`: for each path, whether its increments are truncated.
    """
    return with_truncation(with_paths(make_path, motions, terms, key), which_truncated)


class System(NamedTuple):
    """What decides which solvers suit a system.

    - `structures`: which of `"separable"`, `"additive"` and `"constant"` the system is: the
        Hamiltonians are separable, the noise is additive, and constant in time, too.
    - `commute`: whether the noises commute, as far as is known.
    - `num_noises`: the number of scalar Brownian motions.
    - `fault`: why the system is not separable; `None` if it is.
    - `friction`: whether there is friction that solvers for heat baths, such as `BAOAB()`,
        treat apart from the drift.
    - `general_bath`: whether there is friction that only `BAOAB(ImplicitMidpoint())` treats
        apart from the drift, as for masses that depend on positions.
    - `friction_in_drift`: whether there is friction that all solvers treat as a part of the
        drift, as beside noise that is not in the forces.
    - `constrained`: whether the positions are constrained.
    """

    structures: Collection[Structure]
    commute: bool
    num_noises: int
    fault: Fault | None = None
    friction: bool = False
    general_bath: bool = False
    friction_in_drift: bool = False
    constrained: bool = False

    def in_a_sentence(self) -> str:
        """The structure of the system, such as "The system is separable, with friction and
        one noise.", and what the user could change to get more solvers."""
        parts = "one noise"
        if self.num_noises > 1:
            how = "commute" if self.commute else "do not commute"
            parts = f"{self.num_noises} noises that {how}"
        if self.friction or self.general_bath:
            parts = f"friction and {parts}"
        if self.friction_in_drift:
            parts = f"friction in the drift and {parts}"
        if self.constrained:
            parts = f"constraints, {parts}"
        fault = self.fault
        reason = "" if fault is None else fault.reason
        # A system of no structure is not separable, so that it has a reason.
        structure = " and ".join(self.structures) or f"general ({reason})"
        description = f"The system is {structure}, with {parts}."
        # There is nothing to change in a separable system, or in one with friction that
        # solvers for heat baths treat apart.
        if fault is None or self.friction:
            return description
        # Without any structure, the reason is in the description already.
        if self.structures and fault.wrong_way_round:
            description += f" It is not separable: {reason}."
        if fault.friction:
            description += f" {FRICTION}"
        return description


def _inspect(
    drift: Terms, noise: Terms, t0: Array, y0: Y, args: Args, constrained: bool
) -> System:
    """The system, as it is found by tracing its terms. A structure is found if its fault,
    the reason why the system does not have it, is `None`."""
    fault = separable_fault(drift, noise, t0, y0, args)
    structures: list[Structure] = [] if fault else ["separable"]
    if additive_fault(noise, t0, y0, args) is None:
        structures.append("additive")
        if constant_fault(noise, t0, y0, args) is None:
            structures.append("constant")
    terms = diffrax.MultiTerm(*drift, *noise)
    num_noises = number_of_noises(terms)
    # Noise that acts as a force `U_k(t, q)` commutes, whatever the drift is.
    noise_in_forces = separable_fault((), noise, t0, y0, args) is None
    # Noises of each of the structures commute. `noises_commute` comes last, since it
    # compiles a program, which compares the noises at random states.
    commute = (
        num_noises == 1
        or len(structures) > 0
        or noise_in_forces
        or noises_commute(noise, t0, y0, args)
    )
    # Each friction is one of three kinds, as the fields of `System` say.
    _, friction_terms = friction_apart(drift)
    friction = accepts_friction(terms, t0, y0, args, BAOAB())
    general_bath = (
        not friction
        and len(friction_terms) > 0
        and not constrained
        and accepts_friction(terms, t0, y0, args, _BATH_OF_ANY_ENERGY)
    )
    return System(
        structures=structures,
        fault=fault,
        num_noises=num_noises,
        commute=commute,
        friction=friction,
        general_bath=general_bath,
        friction_in_drift=len(friction_terms) > 0 and not friction and not general_bath,
        constrained=constrained,
    )


def _suitable(
    system: System,
    want: Want,
    paths: list[diffrax.AbstractBrownianPath],
    one_term: bool,
) -> list[AbstractSymplecticSolver]:
    """The solvers for a system, best first: the ranked ones that

    - keep the constraints of the system, if there are any;
    - need no Lévy areas between noises that are not entries of one array;
    - use the random variables of those paths that the suggested terms keep.

    `paths` are the paths of the noises, and `one_term` says whether one term holds all
    noises. Raises a `ValueError` if no solver keeps the constraints of the system."""
    solvers = ranked(want, system)
    if system.constrained:
        solvers = [solver for solver in solvers if solver.keeps_constraints]
        if system.friction:
            solvers.append(BAOAB(StormerVerlet()))
        if not solvers:
            raise ValueError(
                "Solvers for constrained terms need H0 = p . M^-1 p / 2 + U(t, q), "
                "noise Hamiltonians H_k = U_k(t, q), and friction only from "
                "`langevin_terms`."
            )
    are_one_array = one_term and jtu.all_leaves([increment_struct(paths[0])])
    if not are_one_array:
        solvers = [
            solver
            for solver in solvers
            # The random variables that drive brackets of noises are their Lévy areas.
            if "noise brackets" not in map(drives, solver.variables)
        ]
    # Given noise, and paths whose law is not known, are not replaced by paths of a solver.
    kept = [path for path in paths if not is_random(path) or has_unknown_law(path)]
    return [
        solver
        for solver in solvers
        if all(_has_variables_for(path, solver) for path in kept)
    ]


def _has_variables_for(
    path: diffrax.AbstractBrownianPath, solver: AbstractSymplecticSolver
) -> bool:
    """Whether a path has the random variables that the solver needs. Every path has `"W"`,
    the increments alone."""
    # `levy_area` is Diffrax's name for the class of what a path returns for a step.
    increment = getattr(path, "levy_area", diffrax.AbstractBrownianIncrement)
    return solver.variables == ("W",) or issubclass(increment, solver.minimal_levy_area)


def _check_noise(terms: diffrax.AbstractTerm) -> None:
    """Raises a `ValueError` if there is no noise, or a noise has no Brownian path."""
    advice = (
        "Pass the terms of a Stratonovich system, `hamiltonian_terms(H0, noise, path)` or "
        "`MultiTerm(ODETerm(f), ControlTerm(g, path))`, with a Brownian path"
    )
    if not isinstance(terms, diffrax.AbstractTerm):
        raise ValueError(f"{advice}; got {type(terms).__name__}.")
    _, noise = split_terms(terms)
    if len(noise) == 0 or any(len(brownian_paths(term)) == 0 for term in noise):
        raise ValueError(
            f"{advice}; got terms without one. (For a system without noise use "
            "`ImplicitMidpoint` or `StormerVerlet`.)"
        )


def accepts_friction(
    terms: diffrax.AbstractTerm,
    t0: RealScalarLike,
    y0: Y,
    args: Args,
    solver: BAOAB,
) -> bool:
    """Whether these are Langevin terms that this `BAOAB` accepts without a `ValueError`."""
    try:
        solver.check(terms, t0, y0, args)
    except ValueError:
        return False
    return True


def ranked(want: Want, system: System) -> list[AbstractSymplecticSolver]:
    """The suggested solvers for such a system, best first."""
    kinds = _ranked_for_means(system) if want == "weak" else FOR_PATHS
    solvers = [kind() for kind in kinds if _suits(kind, system)]
    return [_BATH_OF_ANY_ENERGY, *solvers] if system.general_bath else solvers


def _ranked_for_means(system: System) -> list[type[AbstractSymplecticSolver]]:
    """All classes of solvers for means, those that are best for such a system first. Not
    all of them suit the system."""
    first: list[type[AbstractSymplecticSolver]] = [*FOR_FRICTION]
    last: list[type[AbstractSymplecticSolver]] = []
    if system.friction or system.friction_in_drift:
        # For harmonic modes `SRKw1` has exact stationary means at every step size.
        first.append(SRKw1)
    if system.num_noises > _MOST_FLOWS_OF_NOISE:
        last.append(NinomiyaVictoir)
    others = [kind for kind in FOR_MEANS if kind not in first and kind not in last]
    return [*first, *others, *last]


def _suits(kind: type[AbstractSymplecticSolver], system: System) -> bool:
    """Whether solvers of this class are for such a system. Those for heat baths are if they
    treat its friction, all others if they are for its structure and its noises."""
    if kind in FOR_FRICTION:
        return system.friction
    structures = {"any", *system.structures}
    if {"separable", "constant"} <= structures:
        structures.add("separable and constant")
    noises = ("any", "commuting" if system.commute else "not commuting")
    solver = kind()
    assert solver.record is not None
    return solver.structure in structures and solver.record.noises in noises


def _code(solver: AbstractSymplecticSolver, module: str = "") -> str:
    """The code that constructs the solver, such as `BAOAB(ImplicitMidpoint())`. Each name
    gets the prefix `module`, such as `ds.`."""
    flow = ""
    if isinstance(solver, BAOAB) and is_solver(solver.flow):
        flow = _code(solver.flow, module)  # pyright: ignore
    return f"{module}{type(solver).__name__}({flow})"


def _path_code(
    solver: AbstractSymplecticSolver,
    want: Want,
    terms: diffrax.AbstractTerm,
    needs_bounded: bool,
) -> str:
    """Describes the path of a suggestion.

    - If the solver makes new paths: the code that makes the first of them. They differ only
        in their shapes.
    - If random paths of an unknown law are kept, or given noise: in words.

    `needs_bounded` says whether implicit steps need bounded increments of any path."""
    random_noise = random_paths(terms)
    replaceable = [path for path in random_noise if not has_unknown_law(path)]
    if replaceable:
        struct = increment_struct(replaceable[0])
        shape = _shape_code(struct)
        # `solver.path` does not know the terms. It truncates increments in case they must
        # be bounded. If they need not be, the code makes the same path without truncation.
        example = solver.path(struct, jr.key(0), want=want)
        if isinstance(example, TruncatedBrownianPath) and not needs_bounded:
            return f"ds.FixedStepBrownianPath({shape}, key)"
        return f'{_code(solver, "ds.")}.path({shape}, key, want="{want}")'
    if random_noise:
        return f"the `{type(random_noise[0]).__name__}` of the terms, with another key"
    return "the path of the terms, which holds given noise"


def _shape_code(shape: PyTree[jax.ShapeDtypeStruct]) -> str:
    """The code for the shape of a path, such as `(3,)`. The code for a PyTree of shapes
    would be long, so that the name `shape` stands for it."""
    if not isinstance(shape, jax.ShapeDtypeStruct):
        return "shape"
    if shape.dtype == jnp.result_type(float):
        return str(shape.shape)
    return f"jax.ShapeDtypeStruct({shape.shape}, jnp.{shape.dtype})"
