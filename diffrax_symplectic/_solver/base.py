"""One step of any family: the plan of its tableau, carried out on Diffrax terms."""

import functools as ft
from collections.abc import Callable
from typing import ClassVar, NamedTuple, TYPE_CHECKING, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
import optimistix as optx
from equinox.internal import ω
from jaxtyping import Array, Bool, PyTree

from .._brownian import PlateauIncrement, refuse_half_solver, WeakIncrement
from .._custom_types import Args, BoolScalarLike, DenseInfo, RealScalarLike, VF, Y
from .._plan import make_plan
from .._tableau import AbstractTableau, FlatTableau, Stage


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar

_SolverState: TypeAlias = None
# The value of one stage: the change of the part of the state that it writes.
_Value: TypeAlias = PyTree[Array]


class AbstractSymplecticRungeKutta(diffrax.AbstractStratonovichSolver[_SolverState]):
    r"""A Runge--Kutta method with its own coefficients for drift and noise.

    Subclasses give a `tableau` and their orders, and if stages are implicit also subclass
    `diffrax.AbstractImplicitSolver`, with its fields `root_finder` and
    `root_find_max_steps`. Everything else is decided by the tableau: stages that feed
    nothing are dropped, equal ones evaluated once, explicit ones evaluated directly, and
    the implicit rest is solved in as many small systems, one after another, as the
    coefficients allow. The unknowns are the stage values $k_i$, not the stages, so that
    the end of the step is their weighted sum and needs no further evaluation.

    **Terms.** `MultiTerm(drift, noise)` as from
    [`diffrax_symplectic.hamiltonian_terms`][] or of Diffrax's own `ODETerm` and
    `ControlTerm`; any number of noise terms; or the drift alone.

    **State.** Any PyTree of real floating-point arrays.

    **Failures.** If a stage equation is not solved, or the step does not end at finite
    numbers, `diffeqsolve` stops there and says so: as an error, or with `throw=False`
    through `sol.result`. In a batch the other paths go on.
    """

    tableau: AbstractVar[AbstractTableau]

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable[..., diffrax.LocalLinearInterpolation]] = (
        diffrax.LocalLinearInterpolation
    )

    @property
    def term_compatible_contr_kwargs(self) -> dict:  # pyright: ignore
        # Asked for first of all in a solve, and passed on by `HalfSolver`.
        refuse_half_solver(type(self).__name__)
        return {}

    @property
    def minimal_levy_area(self) -> type[diffrax.AbstractBrownianIncrement]:
        """The least that the increments of the path have to hold."""
        variables = _variables(make_plan(self.tableau.flatten()).tableau)
        for name, provider in _PROVIDED_BY.items():
            if name in variables:
                return provider.increment
        return diffrax.AbstractBrownianIncrement

    def init(
        self,
        terms: diffrax.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> _SolverState:
        del t1
        _check_state(y0, type(self).__name__)
        drift, noise = _split(terms)
        self.tableau.check_structure(drift, noise, t0, y0, args, type(self).__name__)
        return None

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: _SolverState,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, None, DenseInfo, _SolverState, diffrax.RESULTS]:
        del solver_state, made_jump
        drift, noise = _split(terms)
        plan = make_plan(_drop_absent(self.tableau.flatten(), drift, noise))
        variables = _variables(plan.tableau)
        evaluate = _Evaluate(drift, noise, variables, t0, t1, args, type(self).__name__)
        stages, matrix = plan.tableau.stages, plan.tableau.matrix
        values: dict[int, _Value] = {}
        result = diffrax.RESULTS.successful

        def values_of(group: tuple[int, ...], values: dict[int, _Value]) -> _Value:
            """The values of stages of one kind; stacked, unless it is only one."""
            position = _position(y0, stages, matrix[list(group)], values)
            return evaluate([stages[i] for i in group], position)

        for block in plan.blocks:
            if len(block.unknown) > 0:
                unknown, block_result = self._solve(
                    block, values_of, values, stages, y0
                )
                values |= unknown
                result = diffrax.RESULTS.where(
                    result == diffrax.RESULTS.successful, block_result, result
                )
            for group in block.explicit:
                values |= _unstack(group, values_of(group, values))

        y1 = _position(y0, stages, plan.tableau.weights[None], values)
        result = diffrax.RESULTS.where(
            (result != diffrax.RESULTS.successful) | _all_finite(y1),
            result,
            diffrax.RESULTS.nonfinite,  # pyright: ignore[reportArgumentType]
        )
        return y1, None, dict(y0=y0, y1=y1), None, result

    def _solve(
        self, block, values_of, known, stages, y0
    ) -> tuple[dict[int, _Value], diffrax.RESULTS]:
        groups = block.unknown

        def complete(unknown: list[_Value]) -> dict[int, _Value]:
            values = dict(known)
            for group, value in zip(groups, unknown):
                values |= _unstack(group, value)
            return values

        def residual(unknown: list[_Value], _) -> list[_Value]:
            values = complete(unknown)
            for group in block.explicit:
                values |= _unstack(group, values_of(group, values))
            image = [values_of(group, values) for group in groups]
            return (unknown**ω - image**ω).ω

        # A stage where it would be if this block did not move at all.
        guess = [values_of(group, known) for group in groups]
        written = [_part(y0, stages[group[0]].writes) for group in groups]
        assert isinstance(self, diffrax.AbstractImplicitSolver)
        linear_solver = getattr(
            self.root_finder, "linear_solver", lx.AutoLinearSolver(None)
        )
        sol = optx.root_find(
            residual,
            self.root_finder,
            guess,
            options=dict(scale=jtu.Partial(_scale, written)),
            max_steps=self.root_find_max_steps,
            adjoint=optx.ImplicitAdjoint(linear_solver=linear_solver),
            throw=False,
        )
        solved = {i: v for i, v in complete(sol.value).items() if i not in known}
        return solved, diffrax.RESULTS.promote(sol.result)

    def func(
        self, terms: diffrax.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args
    ) -> VF:
        return terms.vf(t0, y0, args)


