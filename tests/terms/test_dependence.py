"""Which structures are recognised by dead-code elimination, and which are refused."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._terms import (
    acts_elementwise,
    additive_fault,
    constant_fault,
    Dependence,
    separable_fault,
)


K = jnp.array([[2.0, -1.0], [-1.0, 2.0]])
_network = eqx.nn.MLP(2, "scalar", 4, 2, activation=jnp.tanh, key=jr.key(0))
ARGS = {"m": jnp.array([1.0, 2.0]), "k": jnp.array(0.5), "n": jnp.array(0), "K": K}


def _over_sites(t, p, q, args):
    def add(total, pq):
        p, q = pq
        return total + p**2 / 2 + jnp.cos(q), None

    return jax.lax.scan(add, jnp.zeros(()), (p, q))[0]


def _checked(t, p, q, args):
    p = eqx.error_if(p, jnp.any(p > 1e9), "too fast")
    return jnp.sum(p**2) + jnp.sum(jnp.sin(q))


SEPARABLE = {
    "masses": lambda t, p, q, a: jnp.sum(p**2 / (2 * a["m"])) + a["k"] * jnp.sum(q**4),
    "quadratic form": lambda t, p, q, a: p @ a["K"] @ p / 2 + q @ K @ q / 2,
    "network": lambda t, p, q, a: jnp.sum(p**2) + _network(q),
    "cond": lambda t, p, q, a: jax.lax.cond(
        a["k"] > 0,
        lambda: jnp.sum(p**2 + jnp.cos(q)),
        lambda: jnp.sum(p**4 + jnp.sin(q)),
    ),
    "scan": _over_sites,
    "vmap": lambda t, p, q, a: jnp.sum(
        jax.vmap(lambda p, q, m: p**2 / m - jnp.cos(q))(p, q, a["m"])
    ),
    "lattice": lambda t, p, q, a: (
        jnp.sum(p**2) / 2
        + jnp.sum(jnp.diff(q) ** 2)
        + jnp.sum((jnp.roll(q, 1) - q) ** 4)
    ),
    "checkpoint": lambda t, p, q, a: jax.checkpoint(
        lambda p, q: jnp.sum(jnp.sin(p)) + jnp.sum(jnp.exp(q))
    )(p, q),
    "checked": _checked,
    "shapes": lambda t, p, q, a: jnp.sum(p**2) * q.size + jnp.sum(q**2) * len(p),
}
NOT_SEPARABLE = {
    "product": lambda t, p, q, a: jnp.sum(p * q),
    "integer": lambda t, p, q, a: jnp.sum(p**2 + q**2) + (1 - a["n"]) * jnp.sum(p * q),
    "mass in time": lambda t, p, q, a: jnp.sum(p**2) * (1 + t) + jnp.sum(q**2),
    "rounded": lambda t, p, q, a: jnp.sum(p**2 + q * jnp.floor(p)),
    "not differentiated": lambda t, p, q, a: jnp.sum(
        p**2 + q * jax.lax.stop_gradient(p)
    ),
    "branch": lambda t, p, q, a: jax.lax.cond(
        p[0] > 0, lambda: jnp.sum(p**2 + q), lambda: jnp.sum(p**2 + q**2)
    ),
    "carried": lambda t, p, q, a: jax.lax.scan(
        lambda s, x: (s * x[0] + x[1], None), 1.0, (p, q)
    )[0],
    "cancels": lambda t, p, q, a: jnp.sum((p - q) ** 2 / 2 + p * q),
    "columns": lambda t, p, q, a: jnp.sum(jnp.sum(jnp.stack([p, q]), 0) ** 2),
    # Separable, which dead-code elimination does not see.
    "packed": lambda t, p, q, a: jnp.sum(jnp.concatenate([p, q]) ** 2),
    "zero coupling": lambda t, p, q, a: jnp.sum(p**2 + q**2) + 0.0 * jnp.sum(p * q),
}
NOISES = {
    # Whether they are additive, and constant.
    "constant kick": (lambda t, p, q, a: -a["k"] * jnp.sum(q), True, True),
    "matrix": (lambda t, p, q, a: jnp.sum(a["K"] @ q - K @ p), True, True),
    "in time": (lambda t, p, q, a: jnp.cos(t) * jnp.sum(q), True, False),
    "square": (lambda t, p, q, a: jnp.sum(q**2), False, True),
    "cancels": (lambda t, p, q, a: jnp.sum((p + q) ** 2 - p**2 - q**2), False, True),
}
Y0 = (jnp.array([0.3, 0.1]), jnp.array([0.5, -0.2]))


def _terms(H0, noise):
    terms = ds.hamiltonian_terms(H0, noise, ds.WeakBrownianPath((), jr.key(0)))
    return tuple((term,) for term in terms.terms)


_potential = lambda t, p, q, args: jnp.sum(jnp.sin(q)) * jnp.cos(t)


@pytest.mark.parametrize("H0", SEPARABLE.values(), ids=SEPARABLE.keys())
def test_ordinary_separable_hamiltonians_are_recognised(H0):
    # Also if the arguments are traced, and nothing is run.
    terms = _terms(H0, _potential)
    fault = jax.eval_shape(lambda args: separable_fault(*terms, 0.0, Y0, args), ARGS)
    assert fault is None


@pytest.mark.parametrize("H0", NOT_SEPARABLE.values(), ids=NOT_SEPARABLE.keys())
def test_what_may_not_be_separable_is_refused(H0):
    assert separable_fault(*_terms(H0, _potential), 0.0, Y0, ARGS) is not None
    assert separable_fault(*_terms(_over_sites, H0), 0.0, Y0, ARGS) is not None


def test_additive_and_constant_noise_is_recognised():
    for name, (H, additive, constant) in NOISES.items():
        _, noise = _terms(_over_sites, H)
        assert (additive_fault(noise, 0.0, Y0, ARGS) is None) == additive, name
        assert (constant_fault(noise, 0.0, Y0, ARGS) is None) == constant, name


_count = lambda n, f, x: jax.lax.while_loop(
    lambda c: c[0] < n, lambda c: (c[0] + 1, f(c[1])), (0, x)
)[1]
PROGRAMS = {
    # Whether the result does not depend on x.
    "repeated": (lambda x, y: _count(3, lambda s: 2 * s, y), True),
    "repeated as often as x says": (lambda x, y: _count(x, lambda s: 2 * s, y), False),
    "read in a loop": (lambda x, y: _count(3, lambda s: s + x, y), False),
    "chosen branch": (lambda x, y: jax.lax.cond(x > 0, jnp.sin, jnp.cos, y), False),
    "call back": (
        lambda x, y: jax.pure_callback(
            lambda v: v, jax.ShapeDtypeStruct((), float), x, vmap_method="sequential"
        ),
        False,
    ),
}


def test_dependence_through_programs():
    for name, (fn, independent) in PROGRAMS.items():
        flow = Dependence(fn, jnp.array(0.5), jnp.array(0.3))
        assert flow.independent(lambda x, y: x) == independent, name
        wrapped = Dependence(jax.jit(jax.vmap(fn)), jnp.ones(3), jnp.ones(3))
        assert wrapped.independent(lambda x, y: x) == independent, name


_MASSES = jnp.array([1.0, 2.0, 4.0])


KINETIC = [
    (lambda p: p @ p / 2, True),
    (lambda p: jnp.vdot(p, p / _MASSES) / 2, True),
    (lambda p: jnp.sum(jax.jit(jnp.square)(p)) / 2, True),
    (lambda p: jnp.sum(jnp.where(_MASSES > 1, p, 2 * p) ** 2), True),
    # The first two are so, but not known to be.
    (lambda p: jnp.einsum("i,i,i", p, p, 1 / _MASSES) / 2, False),
    (lambda p: sum(p[i] ** 2 for i in range(3)) / 2, False),
    (lambda p: p @ (jnp.diag(_MASSES) + 0.1) @ p / 2, False),
    (lambda p: jnp.sum(jnp.diff(p) ** 2), False),
    (lambda p: jnp.sum(p) ** 2 / 2, False),
    (lambda p: jnp.sum(p * p[::-1]), False),
    (lambda p: jnp.sum(p**2 * _MASSES[:, None]) + jnp.sum(jnp.cumsum(p) ** 2), False),
]


def test_kinetic_energies_of_diagonal_masses_are_known():
    for kinetic, diagonal in KINETIC:
        assert acts_elementwise(jax.grad(kinetic), jnp.ones(3)) is diagonal
    # Arrays of a tree that mix do not act entry by entry.
    p = {"a": jnp.ones(3), "b": jnp.ones(3)}
    apart = lambda p: {"a": 2 * p["a"], "b": p["b"] / _MASSES}
    mixed = lambda p: {"a": p["a"] + p["b"], "b": p["b"]}
    exchanged = lambda p: {"a": p["b"], "b": p["a"]}
    found = [acts_elementwise(fn, p) for fn in (apart, mixed, exchanged)]
    assert found == [True, False, False]


@pytest.mark.core
def test_friction_of_squared_momenta_is_linear_in_every_version_of_jax():
    # Up to JAX 0.6 the derivative of `p**2 / 2` has the derivative `p**0`.
    slope = jax.jit(jax.grad(jax.grad(lambda p: p**2 / 2)))
    assert Dependence(slope, 1.0).independent(lambda p: p)
