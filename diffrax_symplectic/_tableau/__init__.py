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
