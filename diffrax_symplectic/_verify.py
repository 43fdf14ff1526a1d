"""Tests of a solver by one step, without Monte Carlo error."""

import itertools
from collections.abc import Callable
from typing import cast

import diffrax
import equinox as eqx
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from equinox.internal import ω
from jaxtyping import Array, Float, PyTree

from ._brownian import WeakBrownianPath, WeakIncrement
from ._custom_types import Args, RealScalarLike, Y
from ._hamiltonian import check_pair


def _one_step(terms, solver, t0, t1, y0, args) -> tuple[Y, diffrax.RESULTS]:
    solver_state = solver.init(terms, t0, t1, y0, args)
    y1, _, _, _, result = solver.step(
        terms, t0, t1, y0, args, solver_state, made_jump=False
    )
    return y1, result


def symplecticity_defect(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args = None,
) -> Float[Array, ""]:
    r"""How far one step is from symplectic: the largest entry of
    $|J^\top \Omega J - \Omega|$, where $J = \partial y_1 / \partial y_0$ is the Jacobian
    of the step at fixed random variables and
    $\Omega = \begin{pmatrix} 0 & I \\ -I & 0 \end{pmatrix}$.

    Exact up to rounding: a symplectic method with solved stage equations gives a small
    multiple of the machine epsilon, whatever the Hamiltonians, the step and the
    increment. Any other method gives the size of its violation. (The solvers here
    differentiate their stage equations implicitly, so that this is a statement on the
    method and not on the tolerance of its root finder.)

    Works under `jit` and `vmap`, and with any solver and terms of Diffrax.

    **Arguments:**

    - `terms`, `solver`, `y0`, `args`: as for `diffrax.diffeqsolve`, for a state
        `y0 = (p, q)`.
    - `t0`, `t1`: start and end of the step. The increments are those that the path in
        `terms` has over it.

    **Returns:** a scalar.

    **Raises:** a `ValueError` if `y0` is not a pair of the same structure and shapes; an
    error when run if the solver reports that the step failed.
    """
    check_pair(y0)
    flat, unravel = jfu.ravel_pytree(y0)

    def step(x):
        y1, result = _one_step(terms, solver, t0, t1, unravel(x), args)
        return jfu.ravel_pytree(y1)[0], result

    jacobian, result = jax.jacrev(step, has_aux=True)(flat)
    jacobian = result.error_if(jacobian, result != diffrax.RESULTS.successful)
    d = flat.size // 2
    zero, one = np.zeros((d, d)), np.eye(d)
    omega = jnp.asarray(np.block([[zero, one], [-one, zero]]), flat.dtype)
    dot = lambda a, b: jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)
    return jnp.max(jnp.abs(dot(jacobian.T, dot(omega, jacobian)) - omega))


def step_expectation(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args = None,
    *,
    fn: Callable[[Y], PyTree[Array]],
) -> PyTree[Array]:
    r"""The exact expectation $\mathbb E[\phi(y_1)]$ after one step from `y0`.

    The random variables of a [`diffrax_symplectic.WeakBrownianPath`][] take finitely
    many values, so that the expectation is a finite sum: $3^m$ outcomes for $m$ noises,
    $9^m$ with the second set of three-point variables, and $2^m$ times as many with the
    two-point ones.

    **Arguments:**

    - `terms`, `solver`, `y0`, `args`: as for `diffrax.diffeqsolve`; `terms` with one
        `WeakBrownianPath`.
    - `t0`, `t1`: start and end of the step.
    - `fn`: the function $\phi$ of the state, to arrays.

    **Returns:** what `fn` returns, averaged.

    **Raises:** a `ValueError` if `terms` does not hold exactly one `WeakBrownianPath`; an
    error when run if the solver reports that a step failed.
    """
    path = _weak_path(terms)
    increments, weights = _outcomes(path, t1 - t0)

    def outcome(increment):
        given = _FixedIncrement(increment)  # pyright: ignore[reportCallIssue]
        is_path = lambda x: isinstance(x, WeakBrownianPath)
        fixed = jtu.tree_map(
            lambda x: given if is_path(x) else x,
            terms,
            is_leaf=is_path,
        )
        y1, result = _one_step(fixed, solver, t0, t1, y0, args)
        return fn(y1), result

    values, result = jax.vmap(outcome)(increments)
    failed = jnp.any(result != diffrax.RESULTS.successful)
    values = eqx.error_if(
        values, failed, "A step failed: its stage equations could not be solved."
    )
    return jtu.tree_map(
        lambda v: jnp.tensordot(jnp.asarray(weights, v.dtype), v, axes=1), values
    )


