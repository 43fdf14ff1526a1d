from typing import Any

import diffrax
import equinox as eqx
import jax.core
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, ArrayLike, PRNGKeyArray, PyTree

from .._compat import direction
from .._custom_types import Args, BoolScalarLike, DenseInfo, RealScalarLike, VF, Y
from .._hamiltonian import check_pair
from ._record import Want
from .base import AbstractSymplecticSolver


def _checked(gamma: PyTree) -> PyTree:
    """`gamma`, after a check of those of its values that are not traced."""
    for leaf in jtu.tree_leaves(gamma):
        if not eqx.is_array_like(leaf) or np.iscomplexobj(leaf):
            raise ValueError(
                "`gamma` must be a real number, an array or a PyTree of arrays; got "
                f"{leaf!r}."
            )
        if not isinstance(leaf, jax.core.Tracer):
            values = np.asarray(leaf)
            if not np.all(np.isfinite(values)) or np.any(values < 0):
                raise ValueError(
                    "`gamma` must be finite and not negative: it takes momentum away at "
                    f"this rate; got {leaf!r}."
                )
    return gamma


class Damped(
    diffrax.AbstractStratonovichSolver[Any], diffrax.AbstractWrappedSolver[Any]
):
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

    With noise in the forces and $\sigma^2 = 2 \gamma T$ this is Langevin dynamics at the
    temperature $T$.

    **Source:** splitting of [Strang (1968)](https://doi.org/10.1137/0705041).
    """

    solver: diffrax.AbstractSolver
    gamma: PyTree[ArrayLike] = eqx.field(converter=_checked)

    def __check_init__(self):
        if not isinstance(self.solver, AbstractSymplecticSolver):
            raise ValueError(
                "`Damped` wraps a solver of this package, such as `StormerVerlet()`; got "
                f"`{type(self.solver).__name__}`. Other solvers take friction as a term: "
                "`diffrax.MultiTerm(terms, diffrax.ODETerm(friction))`."
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
        order = self.solver.weak_order(terms)  # pyright: ignore
        return None if order is None else min(order, 2)

    def path(self, shape: Any, key: PRNGKeyArray, *, want: Want | None = None):
        """That of the solver."""
        return self.solver.path(shape, key, want=want)  # pyright: ignore

    def init(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: RealScalarLike,
        t1: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> Any:
        check_pair(y0)
        _factors(self.gamma, jnp.zeros_like(t0), y0[0])
        return self.solver.init(terms, t0, t1, y0, args)

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
        # In a solve backward in time the momentum grows. Diffrax makes `t1 - t0` positive.
        time = direction(terms) * (t1 - t0) / 2
        factors = _factors(self.gamma, time, y0[0])
        damp = lambda y: (jtu.tree_map(jnp.multiply, factors, y[0]), y[1])
        y1, error, _, solver_state, result = self.solver.step(
            terms, t0, t1, damp(y0), args, solver_state, made_jump
        )
        y1 = damp(y1)
        return y1, error, dict(y0=y0, y1=y1), solver_state, result

    def func(
        self,
        terms: PyTree[diffrax.AbstractTerm],
        t0: RealScalarLike,
        y0: Y,
        args: Args,
    ) -> VF:
        return self.solver.func(terms, t0, y0, args)


def _factors(
    gamma: PyTree[ArrayLike], time: RealScalarLike, p: PyTree[Array]
) -> PyTree:
    """`exp(-gamma time)`, for each array of `p`."""
    if jtu.treedef_is_leaf(jtu.tree_structure(gamma)):
        gamma = jtu.tree_map(lambda _: gamma, p)
    if jtu.tree_structure(gamma) != jtu.tree_structure(p):
        raise ValueError(
            "`gamma` must be one number or array, or have the structure of the momenta "
            f"{eqx.tree_pformat(p)}; got {eqx.tree_pformat(gamma)}."
        )

    def factor(g, x):
        shape = jnp.shape(g)
        if shape != () and shape != jnp.shape(x):
            raise ValueError(
                "An array of `gamma` must be a scalar or have the shape of its momenta, "
                f"{jnp.shape(x)}; got shape {shape}."
            )
        g = jnp.asarray(g, jnp.result_type(x))
        bad = ~jnp.all(jnp.isfinite(g) & (g >= 0))
        # Values that are traced cannot raise an error here. They make their path fail.
        return jnp.where(bad, jnp.nan, jnp.exp(-g * jnp.asarray(time, g.dtype)))

    return jtu.tree_map(factor, gamma, p)


Damped.__init__.__doc__ = """**Arguments:**

- `solver`: a solver of this package.
- `gamma`: the friction, in units of one over time: a number, or an array or PyTree like
    `p`, each array a scalar or of the shape of its momenta. If it is traced and negative or
    not finite, the path fails.

**Raises:** a `ValueError` if `gamma` is known to be negative or not finite, if it does not
    fit `p` (in the solve), or for a solver of another package.
"""
