"""Exact checks of one step of a solver, without Monte Carlo errors."""

import functools as ft
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree

from ._arguments import check_pair, check_state
from ._compat import ω
from ._custom_types import Args, RealScalarLike, Y
from ._products import dot
from ._terms import (
    apply_one,
    as_spins,
    check_baths_have_own_noise,
    check_drifts_differ,
    check_unconstrained,
    constraint_of,
    from_spinors,
    number_of_noises,
    outcomes,
    rate,
    split_friction,
    split_terms,
    step_variables,
    Surface,
    to_spinors,
    with_programs,
)


def _one_step(terms, solver, t0, t1, y0, args) -> tuple[Y, diffrax.RESULTS]:
    """The state at the end of one step, and whether the step succeeded."""
    check_drifts_differ(terms)
    # From here on, the functions of the user are replaced by their traces, which do not
    # tell which functions they come from.
    terms = with_programs(terms, t0, y0, args)
    solver = with_programs(solver, t0, y0, args)
    # `diffrax.diffeqsolve` is not used: its loop takes longer to trace than the step.
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

    Exact up to rounding: for a symplectic method this is a small multiple of the machine
    epsilon, for any Hamiltonians, step and increments; for other methods it is not small.
    For constrained terms it is the largest entry of
    $Z^\top (J^\top \Omega J - \Omega) Z$, where the columns of $Z$ are an orthonormal basis
    of the directions along which allowed states can move.
    (The solvers of this package differentiate their stage equations implicitly, so it does
    not depend on the tolerance of the root finder.)

    Works under `jit` and `vmap`, and with any solver and terms of Diffrax.

    **Arguments:**

    - `terms`, `solver`, `y0`, `args`: as for `diffrax.diffeqsolve`, with a state
        `y0 = (p, q)`.
    - `t0`, `t1`: start and end of the step. The increments come from the path in `terms`.

    **Returns:** a scalar.

    **Raises:** a `ValueError` if `y0` is not a pair of the same structure and shapes, of
    floating-point numbers; an error when run if the solver reports a failed step.
    """
    check_pair(y0)
    check_state("symplecticity_defect", y0)
    flat, unravel = jfu.ravel_pytree(y0)

    def step(x: Array) -> tuple[Array, diffrax.RESULTS]:
        y1, result = _one_step(terms, solver, t0, t1, unravel(x), args)
        return jfu.ravel_pytree(y1)[0], result

    jacobian, result = jax.jacrev(step, has_aux=True)(flat)
    # A failed step has no Jacobian to be judged.
    jacobian = result.error_if(jacobian, result != diffrax.RESULTS.successful)
    # The first half of `flat` is p, the second q.
    half = flat.size // 2
    zero = np.zeros((half, half))
    identity = np.eye(half)
    omega = np.block([[zero, identity], [-identity, zero]])
    omega = jnp.asarray(omega, flat.dtype)
    # In full precision: rounded factors would look like a defect.
    defect = dot(jacobian.T, dot(omega, jacobian)) - omega
    if constraint_of(terms) is not None:
        # The columns of Z are an orthonormal basis of the allowed directions.
        Z = _allowed_directions(terms, t0, y0, args)
        defect = dot(Z.T, dot(defect, Z))
    return jnp.max(jnp.abs(defect))


def _allowed_directions(terms, t0, y0: Y, args: Args) -> Float[Array, "n k"]:
    """An orthonormal basis of the directions along which an allowed state can move, in
    columns. A state is allowed if constraint(q) = 0 and J v = 0, with the Jacobian J of the
    constraint and the velocities v. The allowed directions are orthogonal to the gradients
    of both equations."""
    surface = Surface.of(with_programs(terms, t0, y0, args), t0, y0, args)
    flat, _ = jfu.ravel_pytree(y0)

    def equations(x: Array) -> Array:
        """The left-hand sides of both equations, at the state `x`."""
        p, q = jnp.split(x, 2)
        residual, J_v = jax.jvp(surface.residual, (q,), (surface.velocity(p),))
        return jnp.concatenate([residual, J_v])

    # A singular value decomposition of the gradients, one in each row. The rows of V^T are
    # orthonormal. The first ones, as many as there are equations, span the gradients. The
    # others span the allowed directions.
    gradients = jax.jacrev(equations)(flat)
    _, _, V_transposed = jnp.linalg.svd(gradients, full_matrices=True)
    return V_transposed[len(gradients) :].T


def poisson_defect(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args = None,
) -> Float[Array, ""]:
    r"""How far one step of spins is from a Poisson map: the largest entry of
    $|J\, P(s_0)\, J^\top - P(s_1)|$, where $J = \partial s_1 / \partial s_0$ is the
    Jacobian of the step at fixed random variables and $P(s)\, v = s \times v$ for each
    spin, or of $\{s_i \circ S, s_j \circ S\} - \{s_i, s_j\} \circ S$ for the step $S$ and
    all pairs of components.

    Exact up to rounding. Works under `jit` and `vmap`, and with any solver and terms of
    Diffrax.

    **Arguments:** as for [`diffrax_symplectic.symplecticity_defect`][], except

    - `y0`: the state, `to_spinors(s0)` for the terms of
        [`diffrax_symplectic.spin_terms`][]; for terms in the spins themselves, their
        array `s0` of shape `(..., 3)`.

    **Returns:** a scalar.

    **Raises:** a `ValueError` if `y0` is neither; an error when run if a spin of the pair
    `y0` has length zero, or if the solver reports a failed step.
    """
    # The state of `spin_terms` is a pair of spinors; the state of other terms may be the
    # spins themselves.
    are_spinors = isinstance(y0, tuple)
    s0 = from_spinors(y0) if are_spinors else as_spins(y0)

    def step(s: Array) -> tuple[Array, tuple[Array, diffrax.RESULTS]]:
        # A spin has many spinors. Any will do, since all move to spinors of the same spin.
        y0 = to_spinors(s) if are_spinors else s
        y1, result = _one_step(terms, solver, t0, t1, y0, args)
        s1 = from_spinors(y1) if are_spinors else y1
        return s1, (s1, result)

    jacobian, (s1, result) = jax.jacrev(step, has_aux=True)(s0)
    jacobian = result.error_if(jacobian, result != diffrax.RESULTS.successful)
    # A row for each of the n components of all spins, with the shape of `s0`: row i of
    # `gradients` is ds1_i / ds0, and row i of `unit_vectors` is the unit vector i.
    num_components = s0.size
    gradients = jacobian.reshape(num_components, *s0.shape)
    identity = jnp.eye(num_components, dtype=s0.dtype)
    unit_vectors = identity.reshape(num_components, *s0.shape)

    def as_matrix(rows: Array) -> Array:
        """The (n, n) matrix of these rows."""
        return rows.reshape(num_components, num_components)

    # P(s) is never formed. Since P(s) v = s x v, the cross products of s with the rows of a
    # matrix M are the columns of P(s) M^T. M is J, and then the identity.
    J = as_matrix(gradients)
    P_Jt = as_matrix(jnp.cross(s0, gradients)).T
    J_P_Jt = dot(J, P_Jt)
    P_s1 = as_matrix(jnp.cross(s1, unit_vectors)).T
    return jnp.max(jnp.abs(J_P_Jt - P_s1))


def equipartition(
    terms: PyTree[diffrax.AbstractTerm],
) -> Callable[[RealScalarLike, Y, Args], dict[str, Array]]:
    r"""Two thermometers. In the stationary state at the temperature $T$ of the terms of
    [`diffrax_symplectic.langevin_terms`][] with a constant $H_0$,

    $$\Bigl\langle p \cdot \frac{\partial H_0}{\partial p} \Bigr\rangle = n T, \qquad
      \Bigl\langle q \cdot \frac{\partial H_0}{\partial q} \Bigr\rangle = n T$$

    for $n$ degrees of freedom, if $e^{-H_0 / T}$ vanishes at the ends of all coordinates.
    (It does not for angles.) Where they disagree with $T$ the step is too long, the start
    is not forgotten, or the terms say something else than what you mean.

    !!! example

        ```python
        import jax.numpy as jnp
        import jax.random as jr
        import diffrax_symplectic as ds


        def well(t, p, q, args):
            return p**2 / 2 + q**4 / 4


        terms = ds.langevin_terms(well, 1.0, 0.5, ())
        y0 = (jnp.array(0.0), jnp.array(0.0))
        thermometers = ds.equipartition(terms)
        call = thermometers, terms, ds.BAOAB(), 0, 20, 0.1, y0
        print(ds.expectation(*call, key=jr.key(0)))  # both 0.5
        ```

    **Arguments:**

    - `terms`: terms with the state `(p, q)`, not constrained.

    **Returns:** a function `phi(t, y, args)`, which returns a dictionary of the two numbers
    over $n$: `"kinetic"` and `"configurational"`, in units of energy.

    **Raises:** a `ValueError` for constrained terms.
    """
    if constraint_of(terms) is not None:
        raise ValueError(
            "`equipartition` takes no constrained terms, since its two means then "
            "contain the forces of the constraint. Look at the kinetic energy alone: with "
            "`c` constraints its mean is `(n - c) T / 2`."
        )
    drift, _, _ = split_friction(terms)

    def phi(t: RealScalarLike, y: Y, args: Args) -> dict[str, Array]:
        check_pair(y)
        p, q = y
        # dp/dt = -dH0/dq and dq/dt = dH0/dp, without friction and noise.
        force, velocity = rate(with_programs(drift, t, y, args), t, y, args)
        n = sum(leaf.size for leaf in jtu.tree_leaves(q))
        return {
            "kinetic": _inner_product(p, velocity) / n,
            "configurational": -_inner_product(q, force) / n,
        }

    return phi


def _inner_product(a: PyTree[Array], b: PyTree[Array]) -> Any:
    products = jtu.tree_map(lambda x, y: jnp.sum(x * y), a, b)
    return sum(jtu.tree_leaves(products))


def step_expectation(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args = None,
    *,
    fn: Callable[[RealScalarLike, Y, Args], PyTree[Array]],
    nodes: int = 8,
) -> PyTree[Array]:
    r"""The expectation $\mathbb E[\phi(t_1, y_1)]$ after one step, without sampling.

    The random variables of a [`diffrax_symplectic.WeakBrownianPath`][] take finitely
    many values, so the expectation is a finite sum: over $3^m$ outcomes for $m$ noises with
    one set of three-point variables. Gaussian increments (and their space-time and
    space-time-time Lévy areas, and plateaus) are integrated by Gauss--Hermite quadrature,
    which is exact if $\phi(y_1)$ is a polynomial in them of degree less than twice `nodes`.

    **Arguments:**

    - `terms`, `solver`, `y0`, `args`: as for `diffrax.diffeqsolve`; `terms` with any
        number of Brownian paths. Equal paths are one Brownian motion.
    - `t0`, `t1`: start and end of the step.
    - `fn`: the function $\phi$, `fn(t, y, args)`, which returns a PyTree of arrays.
    - `nodes`: the number of quadrature points in each Gaussian variable.

    **Returns:** the average of `fn`, in its structure.

    **Raises:** a `ValueError` if `terms` contain no path, or one whose law is not known; an
    error when run if the solver reports a failed step.
    """

    def value_after_step(
        terms_of_step: PyTree,
    ) -> tuple[PyTree[Array], diffrax.RESULTS]:
        y1, result = _one_step(terms_of_step, solver, t0, t1, y0, args)
        return fn(t1, y1, args), result

    return _mean_over_step(value_after_step, terms, t1 - t0, nodes)


def second_moment_map(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args = None,
    *,
    nodes: int = 8,
) -> Float[Array, "N N"]:
    r"""The linear map of first and second moments by one step, for a linear system (with
    additive or multiplicative noise).

    For such a system a step is $z_1 = Z z_0$ with a random matrix $Z$, where $z = (1, y)$
    and $y$ is the state as a vector of length $n$. So $\mathrm{vec}\, \mathbb E[z_1
    z_1^\top] = K\, \mathrm{vec}\, \mathbb E[z_0 z_0^\top]$ with $K = \mathbb E[Z \otimes
    Z]$, and $K^s$ gives the moments after $s$ steps. The spectral radius of $K$ is the
    growth factor of the mean square per step.

    **Arguments:** as for [`diffrax_symplectic.step_expectation`][]; only the structure,
    shapes and dtype of `y0` matter. The system must be linear and autonomous, which is not
    checked.

    **Returns:** the matrix $K$, of shape `(N, N)` with `N = (n + 1)**2`. Rows and columns
    belong to pairs $(i, j)$ of entries of $z$, with number $(n + 1) i + j$.

    **Raises:** as [`diffrax_symplectic.step_expectation`][], and a `ValueError` for
    constrained terms.
    """
    check_unconstrained(terms, "second_moment_map")
    flat, unravel = jfu.ravel_pytree(y0)
    size = flat.size
    # The step is affine, y1 = A y0 + b, so its values at zero and at the unit vectors give
    # A and b. Differentiating it would take far more tracing. Row 0 of `starts` is zero,
    # the others are the unit vectors.
    starts = jnp.eye(size + 1, size, k=-1, dtype=flat.dtype)

    def kron_Z_Z(terms_of_step: PyTree) -> tuple[Array, diffrax.RESULTS]:
        """The Kronecker product of Z with itself, for the terms with given increments, and
        the result of the step."""

        def step(y: Array) -> tuple[Array, diffrax.RESULTS]:
            y1, result = _one_step(terms_of_step, solver, t0, t1, unravel(y), args)
            end, _ = jfu.ravel_pytree(y1)
            return end, result

        ends, result = jax.vmap(step)(starts)
        # For z = (1, y), Z has the rows (1, 0) and (b, A). Here b is the end from zero, and
        # each column of A is what a unit vector adds to this end.
        row_of_one = jnp.zeros_like(flat, shape=(1, size + 1)).at[0, 0].set(1)
        columns = ends.at[1:].add(-ends[0])
        Z = jnp.concatenate([row_of_one, columns.T])
        return jnp.kron(Z, Z), result

    return _mean_over_step(kron_Z_Z, terms, t1 - t0, nodes)


def _mean_over_step(
    value_of: Callable[[PyTree], tuple[PyTree[Array], diffrax.RESULTS]],
    terms: PyTree[diffrax.AbstractTerm],
    h: RealScalarLike,
    nodes: int,
) -> PyTree[Array]:
    """The expectation of a value over the random variables of a step of size `h`.
    `value_of` gets the terms with one outcome of these variables, and returns the value and
    the result of the step. `nodes` is as for `step_expectation`."""
    check_baths_have_own_noise(terms)
    # The probability law of each variable, and a function that returns the terms with given
    # values of the variables in place of the paths.
    laws, terms_with = step_variables(terms, h)
    # Each row has the values of all variables. Its weight is the probability of the values.
    rows, weights = outcomes(laws, nodes)

    def value_for(row: Array) -> tuple[PyTree[Array], diffrax.RESULTS]:
        return value_of(terms_with(row))

    # The step is traced once for all rows.
    values, result = jax.vmap(value_for)(rows)  # pyright: ignore
    values = result.error_if(values, result != diffrax.RESULTS.successful)

    def mean(value: Array) -> Array:
        return jnp.tensordot(jnp.asarray(weights, value.dtype), value, axes=1)

    return jtu.tree_map(mean, values)


def weak_order_defect(
    terms: PyTree[diffrax.AbstractTerm],
    solver: diffrax.AbstractSolver,
    t0: RealScalarLike,
    t1: RealScalarLike,
    y0: Y,
    args: Args = None,
    *,
    fn: Callable[[RealScalarLike, Y, Args], PyTree[Array]],
    order: int,
    nodes: int = 8,
) -> PyTree[Array]:
    r"""The exact local weak error of one step,

    $$\mathbb E[\phi(t_1, y_1)] - \sum_{j=0}^{r} \frac{h^j}{j!} (L^j \phi)(t_0, y_0),$$

    with the generator $L$ of the equation. A method has weak order $r$ if this is
    $O(h^{r+1})$: a few values of $h$ suffice to find the order to two digits.

    For a Stratonovich solver, $L \phi = \partial_t \phi + a \cdot \nabla \phi + \frac12
    \sum_k b_k \cdot \nabla (b_k \cdot \nabla \phi)$. For an Itô solver the summands are
    $b_k^\top (\nabla^2 \phi)\, b_k$.

    **Arguments:** as for [`diffrax_symplectic.step_expectation`][], and

    - `order`: the order $r$. The cost of differentiation grows fast with it.

    **Returns:** the local error, in the structure of `fn`.

    **Raises:** as [`diffrax_symplectic.step_expectation`][], and a `ValueError` for
    constrained terms.
    """
    check_unconstrained(terms, "weak_order_defect")
    mean = step_expectation(terms, solver, t0, t1, y0, args, fn=fn, nodes=nodes)
    generator = _generator(
        with_programs(terms, t0, y0, args),
        args,
        ito=isinstance(solver, diffrax.AbstractItoSolver),
    )

    def phi(t: RealScalarLike, y: Y) -> PyTree[Array]:
        return fn(t, y, args)

    # Time has the dtype of the state, so that vector fields have it, too.
    t = jnp.asarray(t0, jnp.finfo(jnp.result_type(*jtu.tree_leaves(y0))).dtype)
    defect = mean
    # In round j these are the function L^j phi of time and state, and h^j / j!.
    L_power_phi = phi
    coefficient = 1.0
    for j in range(order + 1):
        value = L_power_phi(t, y0)
        defect = (defect**ω - coefficient * value**ω).ω
        L_power_phi = generator(L_power_phi)
        coefficient = coefficient * (t1 - t0) / (j + 1)
    return defect


def _generator(terms, args, ito: bool) -> Callable:
    r"""The generator $L$ of the equation with the drift $a$ and the noises $b_k$, as a map
    from functions $\phi(t, y)$ to functions $L \phi (t, y)$, whose values are PyTrees like
    those of $\phi$:

    $$L \phi = \partial_t \phi + a \cdot \nabla \phi
      + \tfrac12 \sum_k (b_k \cdot \nabla)^2 \phi,$$

    where for an Itô equation (`ito`) the derivatives of $b_k$ are left out. The mean of
    $\phi$ changes at the rate $\mathbb E\, L \phi$.
    """
    drift, noise = split_terms(terms)
    # Each `b_k(t, y)` is the response to a unit increment of one noise.
    fields = [
        ft.partial(apply_one, noise, jnp.array(k), jnp.ones(()), args)
        for k in range(number_of_noises(terms))
    ]

    def generator(phi: Callable) -> Callable:
        def L_phi(t: RealScalarLike, y: Y) -> PyTree[Array]:
            zero = jtu.tree_map(jnp.zeros_like, y)
            a = rate(drift, t, y, args) if drift else zero
            # The derivatives by time and along the drift are one derivative, along (1, a).
            _, total = jax.jvp(phi, (t, y), (jnp.ones_like(t), a))
            for field in fields:
                second = _second_derivative(phi, field, t, y, ito)
                total = (total**ω + second**ω / 2).ω
            return total

        return L_phi

    return generator


def _second_derivative(
    phi: Callable, field: Callable, t: RealScalarLike, y: Y, ito: bool
) -> PyTree[Array]:
    r"""The second derivative of `phi` along a vector field $b$: along its flow, $b \cdot
    \nabla (b \cdot \nabla \phi)$; or for an Itô equation along the straight line through
    `y` in the direction of $b(y)$, $b^\top (\nabla^2 \phi)\, b$."""
    field_at_y = field(t, y)

    def first_derivative(y: Y) -> PyTree[Array]:
        """The derivative of `phi` at any state, along the field there, or for an Itô
        equation along the line."""
        direction = field_at_y if ito else field(t, y)
        _, derivative = jax.jvp(lambda y: phi(t, y), (y,), (direction,))
        return derivative

    _, second_derivative = jax.jvp(first_derivative, (y,), (field_at_y,))
    return second_derivative
