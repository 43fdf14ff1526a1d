from typing import ClassVar

import diffrax
import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import ArrayLike, PyTree

from .._custom_types import Args, RealScalarLike, Y
from .._hamiltonian import is_hamiltonian, Lifted
from .._terms import split_terms
from ._friction import (
    apply_friction,
    checked,
    decay,
    friction_modes,
    GAMMA,
    matrix_faults,
    Modes,
)
from ._splitting import AbstractSplitting


class Damped(AbstractSplitting):
    r"""Any solver of this package with friction, $\mathrm{d}p = \ldots - \gamma p\,
    \mathrm{d}t$.

    $$p \gets e^{-\gamma h / 2} p, \qquad (p, q) \gets \text{a step of the solver}, \qquad
      p \gets e^{-\gamma h / 2} p$$

    The terms are those without friction, and keep their structure: separable solvers take
    them. The step of the solver covers the whole time of the step.

    For one constant $\gamma$ a step is conformally symplectic: with its Jacobian $S'$,
    $S'^\top J S' = e^{-\gamma h} J$. It is explicit if the solver is. Weak order the
    smaller of 2 and that of the solver; strong order the smaller of 1 and that of the
    solver; order 2 without noise.

    The friction acts on the canonical momentum $p$. In a magnetic field that is not the
    kinetic one: there friction on $p - A(q)$ is a term of its own.

    With noise in the forces and $\sigma^2 = 2 \gamma T$ this is Langevin dynamics at the
    temperature $T$. For constant noise [`diffrax_symplectic.BAOAB`][] has far less bias.

    **Source:** splitting of [Strang (1968)](https://doi.org/10.1137/0705041).
    """

    solver: diffrax.AbstractSolver
    gamma: PyTree[ArrayLike] = eqx.field(converter=checked)
    _faults: tuple[str | None, ...] = eqx.field(static=True, init=False, repr=False)

    def __post_init__(self):
        self._faults = matrix_faults(self.gamma)

    choose: ClassVar[str] = "Friction: collisions, damping, thermostats."
    advice: ClassVar[str] = (
        "Other solvers take friction as a term: `diffrax.MultiTerm(terms, "
        "diffrax.ODETerm(friction))`."
    )

    def prepare(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        time: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> list[Modes | None]:
        """The modes of the friction."""
        del time, args
        _check_has_momentum(terms)
        return friction_modes(self.gamma, self._faults, y0[0])

    def exact_flow(
        self, prepared: list[Modes | None], time: RealScalarLike, y: Y, args: Args
    ) -> Y:
        p, q = y
        return apply_friction(self.gamma, prepared, time, (decay, p)), q


def _check_has_momentum(terms: PyTree[diffrax.AbstractTerm]) -> None:
    """Raises a `ValueError` unless the first half of the state is a canonical momentum."""
    is_lifted = lambda x: isinstance(x, Lifted)
    if any(map(is_lifted, jtu.tree_leaves(terms, is_leaf=is_lifted))):
        raise ValueError(
            "`Damped` is friction on a canonical momentum. Half of the state of "
            "`spin_terms` or `wave_terms` is none: to damp it would make spins shorter. "
            "For damped spins pass `damping=` to `spin_terms`."
        )
    if not any(map(is_hamiltonian, split_terms(terms)[0])):
        raise ValueError(
            "`Damped` is friction on the momentum p of a state `(p, q)`, which plain terms "
            "(`ODETerm`, `ControlTerm`) do not tell from other states, such as (position, "
            "velocity). Construct the terms with `hamiltonian_terms`, or write the "
            "friction into the drift and take a solver without `Damped`."
        )


Damped.__init__.__doc__ = f"""**Arguments:**

- `solver`: a solver of this package.
- `gamma`: {GAMMA}

**Raises:** a `ValueError` if `gamma` is known to be negative, not finite or no such matrix,
    if it does not fit `p` (in the solve), or for a solver of another package.
"""
