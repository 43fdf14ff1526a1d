"""The base classes of all solvers, and the step of a tableau."""

import abc
import dataclasses
import functools as ft
import math
from collections.abc import Callable
from typing import Any, cast, ClassVar, TYPE_CHECKING

import diffrax
import equinox as eqx
import jax
import jax.tree_util as jtu
import optimistix as optx
from jaxtyping import ArrayLike, PRNGKeyArray, PyTree

from .._arguments import check_state, whole_number
from .._batch import batched_like
from .._brownian import drives, most_demanding_variable, path_maker
from .._custom_types import Args, Terms, Y
from .._root_finder import PicardNewton
from .._tableau import (
    AbstractTableau,
    drift_order,
    FlatTableau,
    is_own_inverse,
    make_plan,
    Structure,
)
from .._terms import check_structure, number_of_noises, split_terms
from .driven import drift_change, noise_changes
from .record import Record, Want
from .step import no_failure, Outcome, result_of, Step, take_step
from .times import result_with_times_checked


if TYPE_CHECKING:
    # Repeated in each module that needs it: if the name came from another module of this
    # package, Pyright would take abstract variables for arguments of `__init__`.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# The solver state is an `Outcome`, by which a step knows the paths that failed before:
# Diffrax continues to step them while others of their batch go on.
class AbstractSymplecticSolver(diffrax.AbstractStratonovichSolver[Outcome]):
    r"""The base class of all solvers of this package, and of your own solvers that are not
    Runge--Kutta methods.

    A subclass is a Diffrax solver, with `order`, `init` and `step`, which accept any
    Stratonovich terms. It defines `structure` (`"any"`, `"separable"`, `"additive"`,
    `"constant"` or `"separable and constant"`), `variables` (the names of the random
    variables of a step, such as `("W",)`), and `stage_vectors(num_noises)`, and overrides
    `weak_order(terms)` and `strong_order(terms)`. Then [`diffrax_symplectic.LinearFlow`][]
    can wrap it, [`diffrax_symplectic.BAOAB`][] can take it as its flow, and
    `solver.path(shape, key)` makes the path that it needs.

    **Draw noise once per step**, by `contr(t0, t1)` of each noise term with the times of
    the step: see [a solver of your own](own_tableau.md#beyond-a-tableau).
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., diffrax.LocalLinearInterpolation]] = (
        diffrax.LocalLinearInterpolation
    )
    record: ClassVar[Record | None] = None
    # Whether the solver takes constrained terms.
    keeps_constraints: ClassVar[bool] = False
    structure: AbstractVar[Structure]
    variables: AbstractVar[tuple[str, ...]]

    @abc.abstractmethod
    def stage_vectors(self, num_noises: int) -> tuple[int, ...]:
        """The number of unknown stage vectors in each system of equations of a step, in the
        order in which the systems are solved."""

    @property
    def undoes_its_steps(self) -> bool:
        """Whether a step back in time, with negated increments, returns to where the step
        began. [`diffrax_symplectic.ReversingAdjoint`][] needs this."""
        return False

    @property
    def minimal_levy_area(self) -> type[diffrax.AbstractBrownianIncrement]:
        """The type of increment that the path must return. It determines the Lévy areas
        that an increment contains."""
        variable = most_demanding_variable(self.variables)
        if variable is None:
            return diffrax.AbstractBrownianIncrement
        return variable.increment

    def strong_order(self, terms: PyTree[diffrax.AbstractTerm]) -> int | float | None:
        """Strong order of convergence. `None` for a weak method, or if it is not stated."""
        return self._order_for("strong", terms)

    def weak_order(self, terms: PyTree[diffrax.AbstractTerm]) -> int | None:
        """Weak order of convergence; with several noises, the order if they do not commute.
        `None` if it is not stated."""
        return cast(int | None, self._order_for("weak", terms))

    def _order_for(
        self, want: Want, terms: PyTree[diffrax.AbstractTerm]
    ) -> int | float | None:
        """The strong or weak order on record: with several noises, the order if they do not
        commute. `None` if there is no record, or no such order in it."""
        # Solvers of the user's own need no record.
        if self.record is None:
            return None
        if_commuting = self.record.order(want, commute=True)
        otherwise = self.record.order(want, commute=False)
        # Most solvers have one order for both, and accept `None` as `terms`.
        if if_commuting == otherwise:
            return otherwise
        # One noise commutes with itself. Whether several commute depends on values, which
        # are not known here.
        return if_commuting if number_of_noises(terms) <= 1 else otherwise

    def path(
        self,
        shape: tuple[int, ...] | PyTree[jax.ShapeDtypeStruct],
        key: PRNGKeyArray,
        *,
        want: Want | None = None,
    ) -> diffrax.AbstractBrownianPath:
        """A Brownian path for fixed steps, with the random variables that the solver needs.

        If an implicit solver needs Gaussian increments without Lévy areas, the path is a
        [`diffrax_symplectic.TruncatedBrownianPath`][]: with noise that depends on the
        state, a step with an unbounded increment may have no solution. A truncated path
        loses variance in steps that are not short in its `unit` of time, which is 1.

        Additive noise needs no truncation, but a solver without terms cannot know that the
        noise is additive: pass a [`diffrax_symplectic.FixedStepBrownianPath`][] then. Or
        pass the shape where it is accepted in place of a path:
        [`diffrax_symplectic.expectation`][], [`diffrax_symplectic.ensemble`][] and
        [`diffrax_symplectic.suggest_solver`][] see what the noise depends on.
        [`diffrax_symplectic.langevin_terms`][] truncate nothing.

        **Arguments:**

        - `shape`: the shape of the increments, `(m,)` for `m` noises; or a PyTree of
            `jax.ShapeDtypeStruct`s.
        - `key`: a JAX random key.
        - `want`: `"strong"` for the increments of a Brownian motion, `"weak"` for
            discrete increments where they suffice. By default `"strong"` if the solver has
            a strong order, otherwise `"weak"`.

        **Raises:** a `ValueError` if `want`, `shape` or `key` is anything else.
        """
        if want not in ("strong", "weak", None):
            raise ValueError(f'`want` must be "strong" or "weak"; got {want!r}.')
        if want is None:
            strong_order = None if self.record is None else self.record.strong
            want = "weak" if strong_order is None else "strong"
        is_implicit = isinstance(self, diffrax.AbstractImplicitSolver)
        make_path = path_maker(
            self.variables, gaussian=want == "strong", bounded=is_implicit
        )
        return make_path(shape, key)

    def __repr__(self) -> str:
        """The class and the parameters that differ from its defaults, in one line, such as
        `SRKs1(a=0.5)`."""
        arguments = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            # For a traced value `tree_equal` returns a traced boolean, which is not `True`:
            # the value counts as different.
            is_default = eqx.tree_equal(value, field.default) is True
            if field.repr and not is_default:
                in_one_line = ft.partial(eqx.tree_pformat, width=1_000)
                # `tree_pformat` would ignore the `__repr__` of a module, such as this one.
                as_text = repr if isinstance(value, eqx.Module) else in_one_line
                arguments.append(f"{field.name}={as_text(value)}")
        return f"{type(self).__name__}({', '.join(arguments)})"

    def check(self, terms, t0, y0: Y, args: Args) -> None:
        """Raises a `ValueError` unless the state and the terms suit the solver."""
        solver_name = type(self).__name__
        check_state(solver_name, y0)
        drift, noise = split_terms(terms)
        check_structure(self.structure, drift, noise, t0, y0, args, solver_name)

    def func(self, terms, t0, y0: Y, args: Args) -> PyTree[ArrayLike]:
        return terms.vf(t0, y0, args)


class AbstractSymplecticRungeKutta(AbstractSymplecticSolver):
    r"""A Runge--Kutta method with its own coefficients for drift and noise.

    Subclasses define a `tableau`. If it has implicit stages, they also inherit from
    [`diffrax_symplectic.AbstractImplicitStages`][]. Everything else follows from the
    tableau: unused stages are dropped, equal stages are evaluated once, and implicit stages
    are solved for one small system after another, as far as the coefficients allow.

    **Terms.** `MultiTerm(drift, noise)`, from [`diffrax_symplectic.hamiltonian_terms`][] or
    made of Diffrax's own `ODETerm` and `ControlTerm`, with any number of noise terms; or
    the drift alone. A `ValueError` is raised while tracing if they do not have the
    structure of the tableau.

    **State.** Any PyTree of real floating-point arrays.

    **Failures.** A step fails if a stage equation is not solved, if its end is not finite,
    or if it is shorter than a hundred times the rounding of the time. Then `diffeqsolve`
    raises an error, or with `throw=False` reports it in `sol.result`. The other paths of a
    batch continue. A step outside of the time interval of its path is an error when run,
    whatever `throw` is.
    """

    tableau: AbstractVar[AbstractTableau]

    @property
    def structure(self) -> Structure:
        # A tableau of the user's own may lack `structure`: `check` raises an error for
        # `None`, with advice.
        return getattr(self.tableau, "structure", None)  # pyright: ignore

    @property
    def variables(self) -> tuple[str, ...]:
        return tuple(_variables(make_plan(self.tableau.flatten()).tableau))

    def stage_vectors(self, num_noises: int) -> tuple[int, ...]:
        del num_noises
        blocks = make_plan(self.tableau.flatten()).blocks
        sizes = [sum(len(group) for group in block.unknown) for block in blocks]
        # A block without unknown stages is explicit, and no system of equations.
        return tuple(size for size in sizes if size > 0)

    @property
    def undoes_its_steps(self) -> bool:
        return is_own_inverse(make_plan(self.tableau.flatten()).tableau)

    def order(self, terms: PyTree[diffrax.AbstractTerm]) -> int:
        """Order of convergence without noise, computed from the coefficients."""
        del terms
        return drift_order(self.tableau.flatten())

    def init(self, terms, t0, t1, y0: Y, args: Args) -> Outcome:
        del t1
        # The check is here, not in `step`, since a solve calls `init` only once.
        self.check(terms, t0, y0, args)
        is_implicit = isinstance(self, diffrax.AbstractImplicitSolver)
        return no_failure() if is_implicit else None

    def step(
        self, terms, t0, t1, y0: Y, args: Args, solver_state: Outcome, made_jump
    ) -> tuple[Y, None, dict[str, Y], Outcome, diffrax.RESULTS]:
        del made_jump
        drift, noise = split_terms(terms)
        plan = make_plan(_without_idle_stages(self.tableau.flatten(), drift, noise))
        # If one input of the step is batched by `vmap`, all become so here. An input that
        # became batched within a loop would make JAX trace the loop again.
        inputs = (t0, t1, y0, solver_state)
        begin, end, y0, solver_state = batched_like(inputs, (inputs, terms, args))
        h = end - begin
        by_drift = drift_change(drift, begin, end, args)
        names = _variables(plan.tableau)
        solver_name = type(self).__name__
        # Brownian paths get the times as they are, `t0` and `t1`. If these are not batched,
        # what depends on times alone is computed once for the whole batch.
        by_noise = noise_changes(by_drift, h, noise, names, t0, t1, args, solver_name)
        # For each channel of the plan, the change of the state as a function of time and
        # state. Without drift terms no stage has the channel "h".
        changes = {"h": by_drift, **by_noise} if drift else by_noise
        y1, outcome = take_step(plan, Step(begin, h, changes), y0, self, solver_state)
        result = result_with_times_checked(terms, t0, t1, result_of(outcome, y1))
        return y1, None, dict(y0=y0, y1=y1), outcome, result


def _without_idle_stages(
    tableau: FlatTableau, drift: Terms, noise: Terms
) -> FlatTableau:
    """The tableau without the stages of the drift if there are no drift terms, and without
    the stages of the noise if there are no noise terms. Without a drift, its brackets with
    the noise are left out of the other stages."""
    driven_stages = []
    for i, stage in enumerate(tableau.stages):
        # "h" is the channel of the drift.
        terms = drift if stage.channels == ("h",) else noise
        if len(terms) > 0:
            driven_stages.append(i)
    driven = tableau.take(driven_stages)
    if len(drift) > 0:
        return driven
    stages = []
    for stage in driven.stages:
        channels = [x for x in stage.channels if drives(x) != "drift brackets"]
        stages.append(stage._replace(channels=tuple(channels)))
    return dataclasses.replace(driven, stages=tuple(stages))


def _variables(tableau: FlatTableau) -> list[str]:
    """The names of the random variables that drive the stages."""
    channels = [name for stage in tableau.stages for name in stage.channels]
    # A dictionary keeps each name once, in the order of the stages, while the order of a
    # set would differ from run to run.
    return [name for name in dict.fromkeys(channels) if name != "h"]


def _checked_root_finder(value: Any) -> Any:
    """The root finder `value`. Raises a `ValueError` for anything else, such as a class of
    root finders or a name that SciPy knows."""
    if not isinstance(value, optx.AbstractRootFinder | optx.AbstractLeastSquaresSolver):
        raise ValueError(
            "`root_finder` must be an Optimistix root finder, or "
            f"`PicardNewton(rtol=...)`; got {value!r}."
        )
    return value


class AbstractImplicitStages(diffrax.AbstractImplicitSolver):
    """A solver with implicit stages. It has the two fields that Diffrax requires, both
    keyword-only: the root finder for the stage equations, and its maximum number of steps
    in each step of the solver."""

    # `optimistix.root_find` accepts either kind of solver.
    root_finder: optx.AbstractRootFinder | optx.AbstractLeastSquaresSolver = eqx.field(
        default=PicardNewton(), kw_only=True, converter=_checked_root_finder
    )
    # Diffrax requires this field. See `IMPLICIT_ARGUMENTS` for what it bounds.
    root_find_max_steps: int = eqx.field(
        default=100,
        kw_only=True,
        converter=ft.partial(whole_number, "root_find_max_steps", least=0),
    )


def with_changed_stages(solver: Any, change: Callable[[Any], Any]) -> Any:
    """`solver` with `change(x)` in place of each solver `x` whose root finder is a
    `PicardNewton`: in place of `solver` itself, or of a solver within it, such as the flow
    of a splitting."""

    def change_if_possible(x: Any) -> Any:
        if _is_implicit(x) and isinstance(x.root_finder, PicardNewton):
            return change(x)
        return x

    return jtu.tree_map(change_if_possible, solver, is_leaf=_is_implicit)


def has_newton(solver: Any) -> bool:
    """Whether `solver`, or a solver within it, has a `PicardNewton` whose sweeps are
    followed by Newton's method where they do not converge."""
    parts = jtu.tree_leaves(solver, is_leaf=_is_implicit)
    finders = [x.root_finder for x in parts if _is_implicit(x)]
    return any(isinstance(x, PicardNewton) and x.newton_steps > 0 for x in finders)


