"""Conditions on the coefficients of a tableau: symplecticity, orders, reversibility."""

import dataclasses
import functools as ft
import itertools
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
from jaxtyping import Float

from .._brownian import drives, VARIABLES
from .tableau import (
    AbstractTableau,
    AdditiveTableau,
    FlatTableau,
    GeneralTableau,
    PartitionedTableau,
    SeparableTableau,
)


# The largest residual of a condition that counts as zero. Coefficients such as those of the
# Gauss methods are rounded, and so are sums of their products. A wrong coefficient misses a
# condition by far more.
_ROUNDING = 1e-12


def symplectic_residuals(tableau: AbstractTableau) -> Float[np.ndarray, "s s"]:
    r"""Residuals of the conditions for a symplectic method.

    With $M$ and $w$ the `matrix` and `weights` of the flat tableau, these are
    $w_i w_j - w_i M_{ij} - w_j M_{ji}$ for all pairs of stages that depend on each other's
    values.

    **Arguments:**

    - `tableau`: any tableau of this package.

    **Returns:** a matrix over all pairs of stages, in the order of
    `tableau.flatten().stages`; zero where there is no condition.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    theorems 2.1, 2.2, 3.1 and 4.1.
    """
    flat = tableau.flatten()
    weighted = flat.weights[:, None] * flat.matrix
    # Quadratic invariants are conserved if the residuals vanish. A pair of stages adds to
    # the change of an invariant only if each reads what the other writes.
    residuals = np.outer(flat.weights, flat.weights) - weighted - weighted.T
    return np.where(flat.reads_from & flat.reads_from.T, residuals, 0.0)


def weak_order_residuals(tableau: AbstractTableau, order: int) -> dict[str, float]:
    r"""Residuals of the conditions for weak order 1 or 2.

    - For a [`diffrax_symplectic.GeneralTableau`][] with three-point increments: weak
        order 1 for any number of noises, weak order 2 for one.
    - For a [`diffrax_symplectic.PartitionedTableau`][] or
        [`diffrax_symplectic.SeparableTableau`][]: the conditions for Itô equations that
        apply if the noise changes only $p$ and does not depend on it.
    - For an [`diffrax_symplectic.AdditiveTableau`][]: any number of noises, with
        constant $b_k$ if the tableau is `constant`.

    **Arguments:**

    - `tableau`: one of these tableaus.
    - `order`: 1 or 2.

    **Returns:** a dictionary from the formula of each condition to its residual. Order 2
    includes the conditions for order 1.

    **Raises:** a `ValueError` for any other order, for other tableaus, for a
    `GeneralTableau` whose `noise` is not `"W"`, alone or with `"A"` or `"L"`, or for other
    tableaus with random variables of unknown variance: `"A"`, `"L"`, and names that no path
    of this package has.

    **Source:** [Rößler (2007)](https://doi.org/10.1007/s10543-007-0130-3) for Stratonovich
    equations, [Rößler (2009)](https://doi.org/10.1137/060673308) for Itô equations.
    """
    if order not in (1, 2):
        raise ValueError(f"`order` must be 1 or 2; got {order!r}.")
    first, second = _weak_conditions(tableau)
    residuals = first if order == 1 else first | second
    return {formula: float(residual) for formula, residual in residuals.items()}


def strong_order_residuals(tableau: AbstractTableau) -> dict[str, float]:
    r"""Residuals of the conditions for a strong order, with Gaussian increments:

    - 1/2 for a [`diffrax_symplectic.GeneralTableau`][]: all noises have the same
        coefficients, so the iterated integrals of two noises are missing. Strong order 1 if
        the noises commute, since then the integrals are not needed;
    - 1 for a [`diffrax_symplectic.SeparableTableau`][] or
        [`diffrax_symplectic.PartitionedTableau`][];
    - 3/2 for an [`diffrax_symplectic.AdditiveTableau`][], in the variables $I_k = W_k$
        and $I_{k0} / h = W_k / 2 + H_k$. The conditions on the times `c1` are included for
        a `constant` tableau, too, although noise that does not depend on time does not need
        them.

    **Arguments:**

    - `tableau`: one of these tableaus.

    **Returns:** a dictionary from the formula of each condition to its residual.

    **Raises:** a `ValueError` for other tableaus, for a `GeneralTableau` whose `noise` is
    not `"W"`, alone or with `"A"` or `"L"`, or for an `AdditiveTableau` with random
    variables of unknown variance: `"A"`, `"L"`, and names that no path of this package has.

    **Source:** [Burrage and Burrage (2000)](https://doi.org/10.1137/S0036142999363206) for
    general tableaus; [Rößler (2010)](https://doi.org/10.1137/09076636X) for the others.
    """
    residuals = _strong_conditions(tableau)
    return {formula: float(residual) for formula, residual in residuals.items()}


