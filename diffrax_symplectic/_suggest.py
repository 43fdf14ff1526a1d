"""Which solvers fit a system, best first."""

import dataclasses
import textwrap
from collections.abc import Callable, Sequence
from typing import Any, get_args

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import PRNGKeyArray, PyTree

from ._brownian import increment_struct, WeakBrownianPath
from ._custom_types import Args, RealScalarLike, Y
from ._structure_checks import (
    additive_fault,
    commuting,
    constant_fault,
    FRICTION,
    separable_fault,
)
from ._suggestion_rules import PATHS, Rule, RULES, Want
from ._terms import (
    apply,
    brownian_paths,
    check_state,
    number_of_noises,
    replace_paths,
    split_terms,
)


@dataclasses.dataclass(frozen=True)
class Suggestion:
    """One solver for a system, as [`diffrax_symplectic.suggest_solver`][] finds it.

    - `solver`: the solver.
    - `weak_order`, `strong_order`: its orders for this system; the strong one is `None`
        for a solver for expectations alone.
    - `path`: the Brownian path that it needs, as code.
    - `reason`: why, in a sentence.
    - `terms`: a function of a random key, which returns the terms of the system with such
        paths in place of theirs.
    """

    solver: diffrax.AbstractSolver
    weak_order: int
    strong_order: float | None
    path: str
    reason: str
    terms: Callable[[PRNGKeyArray], diffrax.AbstractTerm] = dataclasses.field(
        repr=False
    )


