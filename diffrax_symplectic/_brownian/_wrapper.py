import abc
from typing import TYPE_CHECKING

import diffrax
import jax
from jaxtyping import Array, PyTree, UInt32

from .._custom_types import RealScalarLike
from ._stepwise import AbstractStepwisePath, Increment, stepwise


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

    @abc.abstractmethod
    def num_own_words(self, use_levy: bool) -> int:
        """How many random words `changed` needs."""

    @abc.abstractmethod
    def changed(
        self,
        increment: Increment,
        own_words: UInt32[Array, " num_own_words"],
        h: RealScalarLike,
        use_levy: bool,
    ) -> Increment:
        """What this path makes of an increment of the other, over a step of size `h`."""

    def num_words(self, use_levy: bool = False) -> int:
        return stepwise(self.path).num_words(use_levy) + self.num_own_words(use_levy)

    def increment(
        self,
        words: UInt32[Array, " num_words"],
        t0: RealScalarLike,
        t1: RealScalarLike,
        use_levy: bool = False,
    ) -> Increment:
        path = stepwise(self.path)
        increment = path.increment(words, t0, t1, use_levy)
        own_words = words[path.num_words(use_levy) :]
        return self.changed(increment, own_words, t1 - t0, use_levy)


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