def drift_order(tableau: FlatTableau) -> int:
    """The order of the method without noise, as far as Butcher's conditions up to order 4
    show it."""
    # The vector fields of drift stages are multiplied by the step size `h` alone.
    drift_stages = [
        i for i, stage in enumerate(tableau.stages) if stage.channels == ("h",)
    ]
    flat = tableau.take(drift_stages)
    writes = np.array([stage.writes for stage in flat.stages])
    # Coefficients of values that a stage does not read have no effect.
    M = np.where(flat.reads_from, flat.matrix, 0.0)
    e = np.ones(len(drift_stages))
    c = M @ e
    # One row for each order, with a pair for each rooted tree: a vector, and the value that
    # its product with the weights must have (Hairer, Norsett and Wanner, Solving Ordinary
    # Differential Equations I, section II.2).
    conditions = (
        [(e, 1)],
        [(c, 1 / 2)],
        [(c**2, 1 / 3), (M @ c, 1 / 6)],
        [(c**3, 1 / 4), (c * (M @ c), 1 / 8), (M @ c**2, 1 / 12), (M @ M @ c, 1 / 24)],
    )
    # Row number k is for order k + 1. If one of its conditions fails, the order is k.
    for order_so_far, trees in enumerate(conditions):
        for (vector, exact), variable in itertools.product(trees, set(writes)):
            # Stages that write momenta `p` and stages that write positions `q` have
            # separate weights. The condition must hold for both. (In other tableaus all
            # stages write the whole state `y`.)
            is_written = writes == variable
            value = flat.weights[is_written] @ vector[is_written]
            if abs(value - exact) > _ROUNDING:
                return order_so_far
    return len(conditions)


def _unknown_tableau(tableau: AbstractTableau) -> NoReturn:
    raise ValueError(
        "The conditions are known for the tableaus of this package; got "
        f"`{type(tableau).__name__}`."
    )


# Both functions get a version for each family of tableaus below. `_strong_conditions`
# returns a dictionary from the formula of each condition to its residual.
# `_weak_conditions` returns two such dictionaries: the conditions for weak order 1, and
# those that weak order 2 needs in addition. In formulas `e` is the vector of ones, and
# products of vectors are taken entry by entry.
_strong_conditions: Any = ft.singledispatch(_unknown_tableau)
_weak_conditions: Any = ft.singledispatch(_unknown_tableau)


@_strong_conditions.register
def _strong_conditions_general(tableau: GeneralTableau) -> dict:
    _check_only_increment_drives_noise(tableau)
    return {
        "alpha.e - 1": tableau.alpha.sum() - 1,
        "beta.e - 1": tableau.beta.sum() - 1,
        "beta.B1e - 1/2": tableau.beta @ tableau.B1.sum(axis=1) - 1 / 2,
    }


@_strong_conditions.register
def _strong_conditions_separable(tableau: SeparableTableau) -> dict:
    # The random variables of the paper's tableaus other than `W` need not have mean zero:
    # one of them is `sqrt(h)`. So there is one more condition on the weights of each.
    vectors = {"A1e": tableau.A1.sum(axis=1)}
    others = _conditions_on_other_variables(tableau.beta, vectors)
    return _strong_conditions(tableau.partitioned()) | others


@_strong_conditions.register
def _strong_conditions_partitioned(tableau: PartitionedTableau) -> dict:
    return {
        "alpha.e - 1": tableau.alpha.sum() - 1,
        "alpha_hat.e - 1": tableau.alpha_hat.sum() - 1,
        "beta.e - 1": tableau.beta["W"].sum() - 1,
        **_conditions_on_other_variables(tableau.beta, {"e": np.ones(len(tableau.A1))}),
    }


