"""Conditions on the coefficients of a tableau: symplecticity, orders, reversibility."""

import dataclasses
import functools as ft
import itertools
from collections.abc import Mapping

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
    residuals = np.outer(flat.weights, flat.weights) - weighted - weighted.T
    return np.where(flat.reads & flat.reads.T, residuals, 0.0)


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

    **Raises:** a `ValueError` for any other order, for other tableaus, or for random
    variables of unknown variance.

    **Source:** [Rößler (2007)](https://doi.org/10.1007/s10543-007-0130-3) for Stratonovich
    equations, [Rößler (2009)](https://doi.org/10.1137/060673308) for Itô equations.
    """
    if order not in (1, 2):
        raise ValueError(f"`order` must be 1 or 2; got {order!r}.")
    first, second = _weak(tableau)
    conditions = first if order == 1 else first | second
    return {name: float(value) for name, value in conditions.items()}


def strong_order_residuals(tableau: AbstractTableau) -> dict[str, float]:
    r"""Residuals of the conditions for a strong order, with Gaussian increments:

    - 1/2 for a [`diffrax_symplectic.GeneralTableau`][], and 1 if the noises commute,
        since every noise has the same coefficients;
    - 1 for a [`diffrax_symplectic.SeparableTableau`][] or
        [`diffrax_symplectic.PartitionedTableau`][];
    - 3/2 for an [`diffrax_symplectic.AdditiveTableau`][], in the variables $I_k = W_k$
        and $I_{k0} / h = W_k / 2 + H_k$.

    **Arguments:**

    - `tableau`: any tableau of this package.

    **Returns:** a dictionary from the formula of each condition to its residual.

    **Raises:** a `ValueError` for other tableaus, or random variables of unknown variance.

    **Source:** [Burrage and Burrage (2000)](https://doi.org/10.1137/S0036142999363206) for
    general tableaus; [Rößler (2010)](https://doi.org/10.1137/09076636X) for the others.
    """
    return {name: float(value) for name, value in _strong(tableau).items()}


def drift_order(tableau: FlatTableau) -> int:
    """The order without noise, up to 4, by Butcher's conditions for each part of the state
    that the stages write."""
    drift = [i for i, s in enumerate(tableau.stages) if s.channels == ("h",)]
    flat = tableau.take(drift)
    M = np.where(flat.reads, flat.matrix, 0.0)
    e, writes = np.ones(len(drift)), np.array([s.writes for s in flat.stages])
    c = M @ e
    conditions = (
        [(e, 1)],
        [(c, 1 / 2)],
        [(c**2, 1 / 3), (M @ c, 1 / 6)],
        [(c**3, 1 / 4), (c * (M @ c), 1 / 8), (M @ c**2, 1 / 12), (M @ M @ c, 1 / 24)],
    )
    for order, of_this_order in enumerate(conditions):
        for (x, exact), part in itertools.product(of_this_order, set(writes)):
            of = writes == part
            if abs(flat.weights[of] @ x[of] - exact) > 1e-12:
                return order
    return len(conditions)


@ft.singledispatch
def _strong(tableau: AbstractTableau) -> dict:
    """The conditions for the strong order of the tableau's family."""
    raise _unknown(tableau)


@_strong.register
def _(tableau: GeneralTableau) -> dict:
    return {
        "alpha.e - 1": tableau.alpha.sum() - 1,
        "beta.e - 1": tableau.beta.sum() - 1,
        "beta.B1e - 1/2": tableau.beta @ tableau.B1.sum(axis=1) - 1 / 2,
    }


@_strong.register
def _(tableau: SeparableTableau) -> dict:
    # The paper's other random variables are not independent of `W`.
    others = _others_vanish(tableau.beta, A1e=tableau.A1.sum(axis=1))
    return _strong(tableau.partitioned()) | others


@_strong.register
def _(tableau: PartitionedTableau) -> dict:
    return {
        "alpha.e - 1": tableau.alpha.sum() - 1,
        "alpha_hat.e - 1": tableau.alpha_hat.sum() - 1,
        "beta.e - 1": tableau.beta["W"].sum() - 1,
        **_others_vanish(tableau.beta, e=np.ones(len(tableau.A1))),
    }


@_strong.register
def _(tableau: AdditiveTableau) -> dict:
    first, second = _weak(tableau)
    al, c1 = tableau.alpha, tableau.c1
    B_H = tableau.B.get("H", np.zeros((len(al), len(c1))))
    beta_H = tableau.beta.get("H", np.zeros(len(c1)))
    return {
        **first,
        **second,
        "alpha.B[H]e - 1": al @ B_H.sum(axis=1) - 1,
        "beta[W].c1 - 1/2": tableau.beta["W"] @ c1 - 1 / 2,
        "beta[H].c1 + 1": beta_H @ c1 + 1,
    }


@ft.singledispatch
def _weak(tableau: AbstractTableau) -> tuple[dict, dict]:
    """The conditions for weak order 1, and the additional conditions for order 2."""
    raise _unknown(tableau)


@_weak.register
def _(tableau: GeneralTableau) -> tuple[dict, dict]:
    al, be = tableau.alpha, tableau.beta
    A0, A1, B0, B1 = tableau.A0, tableau.A1, tableau.B0, tableau.B1
    A0e, A1e, B0e, B1e = (x.sum(axis=1) for x in (A0, A1, B0, B1))
    # The expectation of the double brackets: E L_kl = h^2 delta_kl / 12 times
    # [b, [b, a]] = a''bb + a'b'b - b''ba - 2 b'a'b + b'b'a.
    brackets = "drift brackets" in map(drives, tableau.noise)
    L = be.sum() / 12 if brackets else 0.0
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


@_weak.register
def _(tableau: PartitionedTableau) -> tuple[dict, dict]:
    be, A1 = tableau.beta["W"], tableau.A1
    B0e = {name: B0.sum(axis=1) for name, B0 in tableau.B0.items()}
    first = {
        "alpha.e - 1": tableau.alpha.sum() - 1,
        "alpha_hat.e - 1": tableau.alpha_hat.sum() - 1,
        "(beta.e)^2 - 1": be.sum() ** 2 - 1,
        **_others_vanish(tableau.beta, e=np.ones(len(A1))),
    }
    squares = sum(_variance(v) * (tableau.alpha_hat @ x**2) for v, x in B0e.items())
    both = [v for v in B0e if v in tableau.beta]
    products = sum(_variance(v) * (tableau.beta[v] @ A1 @ B0e[v]) for v in both)
    second = {
        "alpha.A_hat e - 1/2": tableau.alpha @ tableau.A_hat.sum(axis=1) - 1 / 2,
        "alpha_hat.Ae - 1/2": tableau.alpha_hat @ tableau.A.sum(axis=1) - 1 / 2,
        "(beta.e)(alpha_hat.B0e) - 1/2": be.sum() * (tableau.alpha_hat @ B0e["W"])
        - 1 / 2,
        "sum over variables: variance alpha_hat.(B0e)^2 - 1/2": squares - 1 / 2,
        "(beta.e)(beta.A1e) - 1/2": be.sum() * (be @ A1.sum(axis=1)) - 1 / 2,
        "sum over variables: variance beta.A1(B0e)": products,
    }
    return first, second


@_weak.register
def _(tableau: SeparableTableau) -> tuple[dict, dict]:
    """With conditions on the paper's other random variables, which depend on `W`."""
    B0 = {"W": tableau.B0["W"]}
    partitioned = dataclasses.replace(tableau.partitioned(), B0=B0)
    first, second = _weak(partitioned)
    B0e = tableau.B0["W"].sum(axis=1)
    return first, second | {
        "beta.A1((B0e)^2)": tableau.beta["W"] @ tableau.A1 @ B0e**2,
        **_others_vanish(
            tableau.beta, A1e=tableau.A1.sum(axis=1), **{"A1(B0e)": tableau.A1 @ B0e}
        ),
    }


@_weak.register
def _(tableau: AdditiveTableau) -> tuple[dict, dict]:
    al, B = tableau.alpha, {k: v.sum(axis=1) for k, v in tableau.B.items()}
    first = {"alpha.e - 1": al.sum() - 1}
    for name, weights in tableau.beta.items():
        exact = 1 if name == "W" else 0
        first[f"beta[{name}].e - {exact}"] = weights.sum() - exact
    squares = sum(_variance(name) * (al @ Be**2) for name, Be in B.items())
    second = {
        "alpha.Ae - 1/2": al @ tableau.A.sum(axis=1) - 1 / 2,
        "alpha.B[W]e - 1/2": al @ B["W"] - 1 / 2,
        "sum over variables: variance alpha.(Be)^2 - 1/2": squares - 1 / 2,
    }
    if not tableau.constant:
        second["beta[W].c1 - 1/2"] = tableau.beta["W"] @ tableau.c1 - 1 / 2
    return first, second


def _others_vanish(beta: Mapping[str, np.ndarray], **moments: np.ndarray) -> dict:
    """The conditions that the moments of random variables other than `W` vanish."""
    return {
        f"beta[{name}].{label}": weights @ moment
        for name, weights in beta.items()
        if name != "W"
        for label, moment in moments.items()
    }


def _variance(name: str) -> float:
    """The variance of a random variable of a step, in units of the step's size."""
    variable = VARIABLES.get(name)
    if variable is None or variable.variance is None:
        known = [name for name, x in VARIABLES.items() if x.variance is not None]
        raise ValueError(
            f"The conditions are known for the random variables {', '.join(known)}; got a "
            f"tableau with `{name}`. To measure the order of any solver use "
            "`weak_order_defect`."
        )
    return variable.variance


def _unknown(tableau) -> ValueError:
    return ValueError(
        "The conditions are known for `GeneralTableau`, `SeparableTableau`, "
        f"`PartitionedTableau` and `AdditiveTableau`; got `{type(tableau).__name__}`."
    )


# The controls that change sign when a step is reversed.
_NEGATED = {"h", *(name for name, variable in VARIABLES.items() if not variable.even)}


def is_own_inverse(tableau: FlatTableau) -> bool:
    r"""Whether the method is reversible: the step with negated controls undoes the step.
    This holds if stages can be paired, $i \leftrightarrow \sigma(i)$, such that

    $$a_{ij} + a_{\sigma(i)\sigma(j)} = b_j, \qquad b_{\sigma(j)} = b_j, \qquad
      c_i + c_{\sigma(i)} = 1.$$
    """
    stages, b = tableau.stages, tableau.weights
    if not {c for stage in stages for c in stage.channels} <= _NEGATED:
        return False

    def partners(i: int) -> list[int]:
        this = stages[i]
        return [
            j
            for j, that in enumerate(stages)
            if (that.channels, that.reads, that.writes)
            == (this.channels, this.reads, this.writes)
            # In a separable system, functions of p do not depend on time.
            and (this.reads == "p" or np.isclose(that.c, 1 - this.c))
            and np.isclose(b[i], b[j])
        ]

    for sigma in itertools.product(*map(partners, range(len(stages)))):
        paired = all(sigma[j] == i for i, j in enumerate(sigma))
        both = tableau.matrix + tableau.matrix[np.ix_(sigma, sigma)]
        # Ignore coefficients of values that a stage does not read.
        wrong = np.where(tableau.reads, both - b, 0)
        if paired and np.allclose(wrong, 0, atol=1e-12):
            return True
    return False
