"""Coefficients as data.

A tableau states a family's coefficients in the letters of the paper. Every tableau also
*flattens*: each evaluation of one vector field becomes one `Stage`, and the tableau
becomes one square matrix between stages and one vector of weights, whatever the family.
Symplecticity, liveness, the merging of equal stages and the order in which the implicit
systems are solved are then questions about that one matrix, answered once.
"""

from ._additive import AdditiveTableau as AdditiveTableau
from ._coefficients import real_parameter as real_parameter
from ._flat import (
    AbstractTableau as AbstractTableau,
    FlatTableau as FlatTableau,
    Stage as Stage,
)
from ._general import GeneralTableau as GeneralTableau
from ._separable import (
    PartitionedTableau as PartitionedTableau,
    SeparableTableau as SeparableTableau,
)
