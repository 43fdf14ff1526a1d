"""Truncated Gaussian increments for implicit steps: which paths need them, and terms with
them.

The equations of an implicit step may have no solution for a large increment. So Gaussian
increments are truncated to a bounded range.
"""

from collections.abc import Sequence

import diffrax
import numpy as np
from jaxtyping import Float, PyTree

from ..._brownian import FixedStepBrownianPath, TruncatedBrownianPath
from ..._compat import unwrapped
from ..._custom_types import Args, RealScalarLike, Y
from ..._programs import once_for_each_signature
from ..drift_and_noise import flattened
from ..langevin import BathNoise
from ..paths import brownian_paths, motion_numbers, replace_paths
from .checks import additive_fault


def which_need_truncation(
    terms: PyTree[diffrax.AbstractTerm], t0: RealScalarLike, y0: Y, args: Args
) -> tuple[bool, ...]:
    """For each Brownian path of the terms, whether implicit steps need its increments
    truncated: whether a noise that it drives depends on the state.

    Additive noise enters the equations of the stages as a constant, of any size, and needs
    no truncation.

    The noise of a bath needs none either, and truncation would cool the bath. With constant
    friction the noise is additive. With friction that depends on positions, an increment
    acts on the friction only through the positions, which it changes with the small factor
    h, the step size."""
    noise = [term for term in flattened(terms) if len(brownian_paths(term)) > 0]
    # For each path, in the order of `brownian_paths(terms)`, whether its own term depends
    # on the state. All paths of a term get the same flag.
    depends_on_state = []
    for term in noise:
        is_bath = isinstance(unwrapped(term), BathNoise)
        depends = not is_bath and _depends_on_state(term, t0, y0, args)
        depends_on_state += [depends] * len(brownian_paths(term))
    # Equal paths are one Brownian motion. They are all truncated if any of them is.
    numbers = motion_numbers(brownian_paths(terms))
    flags = zip(numbers, depends_on_state)
    truncated_numbers = {number for number, depends in flags if depends}
    return tuple(number in truncated_numbers for number in numbers)


@once_for_each_signature
def _depends_on_state(
    term: diffrax.AbstractTerm, t0: RealScalarLike, y0: Y, args: Args
) -> bool:
    """Whether the vector field of a noise term depends on the state."""
    return additive_fault((term,), t0, y0, args) is not None


def with_truncation(
    terms: PyTree[diffrax.AbstractTerm],
    which: Sequence[bool],
    unit: Float[np.ndarray, ""] | None = None,
) -> PyTree[diffrax.AbstractTerm]:
    """The terms with a `TruncatedBrownianPath`, of this `unit` of time, in place of each
    `FixedStepBrownianPath` whose flag in `which` is true and that has no Lévy areas.
    `which` has a flag for each Brownian path of the terms, in order."""
    remaining_flags = iter(which)

    def new_path(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        is_wanted = next(remaining_flags)
        has_increments_alone = (
            isinstance(path, FixedStepBrownianPath)
            and path.levy_area is diffrax.BrownianIncrement
        )
        if is_wanted and has_increments_alone:
            return TruncatedBrownianPath(path, unit=unit)
        return path

    return replace_paths(terms, new_path)