def without_newton(solver: Any) -> Any:
    """The solver, with each `PicardNewton` in it ending after its sweeps."""

    def with_sweeps_alone(implicit_solver: Any) -> Any:
        sweeps = dataclasses.replace(implicit_solver.root_finder, newton_steps=0)
        return eqx.tree_at(lambda x: x.root_finder, implicit_solver, sweeps)

    return with_changed_stages(solver, with_sweeps_alone)


def _is_implicit(x: Any) -> bool:
    return isinstance(x, AbstractImplicitStages)


# Equinox makes an `__init__` for each class, without a docstring. This is the docstring for
# solvers with implicit stages.
IMPLICIT_ARGUMENTS = """**Arguments:** the parameters above, if any (Python numbers or
strings), and

- `root_finder`: any Optimistix root finder for the stage equations.
- `root_find_max_steps`: the most steps that a root finder of another package may take in
    a step of the solver. `PicardNewton`, the default, takes a single step of
    `optimistix.root_find` and has bounds of its own, `picard_steps` and `newton_steps`, so
    that this has no effect on it (unless it is zero).

**Raises:** a `ValueError` for any other value.
"""


def free_parameter(name: str, default: float) -> Any:
    """A solver's field for a free parameter. Parameters determine which stages are used, so
    they must be known while tracing."""
    converter = ft.partial(real_number, name)
    return eqx.field(default=default, static=True, converter=converter)


def real_number(name: str, value: Any) -> float:
    """`value` as a float. Raises a `ValueError`, which quotes the `name` of the parameter,
    unless it is a finite real number."""
    try:
        # `float` accepts NumPy's `complex128`, which is a `complex`, with a mere warning.
        number = math.nan if isinstance(value, complex) else float(value)
    except (TypeError, ValueError):
        # JAX's errors about traced arrays are of these types, too.
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(
            f"`{name}` must be a finite real number, known before tracing (a Python "
            f"float, not a traced array); got {value!r}."
        )
    return number