@_strong_conditions.register
def _strong_conditions_additive(tableau: AdditiveTableau) -> dict:
    """The conditions for strong order 3/2."""
    # The strong expansion of the solution has the terms of the weak expansion up to order
    # 2, and also integrals that contain the space-time area `H`.
    for_order_1, for_order_2 = _weak_conditions(tableau)
    alpha = tableau.alpha
    c1 = tableau.c1
    # A tableau without `H` gets zeros, and fails the conditions on `H`.
    B_H = tableau.B.get("H", np.zeros((len(alpha), len(c1))))
    beta_H = tableau.beta.get("H", np.zeros(len(c1)))
    # The expansion has no other variables, so their contributions must vanish.
    others = {}
    for name, matrix in tableau.B.items():
        if name not in ("W", "H"):
            others[f"alpha.B[{name}]e"] = alpha @ matrix.sum(axis=1)
    for name, weights in tableau.beta.items():
        if name not in ("W", "H"):
            others[f"beta[{name}].c1"] = weights @ c1
    return {
        **for_order_1,
        **for_order_2,
        "alpha.B[H]e - 1": alpha @ B_H.sum(axis=1) - 1,
        "beta[W].c1 - 1/2": tableau.beta["W"] @ c1 - 1 / 2,
        "beta[H].c1 + 1": beta_H @ c1 + 1,
        **others,
    }


@_weak_conditions.register
def _weak_conditions_general(tableau: GeneralTableau) -> tuple[dict, dict]:
    """The conditions for weak order 1 hold for any number of noises, those for weak order 2
    for one noise."""
    _check_only_increment_drives_noise(tableau)
    # With short names the expressions below can be compared with their formulas.
    al = tableau.alpha
    be = tableau.beta
    A1 = tableau.A1
    B0 = tableau.B0
    B1 = tableau.B1
    A0e = tableau.A0.sum(axis=1)
    A1e = A1.sum(axis=1)
    B0e = B0.sum(axis=1)
    B1e = B1.sum(axis=1)
    # The random variable "L" multiplies brackets with the drift. It has the mean
    # E L_kl = h^2 delta_kl / 12, and [b, [b, a]] = a''bb + a'b'b - b''ba - 2 b'a'b + b'b'a.
    # So multiples of the number `L` enter the conditions on these five derivatives.
    has_brackets = "drift brackets" in map(drives, tableau.noise)
    L = be.sum() / 12 if has_brackets else 0.0
    first = {
        "alpha.e - 1": al.sum() - 1,
        "(beta.e)^2 - 1": be.sum() ** 2 - 1,
        "beta.B1e - 1/2": be @ B1e - 1 / 2,
    }
    second = {
        "alpha.A0e - 1/2": al @ A0e - 1 / 2,
        "beta.A1e - 1/2": be @ A1e - 1 / 2,
        "(beta.e)(alpha.B0e) - 1/2": be.sum() * (al @ B0e) - 1 / 2,
        "alpha.(B0e)^2 - 1/2": al @ B0e**2 - 1 / 2 + 2 * L,
        "alpha.B0(B1e) - 1/4": al @ B0 @ B1e - 1 / 4 + L,
        "beta.A1(B0e)": be @ A1 @ B0e - 2 * L,
        "beta.(B1e)^2 - 1/3": be @ B1e**2 - 1 / 3,
        "beta.B1(B1e) - 1/6": be @ B1 @ B1e - 1 / 6,
        "beta.(B1e)^3 - 1/4": be @ B1e**3 - 1 / 4,
        "beta.((B1e)(B1(B1e))) - 1/8": be @ (B1e * (B1 @ B1e)) - 1 / 8,
        "beta.B1((B1e)^2) - 1/12": be @ B1 @ B1e**2 - 1 / 12,
        "beta.B1(B1(B1e)) - 1/24": be @ B1 @ B1 @ B1e - 1 / 24,
        "beta.((A1e)(B1e)) - 1/4": be @ (A1e * B1e) - 1 / 4 - L,
        "beta.B1(A1e) - 1/4": be @ B1 @ A1e - 1 / 4 + L,
    }
    return first, second


