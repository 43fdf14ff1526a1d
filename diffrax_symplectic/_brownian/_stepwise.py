"""Brownian paths that draw every step by itself, as a function of random words."""

import abc
import warnings
from collections.abc import Callable, Mapping
from typing import Any, cast, TYPE_CHECKING, TypeAlias

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, PRNGKeyArray, PyTree, UInt32

from .._compat import innermost_call, innermost_solve, nondifferentiable
from .._custom_types import RealScalarLike
from ._random import AbstractLaw, Gaussian, Place, random_words


if TYPE_CHECKING:
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


# What a step gets from its path, without and with all of its random variables.
Increment: TypeAlias = PyTree[Array] | diffrax.AbstractBrownianIncrement


class AbstractStepwisePath(diffrax.AbstractBrownianPath):
    """A path whose increment over a step is a function of random words of 32 bits, one for
    each scalar random variable. `evaluate` takes them from a generator. To put others in
    their place, such as those of a low-discrepancy set of points, call `increment`."""

    def evaluate(
        self,
        t0: RealScalarLike,
        t1: RealScalarLike | None = None,
        left: bool = True,
        use_levy: bool = False,
    ) -> Increment:
        """Implements [`diffrax.AbstractBrownianPath.evaluate`][].

        Returns the increment over the step from `t0` to `t1`, or with `use_levy=True` an
        object of type `levy_area`. Without `t1` the step is the one from `0` to `t0`.

        **Raises:** a `ValueError`, while tracing, inside a solve with an adaptive step
        size controller or `diffrax.HalfSolver`. Warns if `dt0` does not divide its time.
        """
        del left
        require_fixed_steps(self)
        start, end = (jnp.zeros_like(t0), t0) if t1 is None else (t0, t1)
        ends = jnp.asarray(start), jnp.asarray(end)
        start, end = cast(tuple[Array, Array], nondifferentiable(ends, name="t"))
        return _drawn(self, start, end, use_levy)

    @abc.abstractmethod
    def draw(self, t0: Array, t1: Array, use_levy: bool) -> Increment:
        """What `evaluate` returns for the step from `t0` to `t1`."""

    @property
    @abc.abstractmethod
    def laws(self) -> Mapping[str, AbstractLaw] | None:
        """The laws of the random variables of a step, all of them independent, by their
        name on the increment and for a step of size 1: over a step of size `h` they are
        `sqrt(h)` times as large. `None` if the increments are not made of such only."""

    @abc.abstractmethod
    def num_words(self, use_levy: bool = False) -> int:
        """How many words `increment` needs."""

    @abc.abstractmethod
    def increment(
        self,
        words: UInt32[Array, " num_words"],
        t0: RealScalarLike,
        t1: RealScalarLike,
        use_levy: bool = False,
    ) -> Increment:
        """What `evaluate` returns for the step from `t0` to `t1`, from given words."""


# Diffrax traces a step three times, and `jax.vmap` what is in a loop more often.
@eqx.filter_jit
def _drawn(path: AbstractStepwisePath, t0: Array, t1: Array, use_levy: bool):
    return path.draw(t0, t1, use_levy)


class AbstractPathWithLaws(AbstractStepwisePath):
    """A path whose steps are made of independent random variables with its `laws`, one
    from each law for each noise."""

    shape: AbstractVar[PyTree[jax.ShapeDtypeStruct]]
    key: AbstractVar[PRNGKeyArray]

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    @property
    @abc.abstractmethod
    def laws(self) -> Mapping[str, AbstractLaw]:
        """The law of the increment, `"W"`, comes first."""

    def _num_sets(self, use_levy: bool) -> int:
        return len(self.laws) if use_levy else 1

    def num_words(self, use_levy: bool = False) -> int:
        return self._num_sets(use_levy) * num_noises(self.shape)

    def words(self, place: Place, use_levy: bool) -> UInt32[Array, " num_words"]:
        """The path's own random words for a place on the axis of time."""
        sets, n = self._num_sets(use_levy), num_noises(self.shape)
        return random_words(self.key, place, sets, n).reshape(-1)

    def increment(
        self,
        words: UInt32[Array, " num_words"],
        t0: RealScalarLike,
        t1: RealScalarLike,
        use_levy: bool = False,
    ) -> Increment:
        n = num_noises(self.shape)
        sets = [words[i * n : (i + 1) * n] for i in range(len(self.laws))]
        draw = lambda law, words: draw_set(law, words, t1 - t0, self.shape)
        if not use_levy:
            return draw(self.laws["W"], sets[0])
        dt = jtu.tree_map(lambda s: jnp.asarray(t1 - t0, s.dtype), self.shape)
        drawn = {k: draw(law, x) for (k, law), x in zip(self.laws.items(), sets)}
        return cast(Any, self.levy_area)(dt=dt, **drawn)