@dataclasses.dataclass(frozen=True, repr=False)
class Suggestions(Sequence[Suggestion]):
    """What [`diffrax_symplectic.suggest_solver`][] returns: the suggestions, best first.
    To print it gives a table.

    - `system`: what was found out about the system, in a sentence.
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
            name = f"{type(s.solver).__name__}()"
            lines.append(f"{number}. {name:20} {orders}")
            lines.append(f"   path: {s.path}")
            lines += textwrap.wrap(
                s.reason, 88, initial_indent="   ", subsequent_indent="   "
            )
        return "\n".join(lines)

    __repr__ = __str__


def suggest_solver(
    terms: diffrax.AbstractTerm,
    y0: Y,
    args: Args = None,
    *,
    want: Want = "expectations",
    t0: RealScalarLike = 0.0,
) -> Suggestions:
    r"""Suggests solvers for a system, best first, by the structure of its terms.

    Whether $H_0 = V(p) + U(t, q)$ and $H_k = U_k(t, q)$, and whether the noise is additive
    or constant, is found out as the solvers do it for themselves, from the flow of data
    through the terms. Whether noises commute is tested at random states, which is no proof.
    Nothing is solved. How stiff a system is cannot be seen from its terms:
    if the first suggestion is explicit and takes too many steps, take the next implicit
    one.

    !!! example

        ```python
        import diffrax
        import diffrax_symplectic as ds
        import jax.numpy as jnp
        import jax.random as jr

        H0 = lambda t, p, q, args: p**2 / 2 - jnp.cos(q)
        noise = lambda t, p, q, args: 0.1 * jnp.sin(q)
        terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
        y0 = (jnp.array(0.0), jnp.array(1.0))
        suggestions = ds.suggest_solver(terms, y0)
        print(suggestions)
        best = suggestions[0]
        sol = diffrax.diffeqsolve(
            best.terms(jr.key(1)), best.solver, t0=0, t1=1, dt0=0.1, y0=y0
        )
        ```

    **Arguments:**

    - `terms`: the terms of a Stratonovich system, as of
        [`diffrax_symplectic.hamiltonian_terms`][], with any Brownian path.
    - `y0`, `args`: the state and the arguments of the solve.
    - `want`: `"expectations"`, if means over all paths matter, or `"paths"`, if single
        ones do.
    - `t0`: where the solve begins.

    **Returns:** a sequence of suggestions, each with `solver`, `weak_order`,
    `strong_order`, `path`, `reason`, and `terms(key)`, the terms with the path that the
    solver needs.

    **Raises:** a `ValueError` if `want` is neither of the two, if `terms` has no Brownian
    path, and for terms and states that no solver takes.
    """
    if want not in get_args(Want):
        raise ValueError(f"`want` must be one of {get_args(Want)}; got {want!r}.")
    drift, noise = _parts(terms)
    check_state(y0, "suggest_solver")
    t0 = jnp.asarray(t0, jnp.result_type(*jtu.tree_leaves(y0)))
    # Raises an error if the terms do not fit the state.
    controls = eqx.filter_eval_shape(
        lambda: [x.contr(t0, t0) for x in (*drift, *noise)]
    )
    eqx.filter_eval_shape(apply, (*drift, *noise), controls, args, t0, y0)

    not_separable = separable_fault(drift, noise, t0, y0, args)
    not_additive = additive_fault(noise, t0, y0, args)
    has = {
        "any": True,
        "separable": not_separable is None,
        "additive": not_additive is None,
        "constant": not_additive is None
        and constant_fault(noise, t0, y0, args) is None,
    }
    m = number_of_noises(terms)
    commute = (
        m == 1 or has["separable"] or has["additive"] or commuting(noise, t0, y0, args)
    )
    shape = increment_struct(brownian_paths(noise)[0])
    one_array = len(noise) == 1 and jtu.all_leaves([shape])
    found = []
    for rule, reason in RULES.items():
        fits = rule.want == want and has[rule.structure]
        if rule.noises != "any":
            fits = fits and commute == (rule.noises == "commuting")
        if rule.path == "Lévy areas":
            fits = fits and one_array
        if fits:
            found.append(_suggestion(rule, reason, terms, shape, commute))
    structure = [name for name in has if has[name] and name != "any"]
    kind = (
        " and ".join(structure) or f"general ({getattr(not_separable, 'reason', '')})"
    )
    noises = "one noise"
    if m > 1:
        noises = f"{m} noises that {'commute' if commute else 'do not commute'}"
    system = f"For {want}. The system is {kind}, with {noises}."
    if not_separable is not None and not_separable.advice.startswith(FRICTION):
        system += f" {FRICTION} Ask for a solver for the terms without friction."
        if has["constant"]:
            system += " With constant noise, if it is separable without friction, take "
            system += "`BAOAB(gamma)`."
    return Suggestions(system, tuple(found))


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
            f"{advice}; these have a part without one. (Without noise, `ImplicitMidpoint` "
            "and `StormerVerlet` are solvers for any path.)"
        )
    return drift, noise


def _suggestion(
    rule: Rule, reason: str, terms: diffrax.AbstractTerm, shape, commute: bool
) -> Suggestion:
    solver: Any = rule.solver()
    # The orders of noises that commute are those of one noise.
    counted = terms
    if commute:
        path = WeakBrownianPath((), jr.key(0))
        counted = diffrax.ControlTerm(lambda t, y, args: y, path)
    kind = PATHS[rule.path]
    return Suggestion(
        solver=solver,
        weak_order=solver.weak_order(counted),
        strong_order=solver.strong_order(counted),
        path=kind.code.format(shape=_shape_code(shape)),
        reason=reason,
        terms=jtu.Partial(_with_paths, kind.make, terms),
    )


def _with_paths(make: Callable, terms: PyTree, key: PRNGKeyArray) -> PyTree:
    """The terms with new paths in place of theirs; terms that share a path share the new
    one."""
    made = {}

    def new(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        if id(path) not in made:
            number = len(made)
            own = key if number == 0 else jr.fold_in(key, number + 1)
            made[id(path)] = make(increment_struct(path), own)
        return made[id(path)]

    return replace_paths(terms, new)


def _shape_code(shape: PyTree[jax.ShapeDtypeStruct]) -> str:
    if not isinstance(shape, jax.ShapeDtypeStruct):
        return "shape"
    if shape.dtype == jnp.result_type(float):
        return str(shape.shape)
    return f"jax.ShapeDtypeStruct({shape.shape}, jnp.{shape.dtype})"