@_weak_conditions.register
def _weak_conditions_partitioned(tableau: PartitionedTableau) -> tuple[dict, dict]:
    """The random variables are taken to be independent, with mean zero."""
    be = tableau.beta["W"]
    A1 = tableau.A1
    B0e = {name: B0.sum(axis=1) for name, B0 in tableau.B0.items()}
    first = {
        "alpha.e - 1": tableau.alpha.sum() - 1,
        "alpha_hat.e - 1": tableau.alpha_hat.sum() - 1,
        "(beta.e)^2 - 1": be.sum() ** 2 - 1,
        **_conditions_on_other_variables(tableau.beta, {"e": np.ones(len(A1))}),
    }
    # The mean of a product of two different variables vanishes. The mean of the square of a
    # variable is its variance.
    sum_of_squares = sum(
        _variance(name) * (tableau.alpha_hat @ row_sums**2)
        for name, row_sums in B0e.items()
    )
    sum_of_products = sum(
        _variance(name) * (tableau.beta[name] @ A1 @ row_sums)
        for name, row_sums in B0e.items()
        if name in tableau.beta
    )
    second = {
        "alpha.A_hat e - 1/2": tableau.alpha @ tableau.A_hat.sum(axis=1) - 1 / 2,
        "alpha_hat.Ae - 1/2": tableau.alpha_hat @ tableau.A.sum(axis=1) - 1 / 2,
        "(beta.e)(alpha_hat.B0e) - 1/2": be.sum() * (tableau.alpha_hat @ B0e["W"])
        - 1 / 2,
        "sum over variables: variance alpha_hat.(B0e)^2 - 1/2": sum_of_squares - 1 / 2,
        "(beta.e)(beta.A1e) - 1/2": be.sum() * (be @ A1.sum(axis=1)) - 1 / 2,
        "sum over variables: variance beta.A1(B0e)": sum_of_products,
    }
    return first, second


@_weak_conditions.register
def _weak_conditions_separable(tableau: SeparableTableau) -> tuple[dict, dict]:
    """Random variables other than `W` are taken to be functions of `W`, as in the paper
    (Wang, Hong and Xu 2017, equations (3.3)-(3.5)): for example `(W^2 - h) / (2 sqrt(h))`.
    """
    # The conditions of a `PartitionedTableau` with sums over the variables in `B0` are for
    # independent variables. So here they get `W` alone. The conditions on the weights of
    # the other variables, `beta[name].e`, stay.
    only_W = {"W": tableau.B0["W"]}
    partitioned = dataclasses.replace(tableau.partitioned(), B0=only_W)
    first, second = _weak_conditions(partitioned)
    # The noise is evaluated at positions `Q + h A1 g(p)`, with momenta `p` that depend on
    # `W`. In powers of `W` the terms of order 0, 1 and 2 have the coefficients below. The
    # product of a term with another variable may have a mean other than zero. So the
    # weights of the other variable must cancel the term.
    B0e = tableau.B0["W"].sum(axis=1)
    vectors = {
        "A1e": tableau.A1.sum(axis=1),
        "A1(B0e)": tableau.A1 @ B0e,
        "A1((B0e)^2)": tableau.A1 @ B0e**2,
    }
    return first, second | _conditions_on_other_variables(tableau.beta, vectors)


@_weak_conditions.register
def _weak_conditions_additive(tableau: AdditiveTableau) -> tuple[dict, dict]:
    """The conditions are for any number of noises. The random variables are taken to be
    independent, with mean zero."""
    alpha = tableau.alpha
    Be = {name: B.sum(axis=1) for name, B in tableau.B.items()}
    first = {"alpha.e - 1": alpha.sum() - 1}
    for name, weights in tableau.beta.items():
        # To first order the noise is constant in a step. So the end of the step contains
        # the increment `W` once, and every other variable not at all.
        exact = 1 if name == "W" else 0
        first[f"beta[{name}].e - {exact}"] = weights.sum() - exact
    sum_of_squares = sum(
        _variance(name) * (alpha @ row_sums**2) for name, row_sums in Be.items()
    )
    second = {
        "alpha.Ae - 1/2": alpha @ tableau.A.sum(axis=1) - 1 / 2,
        "alpha.B[W]e - 1/2": alpha @ Be["W"] - 1 / 2,
        "sum over variables: variance alpha.(Be)^2 - 1/2": sum_of_squares - 1 / 2,
    }
    # The times at which constant noise is evaluated do not matter.
    if not tableau.constant:
        second["beta[W].c1 - 1/2"] = tableau.beta["W"] @ tableau.c1 - 1 / 2
    return first, second


