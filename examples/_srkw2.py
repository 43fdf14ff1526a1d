"""The 48 members of SRKw2: the conditions hold for any order of its drift stages, and for
either sign of the square root of 3. Wang, Hong and Xu print the first; the solver has
another, with a smaller error."""

from collections.abc import Sequence

import numpy as np

import diffrax_symplectic as ds


PAPER_ORDER = (1, 2, 3, 4)


def srkw2_tableau(rows: Sequence[int], conjugate: bool = False) -> ds.GeneralTableau:
    """The tableau with its drift stages in the order `rows`, and with the other sign of
    the root if `conjugate`."""
    r = -np.sqrt(3) if conjugate else np.sqrt(3)
    B0 = np.array(
        [
            [5 / 6 - r / 3, -1 / 2],
            [-1 / 6 + r / 3, 1 / 2],
            [1 / 2, 1 / 2],
            [-1 / 6, 1 / 2],
        ]
    )
    A1 = np.array([[-1 / 6 + r / 6, 1 / 3 - r / 6, 0, 1 / 3], [1 / 2, 0, 0, 0]])
    order = np.array(rows) - 1
    return ds.GeneralTableau(
        alpha=np.full(4, 1 / 4),
        beta=[1 / 2, 1 / 2],
        A0=np.eye(4) / 8 + np.tril(np.full((4, 4), 1 / 4), -1),
        B0=B0[order],
        A1=A1[:, order],
        B1=[[1 / 4, 1 / 4 - r / 6], [1 / 4 + r / 6, 1 / 4]],
    )


class PaperSRKw2(ds.AbstractSymplecticRungeKutta, ds.AbstractImplicitStages):
    """SRKw2 with the drift stages in the order of the paper."""

    tableau = srkw2_tableau(PAPER_ORDER)
