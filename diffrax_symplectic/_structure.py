"""Whether a system has the structure that a family of methods relies on."""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ._custom_types import Args, RealScalarLike, Y
from ._hamiltonian import check_pair


def check_separable(
    drift: tuple, noise: tuple, t0: RealScalarLike, y0: Y, args: Args, solver: str
) -> None:
    """Raises a `ValueError`, while tracing, unless `H0 = V(p) + U(t, q)` and the noise
    Hamiltonians are functions of `t` and `q` alone."""
    check_pair(y0)

    def velocity(part):
        return lambda term, t, y, args: term.vf(t, y, args)[part]

    def noise_value(part):
        return lambda term, t, y, args: _noise_matrix(term, t, y, args)[part]

    needs = "needs H0 = V(p) + U(t, q) and noise Hamiltonians H_k = U_k(t, q)"
    for term in drift:
        for part, wrong, name in ((0, "p", "d(dH0/dq)/dp"), (1, "q", "d(dH0/dp)/dq")):
            _refuse_unless(
                _independent(velocity(part), wrong, term, t0, y0, args),
                f"`{solver}` {needs}, but {name} does not vanish. Use a solver for the "
                "general structure, for example `Midpoint` or `SRKw1`.",
            )
        _refuse_unless(
            _independent(velocity(1), "t", term, t0, y0, args),
            f"`{solver}` {needs}, but d(dH0/dp)/dt does not vanish. Use a solver for "
            "the general structure, for example `Midpoint` or `SRKw1`.",
        )
    for term in noise:
        zero = _vanishes(noise_value(1), term, t0, y0, args)
        _refuse_unless(
            zero and _independent(noise_value(0), "p", term, t0, y0, args),
            f"`{solver}` {needs}, but dH_k/dp does not vanish. Use a solver for the "
            "general structure, for example `Midpoint` or `SRKw1`.",
        )


def check_additive(
    noise: tuple, t0: RealScalarLike, y0: Y, args: Args, solver: str, constant: bool
) -> None:
    """Raises a `ValueError`, while tracing, unless the noise does not depend on the state
    nor, if it has to be `constant`, on time."""
    needs = "needs additive noise, H_k = -sigma_k(t).q + gamma_k(t).p"
    for term in noise:
        _refuse_unless(
            _independent(_noise_matrix, "y", term, t0, y0, args),
            f"`{solver}` {needs}, but db_k/dy, the derivative of the noise b_k = "
            "(-dH_k/dq, dH_k/dp) by the state, does not vanish. Use a solver for the "
            "general structure, for example `Midpoint` or `SRKw1`.",
        )
        if constant:
            _refuse_unless(
                _independent(_noise_matrix, "t", term, t0, y0, args),
                f"`{solver}` needs additive noise that is constant in time, but "
                "db_k/dt does not vanish. Use `SRKs4`, or a solver for the general "
                "structure, for example `Midpoint` or `SRKw1`.",
            )


def _refuse_unless(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _noise_matrix(term: diffrax.AbstractTerm, t, y, args) -> Y:
    """Responses to each unit control, so that any term and any `prod` will do."""
    struct = eqx.filter_eval_shape(term.contr, t, t)
    zero = jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), struct)
    flat, unravel = jfu.ravel_pytree(zero)
    units = jnp.eye(flat.size, dtype=flat.dtype)
    return jax.vmap(lambda u: term.vf_prod(t, y, args, unravel(u)))(units)


def _independent(fn: Callable, of: str, term, t0, y0, args) -> bool:
    """Whether `fn(term, t, y, args)` does not depend on `t`, on `y`, or for `y = (p, q)`
    on `p` or `q`.

    First by the program: most are written so that the other variable does not enter.
    If it enters, it may still cancel: then the derivative is computed at random points.
    """
    t0 = jnp.asarray(t0, jnp.result_type(float))

    def split(x, term, t, y, args):
        if of == "t":
            t = x
        elif of == "y":
            y = x
        else:
            y = (x, y[1]) if of == "p" else (y[0], x)
        return fn(term, t, y, args)

    x0 = t0 if of == "t" else y0 if of == "y" else y0["pq".index(of)]
    inputs = (x0, term, t0, y0, args)
    if not _reads_first(split, inputs):
        return True

    def derivative(x, *rest):
        tangent = jtu.tree_map(jnp.ones_like, x)
        leaves, treedef = jtu.tree_flatten(tangent)
        keys = jr.split(jr.key(0), len(leaves))
        tangent = treedef.unflatten(
            [jr.normal(k, v.shape, v.dtype) for k, v in zip(keys, leaves)]
        )
        return jax.jvp(lambda x: split(x, *rest), (x,), (tangent,))

    return _small_at_random_points(derivative, inputs)


def _vanishes(fn: Callable, term, t0, y0, args) -> bool:
    """Whether `fn(term, t, y, args)` is zero everywhere."""
    t0 = jnp.asarray(t0, jnp.result_type(float))

    def value(term, t, y, args):
        out = fn(term, t, y, args)
        return jtu.tree_map(jnp.ones_like, out), out

    return _small_at_random_points(value, (term, t0, y0, args))


def _closed(fn: Callable, inputs: PyTree):
    """The program of `fn`, with all arrays that enter it as inputs."""
    dynamic, static = eqx.partition(inputs, eqx.is_array)
    flat, treedef = jtu.tree_flatten(dynamic)

    def flat_fn(*flat):
        return fn(*eqx.combine(jtu.tree_unflatten(treedef, flat), static))

    return jax.make_jaxpr(flat_fn)(*flat), flat


def _reads_first(fn: Callable, inputs: PyTree) -> bool:
    """Whether the first input enters the program that computes `fn`."""
    from jax.interpreters import partial_eval as pe

    closed, _ = _closed(fn, inputs)
    n = len(jtu.tree_leaves(eqx.filter(inputs[0], eqx.is_array)))
    _, used = pe.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars))
    return any(used[:n])


def _small_at_random_points(fn: Callable, inputs: PyTree) -> bool:
    """Whether, of `fn(*inputs) -> (reference, value)`, the value is rounding error next
    to the reference, with every traced or given floating-point input drawn at random."""
    closed, flat = _closed(fn, inputs)
    half = len(closed.jaxpr.outvars) // 2
    rng = np.random.default_rng(0)
    finite = 0
    with jax.ensure_compile_time_eval():
        consts = [_concrete(c, rng) for c in closed.consts]
        for _ in range(8):
            drawn = [_concrete(x, rng, redraw=True) for x in flat]
            out = jax.core.eval_jaxpr(closed.jaxpr, consts, *drawn)
            reference, value = out[:half], out[half:]
            size = max(float(np.max(np.abs(x), initial=0)) for x in reference)
            error = max(float(np.max(np.abs(x), initial=0)) for x in value)
            if not np.isfinite(size + error):
                continue
            finite += 1
            eps = float(jnp.finfo(jnp.result_type(value[0])).eps)
            if error > 1e4 * eps * max(size, 1.0):
                return False
    return True


def _concrete(x, rng, redraw: bool = False):
    dtype = jnp.result_type(x)
    traced = isinstance(x, jax.core.Tracer)
    if jnp.issubdtype(dtype, jnp.floating) and (traced or redraw):
        return jnp.asarray(rng.normal(size=jnp.shape(x)), dtype)
    if not traced:
        return x
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jr.key(0), jnp.shape(x))
    return jnp.ones(jnp.shape(x), dtype)
