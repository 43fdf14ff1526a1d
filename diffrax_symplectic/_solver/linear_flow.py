from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
from jaxtyping import Array, Bool, PyTree

from .._arguments import check_takes
from .._custom_types import Args, RealScalarLike, Y
from ._splitting import AbstractSplitting


def _checked(flow: Any) -> Any:
    check_takes("flow", flow, "time", "y", "args")
    return flow


class LinearFlow(AbstractSplitting):
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

    choose: ClassVar[str] = (
        "Fast linear waves on lattices and bonds of molecules, which it moves exactly."
    )

    def prepare(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        time: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> Any:
        """A zero that every step reads: reading it raises the error of a flow that is not
        symplectic."""
        del terms
        time = jnp.asarray(time)
        flow = lambda y: self.exact_flow(0, time, y, args)
        return eqx.error_if(jnp.zeros_like(time), ~_is_symplectic(flow, y0), _MESSAGE)

    def exact_flow(self, prepared: Any, time: RealScalarLike, y: Y, args: Args) -> Y:
        y1 = self.flow(time + prepared, y, args)
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
