"""Derivatives by a friction or temperature that is zero for some momenta or somewhere."""

import itertools

import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..families import slow_except
from ..problems import as_friction, Given


PAIR = jnp.array([[1.0, -1.0, 0.0], [-1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
MANY = 17
# The friction and the temperature as functions of a number. Both are zero somewhere.
CASES = {
    "number": (lambda a: a, lambda a: a * jnp.array([1.0, 0.0, 2.0])),
    "no temperature": (lambda a: a, lambda a: 0 * a),
    "array": (lambda a: a * jnp.array([1.0, 0.0, 2.0]), lambda a: a),
    "matrix": (lambda a: as_friction(a * PAIR), lambda a: a),
    "zero matrix": (lambda a: as_friction(0 * a * PAIR), lambda a: a),
    "large matrix": (
        lambda a: as_friction(a * jnp.zeros((MANY, MANY)).at[:3, :3].set(PAIR)),
        lambda a: a,
    ),
    "wall": (lambda a: lambda t, q, args: a * jnp.maximum(q - 1, 0), lambda a: a),
    "matrix at q": (
        lambda a: lambda t, q, args: as_friction(a * jnp.maximum(q[2] - 1, 0) * PAIR),
        lambda a: a,
    ),
    "heated side": (
        lambda a: a,
        lambda a: lambda t, q, args: a * jnp.maximum(q - 1, 0),
    ),
    "tree": (
        lambda a: {"x": a * jnp.array([1.0, 0.0]), "y": 0 * a},
        lambda a: {"x": a, "y": a},
    ),
    "along": (
        lambda a: ds.FrictionAlong(a * jnp.array([[1.0, 0.0], [-1.0, 0.0], [0, 0]])),
        lambda a: 0 * a,
    ),
}


def _energy(t, p, q, args):
    momenta = jax.tree.leaves(p)
    positions = jax.tree.leaves(q)
    kinetic = sum(jnp.sum(x**2) for x in momenta) / 2
    return kinetic + sum(jnp.sum(jnp.cos(x)) for x in positions)


def _start(name, shift):
    """Positions on both sides of the wall."""
    number = MANY if name == "large matrix" else 3
    p = jnp.linspace(0.3, 0.5, number)
    q = jnp.linspace(0.2, 1.7, number) + shift
    if name != "tree":
        return p, q
    return tuple({"x": x[:2], "y": x[2]} for x in (p, q))


QUICK = [(ds.BAOAB(), "array"), (ds.BAOAB(), "matrix")]
# Each of the others once, with the one or the other solver in turn.
OTHERS = zip(itertools.cycle([ds.BAOAB(), ds.ImplicitMidpoint()]), CASES)
ALL = [*QUICK, *(case for case in OTHERS if case not in QUICK)]


@pytest.mark.parametrize("case", slow_except(QUICK, ALL), ids=str)
def test_derivatives_are_finite_and_those_of_differences(case):
    solver, name = case
    friction, temperature = CASES[name]

    def end(x):
        a, shift = x
        y0 = _start(name, shift)
        # One increment for each momentum, or for each direction.
        like = jnp.zeros(2) if name == "along" else y0[1]
        flat, unravel = jfu.ravel_pytree(like)
        noise = unravel(0.3 * jnp.cos(7.0 * jnp.arange(flat.size)))
        terms = ds.langevin_terms(_energy, friction(a), temperature(a), Given(noise))
        state = solver.init(terms, 0.0, 0.3, y0, None)
        y1, *_ = solver.step(terms, 0.0, 0.3, y0, None, state, False)
        return sum(jnp.sum(jnp.sin(x)) for x in jax.tree.leaves(y1))

    points = jnp.array([[0.7, 0.0], [1.3, 0.05]])
    forward = jax.jit(jax.vmap(jax.jacfwd(end)))(points)
    # One program for the gradients and for the values that are compared to them.
    units = 1e-5 * jnp.concatenate([jnp.zeros((1, 2)), jnp.eye(2), -jnp.eye(2)])
    moved = (points[:, None] + units).reshape(10, 2)
    values, backward = jax.jit(jax.vmap(jax.value_and_grad(end)))(moved)
    plus, minus = jnp.split(values.reshape(2, 5)[:, 1:], 2, axis=1)
    exact, backward = (plus - minus) / 2e-5, backward[::5]
    assert np.all(np.abs(exact[:, 1]) > 1e-3)
    np.testing.assert_allclose(forward, exact, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(backward, exact, rtol=1e-6, atol=1e-9)
