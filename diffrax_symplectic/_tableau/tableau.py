"""Coefficients as data, in the notation of the paper.

A tableau of any family flattens to one square matrix and one vector of weights for all its
stages, where each stage is one evaluation of a vector field. From these follow whether a
method is symplectic, which stages are unused or equal, and the order of their solution.
"""

import abc
import dataclasses
from collections.abc import Mapping
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float


# The Hamiltonians that coefficients apply to: any; `H0 = V(p) + U(t, q)` and `H_k = U_k(t,
# q)`; noise independent of the state; noise independent of state and time; the second and
# fourth together.
Structure: TypeAlias = Literal[
    "any", "separable", "additive", "constant", "separable and constant"
]


class Stage(NamedTuple):
    """One evaluation, `y -> sum over channels of (vector field times control)`.

    - `channels`: the controls that drive it: `"h"` for the drift; for noise the name of a
        random variable, which is an attribute of the Brownian increment.
    - `c`: the time of evaluation, as a fraction of the step.
    - `reads`: the part of the state it depends on, `"y"` (all), `"p"`, `"q"` or `""`.
    - `writes`: the part of the state it changes, `"y"`, `"p"` or `"q"`.
    """

    channels: tuple[str, ...]
    c: float
    reads: str
    writes: str

    @property
    def kind(self) -> tuple[tuple[str, ...], str, str]:
        """Stages of one kind evaluate the same vector field."""
        return self.channels, self.reads, self.writes


@dataclasses.dataclass(frozen=True, eq=False)
class FlatTableau:
    """Stage `i` is evaluated at `y0 + sum_j matrix[i, j] k_j`, with value `k_i`, and the
    step ends at `y0 + sum_i weights[i] k_i`."""

    stages: tuple[Stage, ...]
    matrix: Float[np.ndarray, "s s"]
    weights: Float[np.ndarray, " s"]

    @property
    def reads(self) -> Bool[np.ndarray, "s s"]:
        """Whether stage `i` reads a part of the state that stage `j` changes."""
        reads = [b.writes in a.reads for a in self.stages for b in self.stages]
        return np.array(reads, bool).reshape(self.matrix.shape)

    def take(self, keep: list[int]) -> "FlatTableau":
        """The tableau with only the stages `keep`."""
        return FlatTableau(
            stages=tuple(self.stages[i] for i in keep),
            matrix=self.matrix[np.ix_(keep, keep)],
            weights=self.weights[keep],
        )


class AbstractTableau(abc.ABC):
    """The base class of all tableaus.

    - `structure`: the structure of the Hamiltonians that the coefficients apply to:
        `"any"`, `"separable"`, `"additive"`, `"constant"` (additive and independent of
        time) or `"separable and constant"`. Every solve checks it while tracing.
    """

    structure: ClassVar[Structure]

    @abc.abstractmethod
    def flatten(self) -> FlatTableau:
        """All stages of the tableau, including unused ones, as one matrix."""


# Anything that NumPy converts to an array; after the checks a read-only float64 array.
Coefficients: TypeAlias = Any
# A dictionary from names of random variables to coefficients, or coefficients for "W".
CoefficientsByVariable: TypeAlias = Any


