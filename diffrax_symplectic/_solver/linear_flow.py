from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .._arguments import check_takes
from .._compat import direction
from .._custom_types import Args, BoolScalarLike, DenseInfo, RealScalarLike, VF, Y
from .._hamiltonian import check_pair
from .base import AbstractSymplecticSolver
from .damped import Damped


def _checked(flow: Any) -> Any:
    check_takes("flow", flow, "time", "y", "args")
    return flow


class LinearFlow(
    diffrax.AbstractStratonovichSolver[Any], diffrax.AbstractWrappedSolver[Any]
):
    r"""Any solver of this package for $H_0 = L + R$, with the exact flow of $L$ around a
    step for the rest $R$.

    $$y \gets \varphi_L(\tfrac h2)\, y, \qquad y \gets \text{a step of the solver for } R
      \text{ and the noises}, \qquad y \gets \varphi_L(\tfrac h2)\, y$$

    It is for systems whose fast parts are linear, $L = \frac12 y \cdot A y$: waves on a
    lattice, the bonds of a molecule. Their frequencies then do not limit the step, and no
    mode is slowed down. The error is of the size of the commutators of $L$ with the rest.

    The terms are those of the rest, and of all noises. What is left is often simple. If
    $R$ and all $H_k$ depend on $q$ alone, `LinearFlow(StormerVerlet(), flow)` is explicit.

    Symplectic if the solver is. Weak order the smaller of 2 and that of the solver; strong
    order the smaller of 1 and that of the solver; order 2 without noise.

    !!! warning

        Where $\omega h$ of a mode is close to a multiple of $\pi$, the splitting is in
        resonance: a part of the rest that acts on this mode makes it grow, over a band of
        steps whose width is of the size of that part. Halve the step and see.

    **Source:** splitting of [Strang (1968)](https://doi.org/10.1137/0705041); impulse
    methods of [Grubmüller, Heller, Windemuth and Schulten
    (1991)](https://doi.org/10.1080/08927029108022142).
    """

    solver: diffrax.AbstractSolver
    flow: Callable[[RealScalarLike, Y, Args], Y] = eqx.field(converter=_checked)

    def __check_init__(self):
        if not isinstance(self.solver, AbstractSymplecticSolver | Damped):
            raise ValueError(
                "`LinearFlow` wraps a solver of this package, such as `StormerVerlet()`; "
                f"got `{type(self.solver).__name__}`."
            )

    @property
    def term_structure(self):
        return self.solver.term_structure

    @property
    def interpolation_cls(self):  # pyright: ignore
        return self.solver.interpolation_cls

    @property
    def term_compatible_contr_kwargs(self):  # pyright: ignore
        return self.solver.term_compatible_contr_kwargs

    @property
    def minimal_levy_area(self):
        return self.solver.minimal_levy_area  # pyright: ignore

    @property
    def root_finder(self):
        """That of the solver, if its stages are implicit."""
        return self.solver.root_finder  # pyright: ignore

    @property
    def root_find_max_steps(self) -> int:
        """That of the solver, if its stages are implicit."""
        return self.solver.root_find_max_steps  # pyright: ignore

    def order(self, terms):
        order = self.solver.order(terms)
        return None if order is None else min(order, 2)

    def strong_order(self, terms):
        order = self.solver.strong_order(terms)
        return None if order is None else min(order, 1.0)

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return min(self.solver.weak_order(terms), 2)  # pyright: ignore

    def init(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> Any:
        """The state of the solver, and a zero that every step reads: reading it raises the
        error of a flow that is not symplectic."""
        check_pair(y0)
        time = jnp.asarray(direction(terms) * (t1 - t0) / 2)
        flow = lambda y: self._flow(time, y, args)
        zero = eqx.error_if(jnp.zeros_like(time), ~_is_symplectic(flow, y0), _MESSAGE)
        return self.solver.init(terms, t0, t1, y0, args), zero

    def step(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
        solver_state: Any,
        made_jump: BoolScalarLike,
    ) -> tuple[Y, Y | None, DenseInfo, Any, diffrax.RESULTS]:
        del made_jump
        # Diffrax makes `t1 - t0` positive in a solve backward in time, too.
        inner, zero = solver_state
        time = direction(terms) * (t1 - t0) / 2 + zero
        y = self._flow(time, y0, args)
        # What the solver remembers is the end of its last step, and this one begins
        # elsewhere.
        y, error, _, inner, result = self.solver.step(
            terms, t0, t1, y, args, inner, True
        )
        y1 = self._flow(time, y, args)
        return y1, error, dict(y0=y0, y1=y1), (inner, zero), result

    def func(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> VF:
        return self.solver.func(terms, t0, y0, args)

    def _flow(self, time: RealScalarLike, y: Y, args: Args) -> Y:
        y1 = self.flow(time, y, args)
        shape = lambda x: jax.eval_shape(lambda: x)
        if not eqx.tree_equal(shape(y1), shape(y)):
            raise ValueError(
                "`flow(time, y, args)` must return a pair like the state, "
                f"{eqx.tree_pformat(y)}; got {eqx.tree_pformat(y1)}."
            )
        return y1


_MESSAGE = (
    "`flow` of `LinearFlow` is not symplectic: its derivative changes the form dp ^ dq. "
    "Pass the exact flow of a Hamiltonian, `flow(time, (p, q), args)`."
)


def _is_symplectic(flow: Callable[[Y], Y], y: Y) -> Bool[Array, ""]:
    """Whether the derivative of `flow` at `y` keeps the symplectic form of two random
    vectors."""
    flat, unravel = jfu.ravel_pytree(y)
    vectors = [unravel(jr.normal(jr.key(i), flat.shape, flat.dtype)) for i in (0, 1)]
    moved = [jax.jvp(flow, (y,), (v,))[1] for v in vectors]
    dot = lambda a, b: sum(map(jnp.vdot, jtu.tree_leaves(a), jtu.tree_leaves(b)))
    form = lambda a, b: dot(a[0], b[1]) - dot(a[1], b[0])
    size = jnp.sqrt(dot(moved[0], moved[0]) * dot(moved[1], moved[1]))
    defect = jnp.abs(form(*moved) - form(*vectors))
    # Rounding errors grow with the number of operations. What is wrong is wrong by far.
    return defect <= jnp.finfo(flat.dtype).eps ** 0.5 * size


LinearFlow.__init__.__doc__ = """**Arguments:**

- `solver`: a solver of this package.
- `flow`: `flow(time, y, args)`, the state after `time` (which may be negative) from the
    state `y` by the Hamiltonian that is split off, for `y = (p, q)`. Any function or
    Module: of Fourier transforms for a lattice, of eigenvectors made once for a molecule.

**Raises:** a `ValueError` if `flow` is no such function, for a solver of another package,
    and while the solve is traced if `flow` returns another structure or shape; an error
    when run if it is not symplectic at the start.
"""