def stepwise(path: diffrax.AbstractBrownianPath) -> AbstractStepwisePath:
    """`path` if its steps can be made from given words, otherwise a `ValueError`."""
    if not isinstance(path, AbstractStepwisePath):
        raise ValueError(
            "The random variables of this path cannot be chosen from outside. Use a "
            "`WeakBrownianPath`, or a `FixedStepBrownianPath` in place of Diffrax's "
            f"Gaussian paths; got `{type(path).__name__}`."
        )
    return path


def laws_of(path: diffrax.AbstractBrownianPath) -> Mapping[str, AbstractLaw] | None:
    """The laws of the random variables of a step, or `None` if they are unknown."""
    if isinstance(path, AbstractStepwisePath):
        return path.laws
    if isinstance(path, diffrax.UnsafeBrownianPath | diffrax.VirtualBrownianTree):
        return GAUSSIAN_LAWS.get(path.levy_area)
    return None


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
    # Times of this kind are those of a solve, for which it is not traced once more.
    time = jax.ShapeDtypeStruct((), jnp.result_type(float))
    return jax.eval_shape(lambda *ends: path.evaluate(*ends), time, time)


# The laws of Gaussian paths, by the type of their increments.
GAUSSIAN_LAWS: Mapping[type, Mapping[str, AbstractLaw]] = {
    diffrax.BrownianIncrement: {"W": Gaussian()},
    diffrax.SpaceTimeLevyArea: {"W": Gaussian(), "H": Gaussian(1 / 12)},
    diffrax.SpaceTimeTimeLevyArea: {
        "W": Gaussian(),
        "H": Gaussian(1 / 12),
        "K": Gaussian(1 / 720),
    },
}


def num_noises(shape: PyTree[jax.ShapeDtypeStruct]) -> int:
    return sum(leaf.size for leaf in jtu.tree_leaves(shape))


def draw_set(
    law: AbstractLaw,
    words: UInt32[Array, " n"],
    h: RealScalarLike,
    like: PyTree[jax.ShapeDtypeStruct | Array],
) -> PyTree[Array]:
    """A random variable for each noise, over a step of size `h`, in the structure, shapes
    and dtypes of `like`."""
    leaves, treedef = jtu.tree_flatten(like)
    ends = np.cumsum([leaf.size for leaf in leaves])
    root = jnp.sqrt(jnp.abs(h))
    out = [
        law.from_words(piece.reshape(leaf.shape), leaf.dtype) * root.astype(leaf.dtype)
        for piece, leaf in zip(jnp.split(words, ends[:-1]), leaves)
    ]
    return jtu.tree_unflatten(treedef, out)


def checked_shape(
    shape: tuple[int, ...] | PyTree[jax.ShapeDtypeStruct], path_name: str
) -> PyTree[jax.ShapeDtypeStruct]:
    """The shape of the increments of a path, of which a tuple of integers is short for
    one array. Raises a `ValueError` for what is no shape, or not of real numbers."""
    if isinstance(shape, tuple) and all(isinstance(n, int) for n in shape):
        shape = jax.ShapeDtypeStruct(shape, jnp.result_type(float))
    for leaf in jtu.tree_leaves(shape):
        if not isinstance(leaf, jax.ShapeDtypeStruct) or min(leaf.shape, default=0) < 0:
            raise ValueError(
                "`shape` must be a tuple of integers, `(m,)` for `m` noises, or a PyTree "
                "of `jax.ShapeDtypeStruct`s; got "
                f"{eqx.tree_pformat(shape, struct_as_array=True)}."
            )
        if not jnp.issubdtype(leaf.dtype, jnp.floating):
            raise ValueError(
                f"The dtypes of a `{path_name}` must be real floating-point; "
                f"got {leaf.dtype}."
            )
    return shape


def require_fixed_steps(path: diffrax.AbstractBrownianPath) -> None:
    """Raises a `ValueError` if the solve being traced may change its step size, as far as
    that can be known.

    Weak and truncated increments, whose law depends on the size of the step, are not the
    increments of one path. They cannot be refined. To accept or reject a step depending on
    them would change their law. Diffrax refuses its own `UnsafeBrownianPath` for this
    reason, by name, and tells a path nothing about the step size controller.

    The solvers of this package give no error estimate, and without one Diffrax refuses
    adaptive steps. For other solvers this function looks for the innermost solve on the
    Python stack. It does not find a solve if the increments were traced before, by a
    `jax.jit` of the user's around `evaluate`.
    """
    name = type(path).__name__
    tree = "use `diffrax.VirtualBrownianTree` as path"
    solve = innermost_solve()
    if solve is None or not _holds(solve.get("terms"), type(path)):
        return
    check_times(path)
    controller = solve.get("stepsize_controller")
    if isinstance(controller, diffrax.AbstractAdaptiveStepSizeController):
        # Diffrax refuses solvers without an error estimate, with any path.
        estimates = isinstance(solve.get("solver"), diffrax.AbstractAdaptiveSolver)
        raise ValueError(
            f"`{name}` cannot be used with the adaptive step size controller "
            f"`{type(controller).__name__}`: its increments belong to one step size and "
            "cannot be refined. Pass `stepsize_controller=diffrax.ConstantStepSize()` or "
            f"`diffrax.StepTo`{f', or {tree}' if estimates else ''}."
        )
    if isinstance(solve.get("solver"), diffrax.HalfSolver):
        raise ValueError(
            f"`{name}` cannot be used with `diffrax.HalfSolver`: the increments of the "
            "two half steps do not add up to the one of the whole step. Pass the wrapped "
            f"solver itself, or {tree}."
        )


