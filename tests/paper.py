"""The tableaus of Wang, Hong and Xu as they stand in the paper, with the stages and
parameters that no step depends on."""

import numpy as np

import diffrax_symplectic as ds


def srks2(d1: float = 0.5) -> ds.SeparableTableau:
    """The paper's tableau, where its other parameters have no weight. The first two noise
    stages read the same point, so that `d1` cancels."""
    A = np.array([[0, 0, 0], [0, 0, 0], [0, 0, 1 / 2]])
    return ds.SeparableTableau(
        alpha=[0, 0, 1],
        beta={"W": [0, 0, 1], "sqrt h": [d1, -d1, 0]},
        A0=A,
        B0={"W": A, "sqrt h": [[0, 0, 0], [0, 0, 0], [d1, -d1, 0]]},
        A1=A,
    )


def srks3(a: float, b1_plus_b2: float = 1.0) -> ds.SeparableTableau:
    """The paper's tableau. Both noise stages read the same point, so that the weights
    against the second variable, and with them `b1` and `b2`, cancel."""
    alpha = np.array([2 * a, 1 - 2 * a])
    return ds.SeparableTableau(
        alpha=alpha,
        beta={
            "W": [1 / 2, 1 / 2],
            "I_kk / sqrt h": np.array([1, -1]) / (2 * b1_plus_b2),
        },
        A0=[[a, 0], [2 * a, 1 / 2 - a]],
        B0=np.zeros((2, 2)),
        A1=[alpha, alpha],
    )


def srkw4(
    a21: float, a31: float = 0.0, a32: float = 0.0, b33: float = 0.0, b: float = 0.0
) -> ds.SeparableTableau:
    """The paper's tableau. A step depends on none of its parameters but `a21`: the third
    drift stage is unused, and the second and third noise stage are at the same point, so
    that `b` cancels."""
    return ds.SeparableTableau(
        alpha=[1 / 2, 1 / 2, 0],
        beta={"W": [1 / 2, 1 / 4 - b, 1 / 4 + b], "I_11 / sqrt h": [0, 1 / 2, -1 / 2]},
        A0=[[1 / 4, 1 / 2 - a21, 0], [a21, 1 / 4, 0], [a31, a32, 0]],
        B0={"W": [[1, 0, 0], [0, 0, 0], [1, 1, b33]]},
        A1=[[-1 / 2, 1 / 2, 0], [1 / 2, 1 / 2, 0], [1 / 2, 1 / 2, 0]],
    )


_r = np.sqrt(3.0)


def srkw2(
    rows: tuple[int, ...] = (1, 2, 3, 4),
    conjugate: bool = False,
    b1: float = 0.0,
    b2: float = 0.0,
    b3: float = 0.0,
) -> ds.GeneralTableau:
    """The paper's tableau, with its drift stages in any order. The third and fourth noise
    stage are unused: no result depends on them, nor on `b1`, `b2` and `b3`."""
    r = -_r if conjugate else _r
    B0 = np.array(
        [
            [5 / 6 - r / 3, -1 / 2, 0, 0],
            [-1 / 6 + r / 3, 1 / 2, 0, 0],
            [1 / 2, 1 / 2, 0, 0],
            [-1 / 6, 1 / 2, 0, 0],
        ]
    )
    A1 = np.array(
        [
            [-1 / 6 + r / 6, 1 / 3 - r / 6, 0, 1 / 3],
            [1 / 2, 0, 0, 0],
            [0, 0, 0, 0],
            [0, 0, 0, 0],
        ]
    )
    order = np.array(rows) - 1
    return ds.GeneralTableau(
        alpha=[1 / 4, 1 / 4, 1 / 4, 1 / 4],
        beta=[1 / 2, 1 / 2, 0, 0],
        A0=[
            [1 / 8, 0, 0, 0],
            [1 / 4, 1 / 8, 0, 0],
            [1 / 4, 1 / 4, 1 / 8, 0],
            [1 / 4, 1 / 4, 1 / 4, 1 / 8],
        ],
        B0=B0[order],
        A1=A1[:, order],
        B1=[
            [1 / 4, 1 / 4 - r / 6, 0, 0],
            [1 / 4 + r / 6, 1 / 4, 0, 0],
            [b1, b2, 0, b3],
            [0, -1 / 2, 0, 0],
        ],
    )