def _check_only_increment_drives_noise(tableau: GeneralTableau) -> None:
    """Raises a `ValueError` unless `W` is the only random variable that multiplies the
    vector fields of the noise. Other variables of the tableau may multiply brackets."""
    # All variables share the weights. So a second variable that multiplies the noise itself
    # would add to the increment, and change the moments from which the conditions follow.
    # Variables that multiply brackets are of higher order: the conditions include their
    # means.
    noise_itself = [name for name in tableau.noise if drives(name) == "noise"]
    if noise_itself != ["W"]:
        raise ValueError(
            "The conditions are known for general tableaus whose noise has the random "
            f'variable "W", alone or with "A" or "L"; got `noise={tableau.noise}`. To '
            "measure the order of any solver use `weak_order_defect`."
        )


def _conditions_on_other_variables(
    beta: Mapping[str, np.ndarray], vectors: Mapping[str, np.ndarray]
) -> dict:
    """Residuals of the conditions `beta[name].vector = 0`: for the weights `beta[name]` of
    each random variable other than `W`, and each of the `vectors`, whose keys are their
    formulas."""
    residuals = {}
    for name, weights in beta.items():
        if name == "W":
            continue
        for formula, vector in vectors.items():
            residuals[f"beta[{name}].{formula}"] = weights @ vector
    return residuals


# Random variables without a law of their own have no variance, and are left out.
_VARIANCES = {
    name: variable.variance
    for name, variable in VARIABLES.items()
    if variable.variance is not None
}


def _variance(name: str) -> float:
    """The variance of a random variable of a step, in units of the step's size."""
    # A tableau for a user's path may have variables that are not known here.
    if name not in _VARIANCES:
        raise ValueError(
            "The conditions are known for the random variables "
            f"{', '.join(_VARIANCES)}; got a tableau with `{name}`. To measure the order "
            "of any solver use `weak_order_defect`."
        )
    return _VARIANCES[name]


# The channels whose controls (the step size, or a random variable) change sign when a step
# is reversed.
_NEGATED_CHANNELS = {
    "h",
    *(name for name, variable in VARIABLES.items() if not variable.even),
}


def is_own_inverse(tableau: FlatTableau) -> bool:
    r"""Whether the method is reversible: the step with negated controls (step size and
    random variables) undoes the step. So it does if stages can be paired,
    $i \leftrightarrow \sigma(i)$, such that

    $$a_{ij} + a_{\sigma(i)\sigma(j)} = b_j, \qquad b_{\sigma(j)} = b_j, \qquad
      c_i + c_{\sigma(i)} = 1,$$

    with the matrix $a$, the weights $b$ and the times $c$ of the tableau. Then stage $i$ of
    the step is stage $\sigma(i)$ of the step back, at the same state and time.
    """
    channels = {name for stage in tableau.stages for name in stage.channels}
    # An even random variable keeps its sign if the path is reversed. With one of them, not
    # all controls of the step back are negated.
    if not channels <= _NEGATED_CHANNELS:
        return False

    def may_be_partners(i: int, j: int) -> bool:
        stage = tableau.stages[i]
        other = tableau.stages[j]
        # In a separable system, functions of p do not depend on time.
        times_fit = stage.reads == "p" or np.isclose(other.c, 1 - stage.c)
        has_same_weight = np.isclose(tableau.weights[i], tableau.weights[j])
        return other.kind == stage.kind and bool(times_fit and has_same_weight)

    # All choices of one possible partner for each stage are tried. There are few of them,
    # since few stages have more than one possible partner.
    numbers = range(len(tableau.stages))
    partners = [[j for j in numbers if may_be_partners(i, j)] for i in numbers]
    for sigma in itertools.product(*partners):
        # The partner of the partner of a stage is the stage.
        is_pairing = all(sigma[j] == i for i, j in enumerate(sigma))
        matrix_of_partners = tableau.matrix[np.ix_(sigma, sigma)]
        # Entry `i, j` is a_ij + a_sigma(i)sigma(j) - b_j.
        residuals = tableau.matrix + matrix_of_partners - tableau.weights
        # Coefficients of values that a stage does not read have no effect.
        residuals = np.where(tableau.reads_from, residuals, 0)
        if is_pairing and np.allclose(residuals, 0, atol=_ROUNDING):
            return True
    return False
