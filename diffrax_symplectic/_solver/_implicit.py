"""What solvers with implicit stages have in common."""

import diffrax
import equinox as eqx
import optimistix as optx

from .._root_finder import PicardNewton


class AbstractImplicitStages(diffrax.AbstractImplicitSolver):
    """A solver with implicit stages. It has the two fields that `diffrax` asks of implicit
    solvers: the root finder for the stage equations, and the most iterations it may take in
    each system of a step. Both are given by keyword, after the parameters of the method.
    """

    # `optimistix.root_find` takes either kind of solver.
    root_finder: optx.AbstractRootFinder | optx.AbstractLeastSquaresSolver = eqx.field(
        default=PicardNewton(), kw_only=True
    )
    root_find_max_steps: int = eqx.field(default=100, kw_only=True)


# The lines about these fields in the documentation of every such solver's `__init__`.
ROOT_FINDER = """\
- `root_finder`: any Optimistix root finder for the stage equations.
- `root_find_max_steps`: the most iterations it may take in each step.
"""
ARGUMENTS = f"""**Arguments:**

{ROOT_FINDER}"""