def _scale(written: list[_Value], unknown: list[_Value]) -> list:
    """How large the state is that the unknown stage values change."""
    return jtu.tree_map(lambda x, k: jnp.abs(x) + jnp.abs(k), written, unknown)


def _unstack(group: tuple[int, ...], value: _Value) -> dict[int, _Value]:
    if len(group) == 1:
        return {group[0]: value}
    return {i: jtu.tree_map(lambda v: v[j], value) for j, i in enumerate(group)}


def _drop_absent(tableau: FlatTableau, drift: tuple, noise: tuple) -> FlatTableau:
    """Leaves out the stages that no term drives (an ODE has no noise)."""
    keep = [
        i
        for i, stage in enumerate(tableau.stages)
        if len(drift if stage.channels == ("h",) else noise) > 0
    ]
    return tableau.take(keep)


class _Provider(NamedTuple):
    increment: type[diffrax.AbstractBrownianIncrement]
    advice: str


# Random variables beyond `W`: which increments hold them, and how to ask for these. Those
# that hold more come first.
_PROVIDED_BY = {
    "C": _Provider(
        PlateauIncrement,
        "plateaus. Wrap a path with space-time Lévy area as `PlateauBrownianPath(path, "
        "key)`",
    ),
    "H": _Provider(
        diffrax.AbstractSpaceTimeLevyArea,
        "space-time Lévy area. Pass a path that has it, for example `diffrax."
        "VirtualBrownianTree(..., levy_area=diffrax.SpaceTimeLevyArea)`",
    ),
    "third": _Provider(
        WeakIncrement,
        "four-point variables and two more sets. Construct the path as "
        "`WeakBrownianPath(..., order=3)`",
    ),
    "second": _Provider(
        WeakIncrement,
        "a second set of three-point variables. Construct the path as "
        "`WeakBrownianPath(..., second=True)`",
    ),
}


def _variables(tableau: FlatTableau) -> list[str]:
    """The random variables that drive the stages."""
    channels = [c for stage in tableau.stages for c in stage.channels]
    return [c for c in dict.fromkeys(channels) if c != "h"]


def _controls(noise: tuple, names: list[str], t0, t1, solver: str) -> dict[str, list]:
    """The random variables of the step from `t0` to `t1`, for each noise term."""
    if names == ["W"]:
        return {"W": [term.contr(t0, t1) for term in noise]}
    increments = [term.contr(t0, t1, use_levy=True) for term in noise]
    # The most telling advice first.
    for name in sorted(names, key=lambda x: [*_PROVIDED_BY, x].index(x)):
        if any(getattr(increment, name, None) is None for increment in increments):
            provider = _PROVIDED_BY.get(name)
            advice = f"increments with the attribute `{name}`"
            raise ValueError(
                f"`{solver}` needs {provider.advice if provider else advice}."
            )
    return {name: [getattr(i, name) for i in increments] for name in names}


class _Evaluate:
    """The value of a stage at a point: vector fields times controls, over one step."""

    def __init__(self, drift, noise, variables, t0, t1, args, solver):
        self.t0, self.h = t0, t1 - t0
        self.driven: dict[str, tuple[tuple, list, Args]] = {}
        self.driven["h"] = (drift, [x.contr(t0, t1) for x in drift], args)
        for name, controls in _controls(noise, variables, t0, t1, solver).items():
            self.driven[name] = (noise, controls, args)

    def __call__(self, stages: list[Stage], y: Y) -> _Value:
        first = stages[0]

        def value(c, y):
            t = self.t0 + c * self.h
            return _part(
                _sum([_apply(self.driven[name], t, y) for name in first.channels]),
                first.writes,
            )

        if len(stages) == 1:
            return value(first.c, y)
        # Under `vmap`, for code and arrays of the size of one evaluation, not of many.
        c = [stage.c for stage in stages]
        if len(set(c)) == 1:
            return jax.vmap(value, in_axes=(None, 0))(c[0], y)
        return jax.vmap(value)(jnp.asarray(c, jnp.result_type(self.h)), y)


