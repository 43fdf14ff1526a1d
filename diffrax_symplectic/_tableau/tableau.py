"""Coefficients as data, in the notation of the paper (Wang, Hong and Xu, 2017).

A tableau of any family flattens to one square matrix and one vector of weights for all its
stages, where each stage is one evaluation of a vector field. The flat tableau shows whether
a method is symplectic, which stages are unused or equal, and in which order to solve them.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float

from .._brownian import VARIABLES


# The Hamiltonians that coefficients apply to:
# - "any";
# - "separable": `H0 = V(p) + U(t, q)` and `H_k = U_k(t, q)`;
# - "additive": noise independent of the state;
# - "constant": noise independent of state and time;
# - "separable and constant": both.
Structure: TypeAlias = Literal[
    "any", "separable", "additive", "constant", "separable and constant"
]


class Stage(NamedTuple):
    """One evaluation, `y -> sum over channels of (vector field times control)`.

    - `channels`: the names of the controls that drive the stage: `"h"`, the step size, for
        the drift; for noise a random variable, an attribute of the Brownian increment.
    - `c`: the time of evaluation, as a fraction of the step.
    - `reads`: the part of the state that the stage depends on: `"y"` (all of it), `"p"`,
        `"q"` or `""` (none).
    - `writes`: the part of the state that the stage changes: `"y"`, `"p"` or `"q"`.
    """

    # Channels are names, not vector fields, so that a tableau can be made, compared and
    # tested before there are any terms.
    channels: tuple[str, ...]
    c: float
    reads: str
    writes: str

    @property
    def kind(self) -> tuple[tuple[str, ...], str, str]:
        """Stages of one kind evaluate the same vector field."""
        return self.channels, self.reads, self.writes


def _stages_at(
    times: np.ndarray, channels: tuple[str, ...], *, reads: str, writes: str
) -> list[Stage]:
    """One stage at each of the `times`, which are fractions of the step."""
    return [Stage(channels, float(c), reads, writes) for c in times]


# Compared by identity, here and in the classes below, since `==` of arrays is an array.
@dataclasses.dataclass(frozen=True, eq=False)
class FlatTableau:
    """All stages of a tableau, with one matrix and one vector of coefficients. Stage `i` is
    evaluated at `y0 + sum_j matrix[i, j] k_j`, where `k_j` is the value of stage `j`. The
    step ends at `y0 + sum_i weights[i] k_i`."""

    stages: tuple[Stage, ...]
    matrix: Float[np.ndarray, "s s"]
    weights: Float[np.ndarray, " s"]

    @property
    def reads_from(self) -> Bool[np.ndarray, "s s"]:
        """Entry `i, j` says whether stage `i` reads the part of the state that stage `j`
        writes."""
        # It suffices to compare names: in the tableaus below, either all stages write "y",
        # or each writes "p" or "q".
        reads = np.array([stage.reads for stage in self.stages])
        writes = np.array([stage.writes for stage in self.stages])
        return reads[:, None] == writes

    def take(self, numbers: list[int]) -> "FlatTableau":
        """The tableau with only the stages with these numbers, in this order."""
        return FlatTableau(
            stages=tuple(self.stages[i] for i in numbers),
            matrix=self.matrix[np.ix_(numbers, numbers)],
            weights=self.weights[numbers],
        )


# Anything that NumPy converts to an array; after the checks a read-only float64 array.
Coefficients: TypeAlias = Any
# A dictionary from names of random variables to coefficients, or coefficients for "W".
CoefficientsByVariable: TypeAlias = Any


def _checked_coefficients(
    name: str, value: Coefficients, shape: tuple[int, ...]
) -> Float[np.ndarray, "..."]:
    """`value` as a read-only array. Raises a `ValueError` unless it holds real, finite
    numbers in this shape."""
    array = np.asarray(value)
    # Strings and objects would fail later, with a message that does not name the
    # coefficients. Booleans are more likely a mistake than meant as zeros and ones.
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"Coefficients `{name}` must be real numbers; got dtype {array.dtype}."
        )
    # Coefficients always have double precision: plans compare coefficients, and must not
    # depend on the precision of a solve.
    array = array.astype(np.float64)
    if array.shape != shape:
        raise ValueError(
            f"Coefficients `{name}` must have shape {shape}; got shape {array.shape}."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"Coefficients `{name}` must be finite; got {array}.")
    # A tableau is usually a class variable, which all solves share.
    array.setflags(write=False)
    return array


class AbstractTableau(abc.ABC):
    """The base class of all tableaus.

    - `structure`: the structure of the Hamiltonians that the coefficients apply to:
        `"any"`, `"separable"`, `"additive"`, `"constant"` (additive and independent of
        time) or `"separable and constant"`. Every solve checks it while tracing.
    """

    structure: ClassVar[Structure]
    # The axes of each field of coefficients, one letter for each axis. Axes with the same
    # letter are over the same kind of stages, and have the same length.
    _axes: ClassVar[dict[str, str]] = {}
    # Fields that may hold a dictionary from names of random variables to coefficients.
    _by_variable: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self):
        """Replaces coefficients by checked, read-only arrays. Raises a `ValueError` for
        wrong shapes, or numbers that are not real and finite."""
        # First, the length that belongs to each letter. It is that of the first field that
        # cannot be a dictionary and whose first axis has the letter.
        lengths = {}
        for name, axes in self._axes.items():
            if name not in self._by_variable:
                # A number counts as one entry. Its shape is refused below.
                rows = np.atleast_1d(getattr(self, name))
                lengths.setdefault(axes[0], len(rows))
        # Second, all fields are checked against these lengths. A field by random variable
        # becomes a dictionary, if it is not one already.
        for name, axes in self._axes.items():
            shape = tuple(lengths[axis] for axis in axes)
            value = getattr(self, name)
            if name in self._by_variable:
                arrays = value if isinstance(value, Mapping) else {"W": value}
                checked = {}
                for variable, array in arrays.items():
                    label = f"{name}[{variable!r}]"
                    checked[variable] = _checked_coefficients(label, array, shape)
            else:
                checked = _checked_coefficients(name, value, shape)
            # A frozen dataclass refuses `self.name = checked`.
            object.__setattr__(self, name, checked)

    @abc.abstractmethod
    def flatten(self) -> FlatTableau:
        """All stages of the tableau, including unused ones, as one matrix."""


def _side_by_side(
    B: Mapping[str, np.ndarray], beta: Mapping[str, np.ndarray], shape: tuple[int, int]
) -> tuple[list[str], Float[np.ndarray, "s n"], Float[np.ndarray, " n"]]:
    """The coefficients of all random variables side by side. Returns

    - the names of the variables that have coefficients in `B` or in `beta`;
    - the matrices `B` of these variables, concatenated along the last axis;
    - the vectors `beta` of these variables, concatenated.

    A variable that is missing from `B` or `beta` has zeros there. `shape` is the shape of
    the matrix of one variable.
    """
    # A dictionary keeps the order of first appearance. The order of a set would differ from
    # run to run.
    variables = list(dict.fromkeys([*B, *beta]))
    all_B = [B.get(variable, np.zeros(shape)) for variable in variables]
    all_beta = [beta.get(variable, np.zeros(shape[1])) for variable in variables]
    return variables, np.concatenate(all_B, axis=1), np.concatenate(all_beta)


@dataclasses.dataclass(frozen=True, eq=False)
class GeneralTableau(AbstractTableau):
    r"""Coefficients for a Stratonovich system without further structure, with `s` drift
    and `r` noise stages.

    In the form of Rößler (2007), equations (2.6)-(2.7) of Wang, Hong and Xu (2017),

    $$G^0_i = y_n + h \sum_j A^0_{ij} a(t_n + c^0_j h, G^0_j)
      + \sum_l \sum_j B^0_{ij} b_l(t_n + c^1_j h, G^l_j) I_l$$

    $$G^k_i = y_n + h \sum_j A^1_{ij} a(t_n + c^0_j h, G^0_j)
      + \sum_j B^1_{ij} b_k(t_n + c^1_j h, G^k_j) I_k
      + \sum_{l \neq k} \sum_j B^3_{ij} b_l(t_n + c^1_j h, G^l_j) I_l$$

    $$y_{n+1} = y_n + h \sum_i \alpha_i a(t_n + c^0_i h, G^0_i)
      + \sum_k \sum_i \beta_i b_k(t_n + c^1_i h, G^k_i) I_k$$

    with stage times $c^0 = A^0 e$ and $c^1 = A^1 e$. Here $B^3 = B^1$: then the stages
    $G^k_i$ are the same vector for every $k$, for any number of noises, and the condition
    on $B^3$ follows from the one on $B^1$.

    **Arguments:** `alpha` of shape `(s,)`, `beta` of shape `(r,)`, `A0` of shape
    `(s, s)`, `B0` of shape `(s, r)`, `A1` of shape `(r, s)`, `B1` of shape `(r, r)`;
    `noise`, the random variables that drive the noise stages: `("W",)` for $I_k$,
    `("W", "A")` for the vector field of [`diffrax_symplectic.LevyAreaMidpoint`][], or
    `("W", "L")` for the vector field of [`diffrax_symplectic.PlateauGauss`][]. All names
    share one set of noise stages and weights: a stage evaluates the sum, over the names, of
    the vector fields that each multiplies. The conditions on orders are known with `"W"`
    alone, or `"W"` with variables that multiply brackets, `"A"` or `"L"`.

    **Raises:** a `ValueError` for other shapes, numbers that are not real and finite, or
    random variables that are not known.
    """

    structure: ClassVar[Structure] = "any"
    _axes: ClassVar[dict[str, str]] = dict(
        alpha="s", beta="r", A0="ss", B0="sr", A1="rs", B1="rr"
    )
    alpha: Coefficients
    beta: Coefficients
    A0: Coefficients
    B0: Coefficients
    A1: Coefficients
    B1: Coefficients
    noise: tuple[str, ...] = ("W",)

    def __post_init__(self):
        # A string is a sequence of strings. So `noise="W"` would pass the second test.
        is_string = isinstance(self.noise, str)
        if is_string or not all(isinstance(name, str) for name in self.noise):
            raise ValueError(
                '`noise` must hold the names of random variables, as in `("W",)`; got '
                f"{self.noise!r}."
            )
        unknown = [name for name in self.noise if name not in VARIABLES]
        if unknown:
            raise ValueError(
                f"`noise` must hold names among {', '.join(map(repr, VARIABLES))}; "
                f"got {', '.join(map(repr, unknown))}."
            )
        object.__setattr__(self, "noise", tuple(self.noise))
        super().__post_init__()

    @classmethod
    def strong(cls, A, B, alpha, beta) -> "GeneralTableau":
        r"""The form of Burrage and Burrage (2000), equations (2.14)-(2.15) of Wang, Hong
        and Xu (2017), with drift and noise at the same points:

        $$G_i = y_n + h \sum_j A_{ij} a(G_j) + \sum_k \sum_j B_{ij} b_k(G_j) I_k$$

        **Arguments:** `A` and `B` of shape `(s, s)`, `alpha` and `beta` of shape `(s,)`.
        """
        return cls(alpha=alpha, beta=beta, A0=A, B0=B, A1=A, B1=B)

    def flatten(self) -> FlatTableau:
        # Drift and noise have separate stages, since their numbers may differ. A plan
        # merges drift and noise stages again if their times and states are the same.
        drift = _stages_at(self.A0.sum(axis=1), ("h",), reads="y", writes="y")
        noise = _stages_at(self.A1.sum(axis=1), self.noise, reads="y", writes="y")
        return FlatTableau(
            stages=(*drift, *noise),
            matrix=np.block([[self.A0, self.B0], [self.A1, self.B1]]),
            weights=np.concatenate([self.alpha, self.beta]),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class SeparableTableau(AbstractTableau):
    r"""Coefficients for $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$, with `s` drift
    and `r` noise stages.

    With $f = -\partial U_0 / \partial q$, $g = \partial V / \partial p$ and
    $\sigma_k = -\partial U_k / \partial q$, equations (3.4)-(3.5) and (3.13)-(3.14) of
    Wang, Hong and Xu (2017) are

    $$p_i = P + h \sum_j A^0_{ij} f(t_n + c^0_j h, q_j)
      + \sum_k \sum_j B^0_{ij} \sigma_k(t_n + c^1_j h, \bar q_j) I_k$$

    $$q_i = Q + h \sum_j A^0_{ij} g(p_j), \qquad
      \bar q_i = Q + h \sum_j A^1_{ij} g(p_j)$$

    $$P_1 = P + h \sum_i \alpha_i f(t_n + c^0_i h, q_i)
      + \sum_k \sum_i \beta_i \sigma_k(t_n + c^1_i h, \bar q_i) I_k, \qquad
      Q_1 = Q + h \sum_i \alpha_i g(p_i)$$

    with stage times $c^0 = A^0 e$ and $c^1 = A^1 e$.

    **Arguments:** `alpha` of shape `(s,)`, `beta` of shape `(r,)`, `A0` of shape
    `(s, s)`, `B0` of shape `(s, r)`, `A1` of shape `(r, s)`. For several random variables,
    `beta` and `B0` are dictionaries from their names to such arrays, where `"W"` is $I_k$.

    **Raises:** a `ValueError` for other shapes, or numbers that are not real and finite.
    """

    structure: ClassVar[Structure] = "separable"
    _axes: ClassVar[dict[str, str]] = dict(
        alpha="s", beta="r", A0="ss", B0="sr", A1="rs"
    )
    _by_variable: ClassVar[tuple[str, ...]] = ("beta", "B0")
    alpha: Coefficients
    beta: CoefficientsByVariable
    A0: Coefficients
    B0: CoefficientsByVariable
    A1: Coefficients

    def partitioned(self) -> "PartitionedTableau":
        """The same method as a `PartitionedTableau`. Here the coefficients for velocities
        are equal to those for forces."""
        return PartitionedTableau(
            alpha=self.alpha,
            alpha_hat=self.alpha,
            beta=self.beta,
            A=self.A0,
            A_hat=self.A0,
            B0=self.B0,
            A1=self.A1,
        )

    def flatten(self) -> FlatTableau:
        return self.partitioned().flatten()


@dataclasses.dataclass(frozen=True, eq=False)
class PartitionedTableau(AbstractTableau):
    r"""Like [`diffrax_symplectic.SeparableTableau`][], but with coefficients $A$ and
    $\alpha$ for the forces $f$, and different ones, $\hat A$ and $\hat \alpha$, for the
    velocities $g$, as in explicit symplectic methods.

    $$p_i = P + h \sum_j A_{ij} f(t_n + \hat c_j h, q_j)
      + \sum_k \sum_j B^0_{ij} \sigma_k(t_n + c^1_j h, \bar q_j) I_k, \qquad
      q_i = Q + h \sum_j \hat A_{ij} g(p_j)$$

    with stage times $\hat c = \hat A e$ and $c^1 = A^1 e$. The other equations are as for
    `SeparableTableau`.

    **Arguments:** for `s` forces, `v` velocities and `r` noise stages: `alpha` of shape
    `(s,)`, `alpha_hat` of shape `(v,)`, `beta` of shape `(r,)`, `A` of shape `(v, s)`,
    `A_hat` of shape `(s, v)`, `B0` of shape `(v, r)`, `A1` of shape `(r, v)`; `beta` and
    `B0` may be dictionaries over random variables.

    **Raises:** a `ValueError` for other shapes, or numbers that are not real and finite.
    """

    structure: ClassVar[Structure] = "separable"
    _axes: ClassVar[dict[str, str]] = dict(
        alpha="s", alpha_hat="v", beta="r", A="vs", A_hat="sv", B0="vr", A1="rv"
    )
    _by_variable: ClassVar[tuple[str, ...]] = ("beta", "B0")
    alpha: Coefficients
    alpha_hat: Coefficients
    beta: CoefficientsByVariable
    A: Coefficients
    A_hat: Coefficients
    B0: CoefficientsByVariable
    A1: Coefficients

    def flatten(self) -> FlatTableau:
        num_velocities, num_forces = self.A.shape
        shape = (num_velocities, len(self.A1))
        variables, B0, beta = _side_by_side(self.B0, self.beta, shape)
        # Forces come first: of several choices for the stages to solve for, a plan takes
        # the first ones. Forces cost more to evaluate than velocities.
        forces = _stages_at(self.A_hat.sum(axis=1), ("h",), reads="q", writes="p")
        # Velocities do not depend on time. All have the same time, so that a plan can merge
        # velocities at equal momenta.
        velocities = _stages_at(np.zeros(num_velocities), ("h",), reads="p", writes="q")
        # Each random variable has noise stages of its own, all at the same times and
        # positions.
        noise = []
        noise_times = self.A1.sum(axis=1)
        for variable in variables:
            noise += _stages_at(noise_times, (variable,), reads="q", writes="p")
        stages = (*forces, *velocities, *noise)
        force_numbers = slice(0, num_forces)
        velocity_numbers = slice(num_forces, num_forces + num_velocities)
        noise_numbers = slice(num_forces + num_velocities, len(stages))
        matrix = np.zeros((len(stages), len(stages)))
        # Forces and noise are evaluated at positions, which depend on velocities.
        matrix[force_numbers, velocity_numbers] = self.A_hat
        matrix[noise_numbers, velocity_numbers] = np.tile(self.A1, (len(variables), 1))
        # Velocities are evaluated at momenta, which depend on forces and noise.
        matrix[velocity_numbers, force_numbers] = self.A
        matrix[velocity_numbers, noise_numbers] = B0
        return FlatTableau(
            stages=stages,
            matrix=matrix,
            weights=np.concatenate([self.alpha, self.alpha_hat, beta]),
        )


@dataclasses.dataclass(frozen=True, eq=False)
class AdditiveTableau(AbstractTableau):
    r"""Coefficients for noise that does not depend on the state, $b_k(t)$, with `s` drift
    stages and `r` times at which the noise is evaluated.

    With several random variables $\xi^\nu_k$ per step, equations (4.4)-(4.5) and
    (4.8)-(4.9) of Wang, Hong and Xu (2017) are

    $$G_i = y_n + h \sum_j A_{ij} a(t_n + c^0_j h, G_j)
      + \sum_\nu \sum_k \sum_j B^\nu_{ij} b_k(t_n + c^1_j h)\, \xi^\nu_k$$

    $$y_{n+1} = y_n + h \sum_i \alpha_i a(t_n + c^0_i h, G_i)
      + \sum_\nu \sum_k \sum_j \beta^\nu_j b_k(t_n + c^1_j h)\, \xi^\nu_k$$

    with stage times $c^0 = A e$. Symplecticity does not restrict $B$ and $\beta$.

    **Arguments:** `alpha` of shape `(s,)`, `A` of shape `(s, s)`, `c1` of shape `(r,)`;
    `beta` and `B`, arrays of shape `(r,)` and `(s, r)`, or dictionaries from names of
    random variables to such arrays, where `"W"` is $I_k$; `constant`, whether the noise
    must also be independent of time.

    **Raises:** a `ValueError` for other shapes, or numbers that are not real and finite.
    """

    _axes: ClassVar[dict[str, str]] = dict(alpha="s", beta="r", A="ss", B="sr", c1="r")
    _by_variable: ClassVar[tuple[str, ...]] = ("beta", "B")
    alpha: Coefficients
    beta: CoefficientsByVariable
    A: Coefficients
    B: CoefficientsByVariable
    c1: Coefficients
    constant: bool = False

    @property
    def structure(self) -> Structure:
        return "constant" if self.constant else "additive"

    def flatten(self) -> FlatTableau:
        shape = (len(self.alpha), len(self.c1))
        variables, B, beta = _side_by_side(self.B, self.beta, shape)
        drift = _stages_at(self.A.sum(axis=1), ("h",), reads="y", writes="y")
        # Noise stages read no part of the state. So they are evaluated once in a step, and
        # not in every iteration of the root finder.
        noise = []
        for variable in variables:
            noise += _stages_at(self.c1, (variable,), reads="", writes="y")
        # Noise stages depend on no other stage.
        noise_rows = np.zeros((len(noise), len(drift) + len(noise)))
        return FlatTableau(
            stages=(*drift, *noise),
            matrix=np.block([[self.A, B], [noise_rows]]),
            weights=np.concatenate([self.alpha, beta]),
        )