def check_times(path: diffrax.AbstractBrownianPath | None = None) -> None:
    """Looks at the times of the solve being traced, where these are numbers. A `ValueError`
    for those that never end, and if they are no multiples of the path's `cell`, or `dt0`
    does not divide the interval; without cells that is a warning. (Steps of other
    controllers, and times that are traced, are checked when run.)"""
    call = innermost_call()
    if call is None:
        return
    times = t0, t1, dt0 = call["t0"], call["t1"], call["dt0"]
    cell, number = getattr(path, "cell", None), int | float | np.number
    numbers = all(isinstance(x, number) for x in times)
    for name, x in (("t0", t0), ("t1", t1), ("dt0", dt0)):
        known = isinstance(x, number)
        endless = known and np.isinf(x) and call.get("event") is None
        still = numbers and t0 != t1 and name == "dt0" and x == 0
        if np.ndim(x) > 0 or (known and np.isnan(x)) or endless or still:
            kind = "a finite number" + (", not zero" if name == "dt0" else "")
            raise ValueError(f"`{name}` of `diffeqsolve` must be {kind}; got {x}.")
    if path is None:
        return
    dtype = jnp.result_type(*[x for x in times if x is not None])
    if any(_narrowed(x, dtype) for x in jtu.tree_leaves(call["y0"])):
        warnings.warn(
            f"The times are {dtype}, which Diffrax makes the state, too: less precise than "
            "`y0`. Pass numbers of Python as `t0`, `t1` and `dt0`.",
            stacklevel=2,
        )
    if cell is not None:
        for name, time in dict(t0=t0, t1=t1, dt0=dt0).items():
            if isinstance(time, number) and not _divides(cell, time):
                raise ValueError(
                    f"Steps of a `{type(path).__name__}` with `cell` must begin and end at "
                    f"multiples of `cell`; got cell={cell} and {name}={time}. Pass a "
                    "`cell` that divides `t0`, `t1` and `dt0`."
                )
    if not numbers:
        return
    if 0 < abs(t1 - t0) < 0.999 * abs(dt0):
        warnings.warn(
            f"`dt0={dt0}` is longer than the time from {t0} to {t1}, which is one step "
            "then. Are `dt0` and `t1` exchanged?",
            stacklevel=2,
        )
        return
    if _divides(dt0, t1 - t0):
        return
    message = (
        f"`dt0={dt0}` does not divide the time from {t0} to {t1}: Diffrax takes steps of "
        "several sizes. For `n` equal steps pass `dt0=(t1 - t0) / n`."
    )
    if cell is not None:
        raise ValueError(f"{message} With `cell` all steps must have one size.")
    warnings.warn(message, stacklevel=2)


def _narrowed(x: Any, dtype: Any) -> bool:
    """Whether Diffrax makes `x` less precise, if times are of this dtype. So it does with
    numbers and what JAX made of them, such as `jnp.array(0.5)`."""
    own = jnp.result_type(x)
    if not jnp.issubdtype(own, jnp.floating):
        return False
    return jnp.finfo(jnp.result_type(x, dtype)).bits < jnp.finfo(own).bits


def _divides(part: float, whole: float) -> bool:
    with np.errstate(all="ignore"):  # What is not finite is refused elsewhere.
        count = np.divide(float(whole), float(part))
        return not np.abs(count - np.rint(count)) > 1e-3


def _holds(terms, kind: type) -> bool:
    """Whether a path of this kind drives the terms. A path may also be evaluated within a
    solve that it does not drive, whose steps it does not restrict."""
    is_path = lambda x: isinstance(x, kind)
    return any(map(is_path, jtu.tree_leaves(terms, is_leaf=is_path)))


class GivenPath(diffrax.AbstractBrownianPath):
    """A path whose increments come from elsewhere: that of the step from `t0` to `t1` is
    `make(t0, t1, use_levy)`."""

    make: Callable[[RealScalarLike, RealScalarLike | None, bool], Increment]
    levy_area: type = eqx.field(static=True)

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del left
        return self.make(t0, t1, use_levy)
