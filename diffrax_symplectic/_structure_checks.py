"""Whether a system has the structure that a family of methods relies on."""

from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.core
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
        return lambda term, t, y, args, _: term.vf(t, y, args)[part]

    def noise_value(part):
        return lambda *inputs: _noise_at(*inputs)[part]

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
        _refuse_unless(
            _vanishes(noise_value(1), noise_value(0), term, t0, y0, args)
            and _independent(noise_value(0), "p", term, t0, y0, args),
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
            _independent(_noise_at, "y", term, t0, y0, args),
            f"`{solver}` {needs}, but db_k/dy, the derivative of the noise b_k = "
            "(-dH_k/dq, dH_k/dp) by the state, does not vanish. Use a solver for the "
            "general structure, for example `Midpoint` or `SRKw1`.",
        )
        if constant:
            _refuse_unless(
                _independent(_noise_at, "t", term, t0, y0, args),
                f"`{solver}` needs additive noise that is constant in time, but "
                "db_k/dt does not vanish. Use `SRKs4`, or a solver for the general "
                "structure, for example `Midpoint` or `SRKw1`.",
            )


def _refuse_unless(condition: bool, message: str) -> None:
    if not condition:
        raise ValueError(message)


def _noise_at(term: diffrax.AbstractTerm, t, y, args, control) -> Y:
    return term.vf_prod(t, y, args, control)


def _any_control(term: diffrax.AbstractTerm, t) -> PyTree:
    struct = eqx.filter_eval_shape(term.contr, t, t)
    return jtu.tree_map(lambda s: jnp.zeros(s.shape, s.dtype), struct)


def _independent(fn: Callable, of: str, term, t0, y0, args) -> bool:
    """Whether `fn(term, t, y, args, control)` does not depend on `t`, on `y`, or for
    `y = (p, q)` on `p` or `q`.

    First by the program: most are written so that the other variable does not enter.
    If it enters, it may still cancel: then the derivative is computed at random points.
    """
    t0 = jnp.asarray(t0, jnp.result_type(float))

    def split(x, term, t, y, args, control):
        if of == "t":
            t = x
        elif of == "y":
            y = x
        else:
            y = (x, y[1]) if of == "p" else (y[0], x)
        return fn(term, t, y, args, control)

    x0 = t0 if of == "t" else y0 if of == "y" else y0["pq".index(of)]
    inputs = (x0, term, t0, y0, args, _any_control(term, t0))
    if not _reads_first(split, inputs):
        return True

    def derivative(x, *rest):
        leaves, treedef = jtu.tree_flatten(x)
        keys = jr.split(jr.key(0), len(leaves))
        tangent = treedef.unflatten(
            [jr.normal(k, v.shape, v.dtype) for k, v in zip(keys, leaves)]
        )
        return jax.jvp(lambda x: split(x, *rest), (x,), (tangent,))

    return _small_at_random_points(derivative, inputs)


def _vanishes(fn: Callable, reference: Callable, term, t0, y0, args) -> bool:
    """Whether `fn(term, t, y, args, control)` is zero everywhere, but for the rounding
    errors that go with numbers of the size of `reference`."""
    t0 = jnp.asarray(t0, jnp.result_type(float))
    both = lambda *inputs: (reference(*inputs), fn(*inputs))
    inputs = (term, t0, y0, args, _any_control(term, t0))
    return _small_at_random_points(both, inputs)


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
    normal = lambda x: rng.normal(size=jnp.shape(x))
    # Between 0 and 1 most functions are defined that are not defined everywhere.
    positive = lambda x: rng.uniform(size=jnp.shape(x))
    tested = False
    with jax.ensure_compile_time_eval():
        for draw in [normal, positive] * 4:
            consts = [_concrete(c, draw, redraw=False) for c in closed.consts]
            drawn = [_concrete(x, draw, redraw=True) for x in flat]
            out = jax.core.eval_jaxpr(closed.jaxpr, consts, *drawn)
            flat_out = [
                np.concatenate([np.ravel(x) for x in part])
                for part in (out[:half], out[half:])
            ]
            finite = np.isfinite(flat_out[0]) & np.isfinite(flat_out[1])
            size, error = (np.max(np.abs(x[finite]), initial=0) for x in flat_out)
            tested = tested or bool(finite.any())
            if error > 1e3 * float(np.finfo(size.dtype).eps) * size:
                return False
    if not tested:
        raise ValueError(
            "The structure of the Hamiltonians could not be tested, because their "
            "derivatives were not finite at any of the points tried. Write them so that "
            "variables that cancel do not enter at all, or use a solver for the general "
            "structure, for example `Midpoint` or `SRKw1`."
        )
    return True


def _concrete(x, draw: Callable, redraw: bool):
    dtype = jnp.result_type(x)
    traced = isinstance(x, jax.core.Tracer)
    if jnp.issubdtype(dtype, jnp.floating) and (traced or redraw):
        return jnp.asarray(draw(x), dtype)
    if not traced:
        return x
    if jnp.issubdtype(dtype, jax.dtypes.prng_key):
        return jnp.broadcast_to(jr.key(0), jnp.shape(x))
    return jnp.ones(jnp.shape(x), dtype)
