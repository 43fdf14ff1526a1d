"""Where Gaussian increments have to be truncated, and how much of them that takes away."""

from collections.abc import Sequence

import diffrax
from jaxtyping import PyTree

from ..._brownian import TruncatedBrownianPath
from ..._compat import unwrapped
from ..._custom_types import Args, RealScalarLike, Y
from ..drift_and_noise import flattened
from ..langevin import BathNoise
from ..paths import brownian_paths, path_numbers, replace_paths
from .checks import additive_fault


def which_need_truncation(
    terms: PyTree[diffrax.AbstractTerm], t0: RealScalarLike, y0: Y, args: Args
) -> tuple[bool, ...]:
    """For each Brownian path of the terms, whether implicit steps need its increments
    bounded: whether noise that it drives depends on the state.

    Additive noise enters the equations of the stages as a constant. So does the noise of a
    bath for constant friction; for friction that depends on positions the equations see it
    through the positions alone, which a step of size h moves by its h-th part, and bounds
    would cool the bath."""
    noise = [term for term in flattened(terms) if len(brownian_paths(term)) > 0]
    needs = []
    for term in noise:
        is_bath = isinstance(unwrapped(term), BathNoise)
        depends = not is_bath and additive_fault((term,), t0, y0, args) is not None
        needs += [depends] * len(brownian_paths(term))
    # One Brownian motion in several places has one law.
    numbers = path_numbers(brownian_paths(terms))
    needy = {number for number, need in zip(numbers, needs) if need}
    return tuple(number in needy for number in numbers)


def without_truncation(
    terms: PyTree[diffrax.AbstractTerm], where: Sequence[bool] | None = None
) -> PyTree[diffrax.AbstractTerm]:
    """The terms with what is truncated in place of truncated paths: of all, or of those
    `where` it is wanted."""
    wanted = iter([True] * len(brownian_paths(terms)) if where is None else where)

    def new(path: diffrax.AbstractBrownianPath) -> diffrax.AbstractBrownianPath:
        is_cut = isinstance(path, TruncatedBrownianPath)
        return path.path if next(wanted) and is_cut else path

    return replace_paths(terms, new)
