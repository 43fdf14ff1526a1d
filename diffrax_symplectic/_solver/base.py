"""The base classes of all solvers, and the step of a tableau."""

import abc
import dataclasses
import functools as ft
import math
from collections.abc import Callable
from typing import (
    Any,
    cast,
    ClassVar,
    TYPE_CHECKING,
    TypeVar,
)

import diffrax
import equinox as eqx
import jax
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
    Stage,
    Structure,
)
from .._terms import check_structure, number_of_noises, split_terms
from .driven import drift_driven, noise_driven
from .record import Record, Want
from .step import no_failure, Outcome, result_of, Step, take_step
from .times import result_with_times_checked


if TYPE_CHECKING:
    # In one module for all, Pyright would take the variables for arguments of `__init__`.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# The solver state is whether all stage equations were solved so far: in a batch Diffrax
# continues to step failed paths.
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
    # Whether it takes constrained terms.
    keeps_constraints: ClassVar[bool] = False
    structure: AbstractVar[Structure]
    variables: AbstractVar[tuple[str, ...]]

    @abc.abstractmethod
    def stage_vectors(self, num_noises: int) -> tuple[int, ...]:
        """The number of unknown stage vectors in each system of equations of a step, in the
        order in which the systems are solved."""

    @property
    def undoes_its_steps(self) -> bool:
        """Whether a step with negated increments leads back to where a step began, which
        [`diffrax_symplectic.ReversingAdjoint`][] needs."""
        return False

    @property
    def minimal_levy_area(self) -> type[diffrax.AbstractBrownianIncrement]:
        """The least that the path's increments must contain."""
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
        """The order on record, for strong or weak approximation: for several noises the one
        without assuming that they commute. `None` if there is no record, or in it no such
        order."""
        # Solvers of the user's own need no record.
        if self.record is None:
            return None
        commuting = self.record.order(want, commute=True)
        others = self.record.order(want, commute=False)
        # One noise commutes with itself, and without noise there is nothing to commute. Of
        # several it is not known here, since it depends on values, so the lower order is
        # returned. Terms are looked at only if it matters: for most solvers they may be
        # `None`.
        if commuting == others or number_of_noises(terms) <= 1:
            return commuting
        return others

    def path(
        self,
        shape: tuple[int, ...] | PyTree[jax.ShapeDtypeStruct],
        key: PRNGKeyArray,
        *,
        want: Want | None = None,
    ) -> diffrax.AbstractBrownianPath:
        """A Brownian path for fixed steps, with the random variables that the solver needs.

        The path does not know the terms. So where an implicit solver needs increments alone
        and these are Gaussian, it is a [`diffrax_symplectic.TruncatedBrownianPath`][]: with
        noise that depends on the state, steps with unbounded increments may have no
        solution. It loses variance in long steps. For additive noise, which needs none of
        this, pass a
        [`diffrax_symplectic.FixedStepBrownianPath`][], or where a shape suffices, the
        shape: [`diffrax_symplectic.expectation`][], [`diffrax_symplectic.ensemble`][] and
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
            strong = self.record is not None and self.record.strong is not None
            want = "strong" if strong else "weak"
        implicit = isinstance(self, diffrax.AbstractImplicitSolver)
        make = path_maker(self.variables, gaussian=want == "strong", bounded=implicit)
        return make(shape, key)

    def __repr__(self) -> str:
        """The parameters that differ from the defaults, in one line."""
        given = []
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            # Whether traced values are equal is not known.
            is_default = eqx.tree_equal(value, field.default) is True
            if field.repr and not is_default:
                # A module may have a `__repr__` of its own, as this one does.
                module = isinstance(value, eqx.Module)
                text = repr(value) if module else eqx.tree_pformat(value)
                given.append(f"{field.name}={text}")
        return f"{type(self).__name__}({', '.join(given)})"

    def check(self, terms, t0, y0: Y, args: Args) -> None:
        """Raises a `ValueError` unless the state and the terms suit the solver."""
        name = type(self).__name__
        check_state(y0, name)
        check_structure(self.structure, *split_terms(terms), t0, y0, args, name)

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
        return getattr(self.tableau, "structure", None)  # pyright: ignore

    @property
    def variables(self) -> tuple[str, ...]:
        return tuple(_variables(make_plan(self.tableau.flatten()).tableau))

    def stage_vectors(self, num_noises: int) -> tuple[int, ...]:
        del num_noises
        blocks = make_plan(self.tableau.flatten()).blocks
        sizes = [sum(map(len, block.unknown)) for block in blocks]
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
        # Here, not in `step`, since a solve calls it only once.
        self.check(terms, t0, y0, args)
        implicit = isinstance(self, diffrax.AbstractImplicitSolver)
        return no_failure() if implicit else None

    def step(
        self, terms, t0, t1, y0: Y, args: Args, solver_state: Outcome, made_jump
    ) -> tuple[Y, None, dict[str, Y], Outcome, diffrax.RESULTS]:
        del made_jump
        drift, noise = split_terms(terms)
        plan = make_plan(_drop_absent(self.tableau.flatten(), drift, noise))
        variables = _variables(plan.tableau)
        # All of a step is batched if anything is, since values that become batched within
        # its loops would be traced again.
        begun = (t0, t1, y0, solver_state)
        begin, end, y0, solver_state = batched_like(begun, (begun, terms, args))
        from_drift = drift_driven(drift, begin, end, args)
        h = end - begin
        driven = {"h": from_drift} if drift else {}
        # The path gets the times as they are: if they are the same for all paths of a
        # batch, so is the place of the step.
        name = type(self).__name__
        driven |= noise_driven(from_drift, h, noise, variables, t0, t1, args, name)
        y1, outcome = take_step(plan, Step(begin, h, driven), y0, self, solver_state)
        result = result_with_times_checked(terms, t0, t1, result_of(outcome, y1))
        return y1, None, dict(y0=y0, y1=y1), outcome, result


def _drop_absent(tableau: FlatTableau, drift: Terms, noise: Terms) -> FlatTableau:
    """Drops stages that no term drives (an ODE has no noise), and without drift the
    brackets of drift and noise."""
    keep = [
        i
        for i, stage in enumerate(tableau.stages)
        if len(drift if stage.channels == ("h",) else noise) > 0
    ]
    tableau = tableau.take(keep)
    if len(drift) > 0:
        return tableau
    stages = tuple(_without_brackets(stage) for stage in tableau.stages)
    return dataclasses.replace(tableau, stages=stages)


def _without_brackets(stage: Stage) -> Stage:
    """The stage without channels that drive brackets with the drift."""
    kept = [name for name in stage.channels if drives(name) != "drift brackets"]
    return stage._replace(channels=tuple(kept))


def _variables(tableau: FlatTableau) -> list[str]:
    """The random variables that drive the stages."""
    channels = [name for stage in tableau.stages for name in stage.channels]
    # Each once, in an order that is the same in every run.
    return [name for name in dict.fromkeys(channels) if name != "h"]


def _checked_root_finder(value: Any) -> Any:
    """Raises a `ValueError` unless this is a root finder, not its class or a SciPy name."""
    kinds = optx.AbstractRootFinder | optx.AbstractLeastSquaresSolver
    if not isinstance(value, kinds):
        raise ValueError(
            "`root_finder` must be an Optimistix root finder, or "
            f"`PicardNewton(rtol=...)`; got {value!r}."
        )
    return value


class AbstractImplicitStages(diffrax.AbstractImplicitSolver):
    """A solver with implicit stages. It adds the two fields that Diffrax requires, both
    keyword-only: the root finder for the stage equations, and its maximum number of steps
    in each step of the solver."""

    # `optimistix.root_find` accepts either kind of solver.
    root_finder: optx.AbstractRootFinder | optx.AbstractLeastSquaresSolver = eqx.field(
        default=PicardNewton(), kw_only=True, converter=_checked_root_finder
    )
    # Diffrax requires this field. See `_ARGUMENTS` for what it bounds.
    root_find_max_steps: int = eqx.field(
        default=100,
        kw_only=True,
        converter=ft.partial(whole_number, "root_find_max_steps", least=0),
    )


_Solver = TypeVar("_Solver", bound=type)

_ARGUMENTS = """**Arguments:** the parameters above, if any (Python numbers or strings), and