def weak_order_defect(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args = None,
    *,
    fn: Callable[[Y], PyTree[Array]],
    order: int,
) -> PyTree[Array]:
    r"""The exact local weak error of one step,

    $$\mathbb E[\phi(y_1)] - \sum_{j=0}^{r} \frac{h^j}{j!} (L^j \phi)(y_0),$$

    with the generator $L$ of the equation. A method has weak order $r$ if this is
    $O(h^{r+1})$, so that a few values of $h$ show the order to two digits, without any
    sampling.

    $L \phi = \partial_t \phi + a \cdot \nabla \phi + \frac12 \sum_k b_k \cdot \nabla
    (b_k \cdot \nabla \phi)$ for a Stratonovich solver, and with $b_k^\top (\nabla^2
    \phi)\, b_k$ in place of the last term's summands for an Itô solver.

    **Arguments:** as for [`diffrax_symplectic.step_expectation`][], and

    - `order`: the number $r$. The cost of differentiating grows fast with it.

    **Returns:** what `fn` returns.

    **Raises:** as [`diffrax_symplectic.step_expectation`][].
    """
    expected = step_expectation(terms, solver, t0, t1, y0, args, fn=fn)
    L = _generator(terms, args, ito=isinstance(solver, diffrax.AbstractItoSolver))
    phi = lambda t, y: fn(y)
    h, factor = t1 - t0, 1.0
    defect = expected
    for j in range(order + 1):
        exact = phi(jnp.asarray(t0, jnp.result_type(float)), y0)
        defect = (defect**ω - factor * exact**ω).ω
        phi, factor = L(phi), factor * h / (j + 1)
    return defect


def _generator(terms, args, ito: bool) -> Callable:
    multi = cast(diffrax.MultiTerm, terms)
    drift, *noise = multi.terms

    def noise_fields(t):
        """Each `b_k`, as the response to a unit control."""
        fields = []
        for term in noise:
            struct = eqx.filter_eval_shape(term.contr, 0.0, 1.0)
            zero = jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), struct)
            flat, unravel = jfu.ravel_pytree(zero)
            for unit in np.eye(flat.size):
                control = unravel(jnp.asarray(unit, flat.dtype))
                fields.append(
                    lambda y, term=term, control=control: term.vf_prod(
                        t, y, args, control
                    )
                )
        return fields

    def L(phi):
        def L_phi(t, y):
            along_drift = (jnp.ones_like(t), drift.vf(t, y, args))
            _, total = jax.jvp(phi, (t, y), along_drift)
            for field in noise_fields(t):

                def derivative(y, direction):
                    return jax.jvp(lambda y: phi(t, y), (y,), (direction(y),))[1]

                frozen = field(y)
                moving = (lambda y: frozen) if ito else field
                _, second = jax.jvp(lambda y: derivative(y, moving), (y,), (frozen,))
                total = (total**ω + second**ω / 2).ω
            return total

        return L_phi

    return L


class _FixedIncrement(diffrax.AbstractBrownianPath):
    """The same, given increment over every step."""

    increment: WeakIncrement

    @property
    def t0(self):
        return -jnp.inf

    @property
    def t1(self):
        return jnp.inf

    @property
    def levy_area(self):
        return WeakIncrement

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        del t0, t1, left
        return self.increment if use_levy else self.increment.W


def _weak_path(terms) -> WeakBrownianPath:
    is_path = lambda x: isinstance(x, diffrax.AbstractBrownianPath)
    paths = [x for x in jtu.tree_leaves(terms, is_leaf=is_path) if is_path(x)]
    if len(paths) != 1 or not isinstance(paths[0], WeakBrownianPath):
        raise ValueError(
            "`terms` must hold exactly one Brownian path, a `WeakBrownianPath`, whose "
            f"outcomes can be enumerated; got {[type(p).__name__ for p in paths]}."
        )
    return paths[0]


def _outcomes(path: WeakBrownianPath, h) -> tuple[WeakIncrement, np.ndarray]:
    """Every value of the increments of one step, stacked, and its probability."""
    three = ((-np.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (np.sqrt(3.0), 1 / 6))
    two = ((-1.0, 1 / 2), (1.0, 1 / 2))
    struct = jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), path.shape)
    flat, unravel = jfu.ravel_pytree(struct)
    m = flat.size
    laws = [three] * m + [three] * (m * path.second) + [two] * (m * path.two_point)
    table = list(itertools.product(*laws))
    values = np.array([[v for v, _ in row] for row in table])
    weights = np.array([np.prod([w for _, w in row]) for row in table])
    scaled = jnp.sqrt(jnp.abs(h)) * values

    def pick(columns) -> PyTree[Array]:
        return jax.vmap(unravel)(columns.astype(flat.dtype))

    blocks = [pick(scaled[:, i : i + m]) for i in range(0, len(laws), m)]
    blocks += [None] * (3 - len(blocks))
    if path.two_point and not path.second:
        blocks = [blocks[0], None, blocks[1]]
    dt = jtu.tree_map(lambda s: jnp.full(len(table), h, s.dtype), path.shape)
    return WeakIncrement(dt, *blocks), weights
