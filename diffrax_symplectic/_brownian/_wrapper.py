from typing import TYPE_CHECKING

import diffrax
import jax
from jaxtyping import PyTree

from ._stepwise import AbstractStepwisePath


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


class AbstractWrappedPath(AbstractStepwisePath):
    """A Brownian path that changes the increments of another, or adds to them."""

    path: AbstractVar[diffrax.AbstractBrownianPath]

    @property
    def t0(self):
        return self.path.t0

    @property
    def t1(self):
        return self.path.t1


def increment_struct(
    path: diffrax.AbstractBrownianPath,
) -> PyTree[jax.ShapeDtypeStruct]:
    """Shapes, dtypes and structure of an increment."""
    return jax.eval_shape(lambda: path.evaluate(0.0, 1.0))


def require_space_time_area(path: diffrax.AbstractBrownianPath, wrapper: str) -> None:
    """Raises a `ValueError` unless the increments of `path` have space-time Lévy area."""
    area = getattr(path, "levy_area", type(None))
    if not issubclass(area, diffrax.AbstractSpaceTimeLevyArea):
        raise ValueError(
            f"`{wrapper}` needs a path with space-time Lévy area, for example "
            "`FixedStepBrownianPath(shape, key, diffrax.SpaceTimeLevyArea)`; got "
            f"{type(path).__name__} with {area.__name__}."
        )
