"""Coefficients as data.

A tableau holds the coefficients of a family of methods in the notation of the paper. Every
tableau also *flattens*: each evaluation of one vector field becomes one `Stage`, and the
tableau becomes one square matrix between stages and one vector of weights, whatever the
family. Whether a method is symplectic, which stages are used, which are equal, and in which
order the implicit ones are solved for can then be read off that one matrix, by code that is
the same for all families.
"""

from ._families import AdditiveTableau as AdditiveTableau
from ._flat import (
    AbstractTableau as AbstractTableau,
    FlatTableau as FlatTableau,
    Stage as Stage,
    Structure as Structure,
)
from ._families import GeneralTableau as GeneralTableau
from ._families import (
    PartitionedTableau as PartitionedTableau,
    SeparableTableau as SeparableTableau,
)