# Called at several stages, this is traced and lowered once.
@eqx.filter_jit
def _apply(driven: tuple[tuple, list, Args], t: RealScalarLike, y: Y) -> Y:
    """The sum over terms of vector field times control."""
    terms, controls, args = driven
    values = [x.vf_prod(t, y, args, c) for x, c in zip(terms, controls)]
    total = _sum(values)
    _check_value(total, y)
    return total


def _sum(values: list[Y]) -> Y:
    return ft.reduce(lambda a, b: (a**ω + b**ω).ω, values)


def _split(terms: diffrax.AbstractTerm) -> tuple[tuple, tuple]:
    """Drift terms and noise terms."""
    if isinstance(terms, diffrax.MultiTerm):
        return terms.terms[:1], terms.terms[1:]
    is_path = lambda x: isinstance(x, diffrax.AbstractBrownianPath)
    if any(map(is_path, jtu.tree_leaves(terms, is_leaf=is_path))):
        return (), (terms,)
    return (terms,), ()


def _part(y: Y, part: str) -> PyTree[Array]:
    return y if part == "y" else y["pq".index(part)]


def _position(
    y0: Y, stages: tuple[Stage, ...], rows: np.ndarray, values: dict[int, _Value]
) -> Y:
    """`y0 + sum_i rows[:, i] values[i]`, over the values there are. Stacked, unless it is
    only one row."""

    def scaled(i: int) -> PyTree[Array]:
        column = rows[:, i]
        if len(column) == 1:
            weight = float(column[0])
            return values[i] if weight == 1 else (weight * values[i] ** ω).ω
        return jtu.tree_map(
            lambda v: column.astype(v.dtype).reshape(-1, *[1] * v.ndim) * v, values[i]
        )

    def add(part: str) -> PyTree[Array]:
        base = _part(y0, part)
        total = None
        for i in values:
            if rows[:, i].any() and stages[i].writes == part:
                total = scaled(i) if total is None else (total**ω + scaled(i) ** ω).ω
        if total is None:
            stack = lambda x: jnp.broadcast_to(x, (len(rows), *jnp.shape(x)))
            return base if len(rows) == 1 else jtu.tree_map(stack, base)
        # The small terms first: fewer roundings of the size of the state.
        return (base**ω + total**ω).ω

    return add("y") if stages[0].writes == "y" else (add("p"), add("q"))


def _all_finite(y: Y) -> Bool[Array, ""]:
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(y)]))


def _check_state(y0: Y, solver: str) -> None:
    leaves = jtu.tree_leaves(y0)
    if len(leaves) == 0:
        raise ValueError(f"`{solver}` needs a state with at least one array in it.")
    for leaf in leaves:
        dtype = jnp.result_type(leaf)
        if not jnp.issubdtype(dtype, jnp.floating):
            raise ValueError(
                f"`{solver}` needs a state `y0` of real floating-point arrays; got an "
                f"array of dtype {dtype}. Convert it with `.astype(float)`; split a "
                "complex one into real and imaginary parts."
            )
    if len({jnp.result_type(leaf) for leaf in leaves}) > 1:
        raise ValueError(
            f"`{solver}` needs all arrays of `y0` in one dtype; got "
            f"{sorted({str(jnp.result_type(leaf)) for leaf in leaves})}."
        )


def _check_value(value: _Value, y: PyTree[Array]) -> None:
    def check(v, x):
        if jnp.result_type(v) != jnp.result_type(x) or jnp.shape(v) != jnp.shape(x):
            raise ValueError(
                "The terms change an array of dtype and shape "
                f"{jnp.result_type(x)}{jnp.shape(x)} by one of {jnp.result_type(v)}"
                f"{jnp.shape(v)}. Give the state, the vector fields and the path (as "
                "`shape=jax.ShapeDtypeStruct(shape, dtype)`) the same dtype, and time "
                "no wider one."
            )

    jtu.tree_map(check, value, y)


def number_of_noises(terms: diffrax.AbstractTerm) -> int:
    """How many scalar random variables drive the noise terms."""
    _, noise = _split(terms)
    struct = eqx.filter_eval_shape(lambda: [term.contr(0.0, 1.0) for term in noise])
    return sum(int(np.prod(s.shape)) for s in jtu.tree_leaves(struct))


def strong_order_if_commutative(terms: diffrax.AbstractTerm) -> float:
    """One noise commutes with itself; whether several do cannot be seen from here."""
    return 1.0 if number_of_noises(terms) <= 1 else 0.5
