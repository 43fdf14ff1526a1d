"""What a tableau promises, as residuals that vanish when it keeps the promise."""

import numpy as np
from jaxtyping import Float

from ._tableau import AbstractTableau, GeneralTableau


def symplectic_residuals(tableau: AbstractTableau) -> Float[np.ndarray, "s s"]:
    r"""Residuals of the conditions under which a method is symplectic.

    With all stages of the tableau in one list, `matrix` $M$ and `weights` $w$ of its
    flat form, these are $w_i w_j - w_i M_{ij} - w_j M_{ji}$ for every two stages that
    depend on each other's values. For a [`diffrax_symplectic.GeneralTableau`][] that is

    $$\alpha_i \alpha_j - \alpha_i A^0_{ij} - \alpha_j A^0_{ji}, \qquad
      \alpha_i \beta_j - \alpha_i B^0_{ij} - \beta_j A^1_{ji}, \qquad
      \beta_i \beta_j - \beta_i B^1_{ij} - \beta_j B^1_{ji}.$$

    **Arguments:**

    - `tableau`: any tableau of this package.

    **Returns:** a matrix over all pairs of stages, in the order of
    `tableau.flatten().stages`; zero where there is no condition.

    ??? cite "Reference"

        Theorems 2.1, 2.2, 3.1 and 4.1 of Wang, Hong and Xu (2017), Commun. Comput.
        Phys. 21, 237-270.
    """
    flat = tableau.flatten()
    reads = np.array([[b.writes in a.reads for b in flat.stages] for a in flat.stages])
    weighted = flat.weights[:, None] * flat.matrix
    residuals = np.outer(flat.weights, flat.weights) - weighted - weighted.T
    return np.where(reads & reads.T, residuals, 0.0)


def weak_order_residuals(tableau: GeneralTableau, order: int) -> dict[str, float]:
    r"""Residuals of the conditions for weak order 1 or 2 of a Stratonovich method with
    three-point increments: weak order 1 for any number of noises, weak order 2 for one.

    **Arguments:**

    - `tableau`: a [`diffrax_symplectic.GeneralTableau`][].
    - `order`: 1 or 2.

    **Returns:** the residual of each condition, by its formula. The conditions for order
    2 contain those for order 1.

    **Raises:** a `ValueError` for any other order.

    ??? cite "Reference"

        ```bibtex
        @article{rossler2007second,
            author = {Andreas R\"{o}\ss{}ler},
            title = {Second Order Runge--Kutta Methods for Stratonovich Stochastic
                     Differential Equations},
            journal = {BIT Numerical Mathematics},
            volume = {47},
            pages = {657--680},
            year = {2007},
            doi = {10.1007/s10543-007-0130-3},
        }
        ```
    """
    al, be = tableau.alpha, tableau.beta
    A0, A1, B0, B1 = tableau.A0, tableau.A1, tableau.B0, tableau.B1
    A0e, A1e, B0e, B1e = (x.sum(axis=1) for x in (A0, A1, B0, B1))
    first = {
        "alpha.e - 1": al.sum() - 1,
        "(beta.e)^2 - 1": be.sum() ** 2 - 1,
        "beta.B1e - 1/2": be @ B1e - 1 / 2,
    }
    second = {
        "alpha.A0e - 1/2": al @ A0e - 1 / 2,
        "beta.A1e - 1/2": be @ A1e - 1 / 2,
        "(beta.e)(alpha.B0e) - 1/2": be.sum() * (al @ B0e) - 1 / 2,
        "alpha.(B0e)^2 - 1/2": al @ B0e**2 - 1 / 2,
        "alpha.B0(B1e) - 1/4": al @ B0 @ B1e - 1 / 4,
        "beta.A1(B0e)": be @ A1 @ B0e,
        "beta.(B1e)^2 - 1/3": be @ B1e**2 - 1 / 3,
        "beta.B1(B1e) - 1/6": be @ B1 @ B1e - 1 / 6,
        "beta.(B1e)^3 - 1/4": be @ B1e**3 - 1 / 4,
        "beta.((B1e)(B1(B1e))) - 1/8": be @ (B1e * (B1 @ B1e)) - 1 / 8,
        "beta.B1((B1e)^2) - 1/12": be @ B1 @ B1e**2 - 1 / 12,
        "beta.B1(B1(B1e)) - 1/24": be @ B1 @ B1 @ B1e - 1 / 24,
        "beta.((A1e)(B1e)) - 1/4": be @ (A1e * B1e) - 1 / 4,
        "beta.B1(A1e) - 1/4": be @ B1 @ A1e - 1 / 4,
    }
    if order not in (1, 2):
        raise ValueError(f"`order` must be 1 or 2; got {order!r}.")
    conditions = first if order == 1 else first | second
    return {name: float(value) for name, value in conditions.items()}


def strong_order_residuals(tableau: GeneralTableau) -> dict[str, float]:
    r"""Residuals of the conditions for strong order 1/2 of a Stratonovich method with
    Gaussian increments. They also give strong order 1 for noises that commute, since
    every noise has the same coefficients.

    **Arguments:**

    - `tableau`: a [`diffrax_symplectic.GeneralTableau`][].

    **Returns:** the residual of each condition, by its formula.

    ??? cite "Reference"

        ```bibtex
        @article{burrage2000order,
            author = {Burrage, K. and Burrage, P. M.},
            title = {Order Conditions of Stochastic Runge--Kutta Methods by B-Series},
            journal = {SIAM Journal on Numerical Analysis},
            volume = {38},
            number = {5},
            pages = {1626--1646},
            year = {2000},
            doi = {10.1137/S0036142999363206},
        }
        ```
    """
    conditions = {
        "alpha.e - 1": tableau.alpha.sum() - 1,
        "beta.e - 1": tableau.beta.sum() - 1,
        "beta.B1e - 1/2": tableau.beta @ tableau.B1.sum(axis=1) - 1 / 2,
    }
    return {name: float(value) for name, value in conditions.items()}
