"""A potential and a noise strength, learned from noisy trajectories.

dp = -U'(q) dt + s dw, dq = p dt: U(q) = q^4 / 4 - q^2 / 2, s = 0.3 are not known; p and q
are observed without error every 0.5. U is a small network, and the likelihood of what is
observed next is the Gaussian one whose mean and covariance the solver itself gives.
"""

import functools as ft
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array, Float

import diffrax_symplectic as ds

from .._pictures import line, WIDTH
from ..stability._page import fill, Page, table
from ..stability.solvability import Given


S = 0.3
SPACING = 0.5
# Where nearly all of what is observed lies.
SEEN = np.linspace(-1.5, 1.5, 61)


def true_potential(q):
    return q**4 / 4 - q**2 / 2


class Network(eqx.Module):
    """Of one hidden layer: `sum_i c_i softplus(a_i q + b_i)`, and a strength."""

    a: Float[Array, " 16"]
    b: Float[Array, " 16"]
    c: Float[Array, " 16"]
    log_s: Float[Array, ""]

    @staticmethod
    def draw(key) -> "Network":
        ka, kb = jr.split(key)
        a = 3 * jr.normal(ka, (16,))
        return Network(a, 2 * jr.normal(kb, (16,)), jnp.zeros(16), jnp.log(1.0))

    def __call__(self, q):
        return jnp.sum(self.c * jax.nn.softplus(self.a * q + self.b))


def make_terms(potential, s, path):
    return ds.hamiltonian_terms(
        lambda t, p, q, args: p**2 / 2 + potential(q),
        lambda t, p, q, args: -s * q,
        path,
    )


def flow(solver, potential, s, y0, W):
    """`len(W)` steps over the spacing, with these increments."""
    h = SPACING / len(W)

    def step(y, dw):
        terms = make_terms(potential, s, Given(dw))  # pyright: ignore[reportCallIssue]
        return solver.step(terms, 0.0, h, y, None, None, False)[0], None

    return jnp.stack(jax.lax.scan(step, y0, W)[0])


@ft.partial(jax.jit, static_argnums=(1, 2))
def observe(key, trajectories: int, length: int):
    """Of the true system, by far smaller steps than anyone takes later."""
    k_start, k_noise = jr.split(key)
    starts = jr.normal(k_start, (2, trajectories)) * jnp.array([[0.4], [0.9]])

    def next_one(y, key):
        W = jnp.sqrt(SPACING / 100) * jr.normal(key, (100, trajectories))
        ends = jax.vmap(ft.partial(flow, ds.StormerVerlet(), true_potential, S), (0, 1))
        return ends((y[0], y[1]), W).T, y

    return jax.lax.scan(next_one, starts, jr.split(k_noise, length))[1]


def negative_log_likelihood(model, solver, steps: int, now, then):
    """Of one observation after another. The end of a step is expanded to first order in
    the increments, so that it is Gaussian: exact for linear forces, and up to the order
    s^2 otherwise."""
    W = jnp.zeros(steps)
    end = lambda W: flow(solver, model, jnp.exp(model.log_s), (now[0], now[1]), W)
    J = jax.jacfwd(end)(W)
    covariance = SPACING / steps * J @ J.T
    away = then - end(W)
    fit = away @ jnp.linalg.solve(covariance, away)
    return (fit + jnp.linalg.slogdet(covariance)[1]) / 2