- `root_finder`: any Optimistix root finder for the stage equations.
- `root_find_max_steps`: the most steps that a root finder of another package may take in
    a step of the solver. `PicardNewton`, the default, takes a single step of
    `optimistix.root_find` and has bounds of its own, `picard_steps` and `newton_steps`, so
    that this has no effect on it (unless it is zero).

**Raises:** a `ValueError` for any other value.
"""


def documented(solver: _Solver) -> _Solver:
    """A decorator for solvers with implicit stages, which documents their arguments."""
    # Equinox makes an `__init__` for each class, without a docstring.
    solver.__init__.__doc__ = _ARGUMENTS
    return solver


def free_parameter(name: str, default: float) -> Any:
    """A solver's field for a free parameter. Parameters determine which stages are used, so
    they must be known while tracing."""
    converter = ft.partial(real_number, name)
    return eqx.field(default=default, static=True, converter=converter)


def real_number(name: str, value: Any) -> float:
    """Raises a `ValueError` unless `value` is a finite real number."""
    try:
        number = math.nan if isinstance(value, complex) else float(value)
    except (TypeError, ValueError):
        # Errors of JAX about traced arrays are of these types, too.
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(
            f"`{name}` must be a finite real number, known before tracing (a Python "
            f"float, not a traced array); got {value!r}."
        )
    return number