def _coefficients(name: str, value, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(value)
    if array.dtype.kind not in "iuf":
        raise ValueError(
            f"Coefficients `{name}` must be real numbers; got dtype {array.dtype}."
        )
    array = array.astype(np.float64)
    if array.shape != shape:
        raise ValueError(
            f"Coefficients `{name}` must have shape {shape}; got shape {array.shape}."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"Coefficients `{name}` must be finite; got {array}.")
    array.setflags(write=False)
    return array


def _check(
    tableau: AbstractTableau,
    by_variable: tuple[str, ...] = (),
    **shapes: tuple[int, ...],
) -> None:
    """Replaces coefficients by checked arrays, or dictionaries of them."""
    for name, shape in shapes.items():
        value = getattr(tableau, name)
        if name in by_variable:
            named = value if isinstance(value, Mapping) else {"W": value}
            checked = {
                k: _coefficients(f"{name}[{k!r}]", x, shape) for k, x in named.items()
            }
        else:
            checked = _coefficients(name, value, shape)
        object.__setattr__(tableau, name, checked)


def _side_by_side(
    *parts: tuple[Mapping[str, np.ndarray], tuple[int, ...]],
) -> tuple[list[str], list[np.ndarray]]:
    """The names of all random variables, in order of first appearance, and for each part
    its coefficients for all of them, concatenated. Parts are pairs of coefficients and
    their shape."""
    names = list(dict.fromkeys(name for part, _ in parts for name in part))
    return names, [
        np.concatenate([part.get(name, np.zeros(shape)) for name in names], axis=-1)
        for part, shape in parts
    ]


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
    `("W", "L")` for the vector field of [`diffrax_symplectic.PlateauGauss`][].

    **Raises:** a `ValueError` for other shapes, or numbers that are not real and finite.
    """

    structure: ClassVar[Structure] = "any"
    alpha: Coefficients
    beta: Coefficients
    A0: Coefficients
    B0: Coefficients
    A1: Coefficients
    B1: Coefficients
    noise: tuple[str, ...] = ("W",)

    def __post_init__(self):
        if isinstance(self.noise, str) or not all(
            isinstance(x, str) for x in self.noise
        ):
            raise ValueError(
                '`noise` must hold the names of random variables, as in `("W",)`; got '
                f"{self.noise!r}."
            )
        object.__setattr__(self, "noise", tuple(self.noise))
        s, r = np.size(self.alpha), np.size(self.beta)
        _check(self, alpha=(s,), beta=(r,), A0=(s, s), B0=(s, r), A1=(r, s), B1=(r, r))

    @classmethod
    def strong(cls, A, B, alpha, beta) -> "GeneralTableau":
        r"""The form of Burrage and Burrage (2000), equations (2.14)-(2.15) of Wang, Hong
        and Xu (2017), with drift and noise at the same points:

        $$G_i = y_n + h \sum_j A_{ij} a(G_j) + \sum_k \sum_j B_{ij} b_k(G_j) I_k$$

        **Arguments:** `A` and `B` of shape `(s, s)`, `alpha` and `beta` of shape `(s,)`.
        """
        return cls(alpha=alpha, beta=beta, A0=A, B0=B, A1=A, B1=B)

    def flatten(self) -> FlatTableau:
        stages = [Stage(("h",), float(c), "y", "y") for c in self.A0.sum(axis=1)]
        stages += [Stage(self.noise, float(c), "y", "y") for c in self.A1.sum(axis=1)]
        return FlatTableau(
            stages=tuple(stages),
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
    alpha: Coefficients
    beta: CoefficientsByVariable
    A0: Coefficients
    B0: CoefficientsByVariable
    A1: Coefficients

    def __post_init__(self):
        s, r = np.size(self.alpha), len(self.A1)
        noise = dict(beta=(r,), B0=(s, r))
        _check(self, ("beta", "B0"), alpha=(s,), A0=(s, s), A1=(r, s), **noise)

    def partitioned(self) -> "PartitionedTableau":
        """The same method, with explicit coefficients for the velocities."""
        alpha, A = self.alpha, self.A0
        return PartitionedTableau(alpha, alpha, self.beta, A, A, self.B0, self.A1)

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
    alpha: Coefficients
    alpha_hat: Coefficients
    beta: CoefficientsByVariable
    A: Coefficients
    A_hat: Coefficients
    B0: CoefficientsByVariable
    A1: Coefficients

    def __post_init__(self):
        s, v, r = np.size(self.alpha), np.size(self.alpha_hat), len(self.A1)
        drift = dict(alpha=(s,), alpha_hat=(v,), A=(v, s), A_hat=(s, v))
        _check(self, ("beta", "B0"), beta=(r,), B0=(v, r), A1=(r, v), **drift)

    def flatten(self) -> FlatTableau:
        s, v, r = len(self.alpha), len(self.alpha_hat), len(self.A1)
        names, (B0, beta) = _side_by_side((self.B0, (v, r)), (self.beta, (r,)))
        A1 = np.concatenate([self.A1] * len(names))
        # Forces come first, which makes them the unknowns, as they cost more to evaluate.
        stages = [Stage(("h",), float(c), "q", "p") for c in self.A_hat.sum(axis=1)]
        # Velocities do not depend on time.
        stages += [Stage(("h",), 0.0, "p", "q") for _ in range(v)]
        stages += [
            Stage((name,), float(c), "q", "p")
            for name in names
            for c in self.A1.sum(axis=1)
        ]
        zeros, n = np.zeros, len(A1)
        return FlatTableau(
            stages=tuple(stages),
            matrix=np.block(
                [
                    [zeros((s, s)), self.A_hat, zeros((s, n))],
                    [self.A, zeros((v, v)), B0],
                    [zeros((n, s)), A1, zeros((n, n))],
                ]
            ),
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

    alpha: Coefficients
    beta: CoefficientsByVariable
    A: Coefficients
    B: CoefficientsByVariable
    c1: Coefficients
    constant: bool = False

    def __post_init__(self):
        s, r = np.size(self.alpha), np.size(self.c1)
        noise = dict(beta=(r,), B=(s, r), c1=(r,))
        _check(self, ("beta", "B"), alpha=(s,), A=(s, s), **noise)

    @property
    def structure(self) -> Structure:
        return "constant" if self.constant else "additive"

    def flatten(self) -> FlatTableau:
        s, r = len(self.alpha), len(self.c1)
        names, (B, beta) = _side_by_side((self.B, (s, r)), (self.beta, (r,)))
        stages = [Stage(("h",), float(c), "y", "y") for c in self.A.sum(axis=1)]
        stages += [Stage((v,), float(c), "", "y") for v in names for c in self.c1]
        n = len(beta)
        return FlatTableau(
            stages=tuple(stages),
            matrix=np.block([[self.A, B], [np.zeros((n, s + n))]]),
            weights=np.concatenate([self.alpha, beta]),
        )