@ft.partial(jax.jit, static_argnums=(1, 2, 4))
def learn(key, solver, steps: int, observed, iterations: int) -> Network:
    """By Adam, with gradients through the solver, from every pair of neighbours."""
    now = jnp.moveaxis(observed[:-1], 1, 0).reshape(2, -1)
    then = jnp.moveaxis(observed[1:], 1, 0).reshape(2, -1)

    def loss(model):
        each = lambda now, then: negative_log_likelihood(
            model, solver, steps, now, then
        )
        return jnp.mean(jax.vmap(each, (1, 1))(now, then))

    def iterate(carry, i):
        model, first, second = carry
        g = jax.grad(loss)(model)
        first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, first, g)
        second = jax.tree.map(lambda v, g: 0.99 * v + 0.01 * g**2, second, g)
        rate = 0.05 * (1 + jnp.cos(jnp.pi * i / iterations)) / 2
        unbiased = lambda x, beta: x / (1 - beta ** (i + 1))
        move = lambda x, m, v: (
            x - rate * unbiased(m, 0.9) / (jnp.sqrt(unbiased(v, 0.99)) + 1e-8)
        )
        return (jax.tree.map(move, model, first, second), first, second), None

    model = Network.draw(key)
    zeros = jax.tree.map(jnp.zeros_like, model)
    carry = (model, zeros, zeros)
    return jax.lax.scan(iterate, carry, jnp.arange(iterations))[0][0]


class Learned(NamedTuple):
    s: float
    # Root mean square over what was seen.
    force_error: float
    # What the learned system gains in (true) energy without noise until t = 30, by its
    # own solver and step.
    drift: float
    forces: np.ndarray


def learned(solver, steps: int, observed, iterations: int, key=None) -> Learned:
    model = learn(
        jr.key(1) if key is None else key, solver, steps, observed, iterations
    )
    forces = -jax.vmap(jax.grad(model))(jnp.asarray(SEEN))
    exact = -jax.vmap(jax.grad(true_potential))(jnp.asarray(SEEN))
    force_error = float(jnp.sqrt(jnp.mean((forces - exact) ** 2)))

    def later(y, _):
        end = flow(solver, model, 0.0, (y[0], y[1]), jnp.zeros(steps))
        return end, true_potential(end[1]) + end[0] ** 2 / 2

    y0 = jnp.array([0.0, 1.5])
    _, energies = jax.lax.scan(later, y0, None, length=60)
    drift = float(jnp.mean(energies[-12:]) - jnp.mean(energies[:12]))
    return Learned(float(jnp.exp(model.log_s)), force_error, drift, np.asarray(forces))


SOLVERS = {
    "StormerVerlet": ds.StormerVerlet(),
    "Heun": diffrax.Heun(scan_kind="bounded"),
}


def section(page: Page) -> str:
    trajectories, length, iterations = (64, 9, 200) if page.quick else (256, 9, 600)
    counts = [2] if page.quick else [2, 4]
    pairs = trajectories * (length - 1)
    print(f"\nLearning U and s from {pairs:,} pairs of observations")
    observed = observe(jr.key(0), trajectories, length)
    rows = []
    figure, axes = plt.subplots(1, 2, figsize=(WIDTH, 3.6))
    exact = -jax.vmap(jax.grad(true_potential))(jnp.asarray(SEEN))
    for name, solver in SOLVERS.items():
        for steps in counts:
            r = learned(solver, steps, observed, iterations)
            drift = f"{r.drift:+.4f}" if abs(r.drift) < 10 else "overflow"
            rows.append(
                (name, SPACING / steps, f"{r.s:.4f}", f"{r.force_error:.4f}", drift)
            )
            if steps == 2:
                axes[0].plot(SEEN, r.forces, **line(name), label=name)
                axes[1].plot(SEEN, r.forces - exact, **line(name))
    axes[0].plot(SEEN, exact, "k:", label="exact")
    axes[0].set(xlabel="position $q$", ylabel="force")
    axes[1].set(xlabel="position $q$", ylabel="error of the force")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=3)
    picture = page.picture(figure, "learning", "A learned potential")
    header = "solver", "$h$", "$s$", "force error", "energy gain"
    return fill(
        __file__, table=table(header, rows), picture=picture, pairs=f"{pairs:,}", s=S,
        spacing=SPACING, error=f"{S / np.sqrt(4 * pairs):.4f}", iterations=iterations,
    )  # fmt: skip
