"""Which methods undo their own steps."""

import itertools

import numpy as np

from ._tableau import FlatTableau


# The step size and the random variables that change their sign if a step is undone.
_NEGATED = {"h", "W", "second", "two_point", "third", "A"}


def is_own_inverse(tableau: FlatTableau) -> bool:
    r"""Whether the step with all controls negated undoes the step: whether the stages can
    be paired, $i \leftrightarrow \sigma(i)$, such that

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
            # In a separable system what depends on p does not depend on time.
            and (this.reads == "p" or np.isclose(that.c, 1 - this.c))
            and np.isclose(b[i], b[j])
        ]

    for sigma in itertools.product(*map(partners, range(len(stages)))):
        paired = all(sigma[j] == i for i, j in enumerate(sigma))
        both = tableau.matrix + tableau.matrix[np.ix_(sigma, sigma)]
        # A stage does not depend on values that it does not read.
        wrong = np.where(tableau.reads, both - b, 0)
        if paired and np.allclose(wrong, 0, atol=1e-12):
            return True
    return False
