"""Tableaus: coefficients of Runge-Kutta methods as data, and what follows from them.

- `tableau`: the families of tableaus, and the flat form that all of them have.
- `conditions`: symplecticity, orders and reversibility, from the coefficients.
- `plan`: the plan of a step, which says what stages to solve for or evaluate, in order.
"""

from .conditions import (
    drift_order as drift_order,
    is_own_inverse as is_own_inverse,
    strong_order_residuals as strong_order_residuals,
    symplectic_residuals as symplectic_residuals,
    weak_order_residuals as weak_order_residuals,
)
from .plan import (
    Block as Block,
    Group as Group,
    make_plan as make_plan,
    StepPlan as StepPlan,
)
from .tableau import (
    AbstractTableau as AbstractTableau,
    AdditiveTableau as AdditiveTableau,
    FlatTableau as FlatTableau,
    GeneralTableau as GeneralTableau,
    PartitionedTableau as PartitionedTableau,
    SeparableTableau as SeparableTableau,
    Stage as Stage,
    Structure as Structure,
)
