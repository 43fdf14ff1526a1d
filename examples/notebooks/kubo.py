# pyright: reportOptionalIterable=false
# %% [markdown]
# # The Kubo oscillator
#
# An oscillator has a noisy frequency, like a spin in a fluctuating magnetic field. In the
# Stratonovich sense it follows
#
# $$\mathrm{d}p = -q\,\mathrm{d}t - \sigma q \circ \mathrm{d}w, \qquad
#   \mathrm{d}q = p\,\mathrm{d}t + \sigma p \circ \mathrm{d}w.$$
#
# The noise changes only how fast $(q, p)$ rotates, so every path stays on its circle:
# $p^2 + q^2$ is constant. The angles of different paths drift apart, so means such as
# $\mathbb E q$ decay.
#
# This is the second test model of [Wang, Hong and Xu
# (2017)](https://doi.org/10.4208/cicp.261014.230616a).

# %%
import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds


jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## Solve
#
# The Hamiltonians are $H_0 = (p^2 + q^2)/2$ and $H_1 = \sigma H_0$. We solve one path up
# to $t = 100$ in steps of $h = 0.05$ with $\sigma = 0.5$, by the implicit midpoint rule
# and by Heun's method, along the same Brownian path.


# %%
def H0(t, p, q, sigma):
    return (p**2 + q**2) / 2


def H1(t, p, q, sigma):
    return sigma * H0(t, p, q, sigma)


y0 = (jnp.array(0.0), jnp.array(1.0))  # (p, q)
sigma, h, t1 = 0.5, 0.05, 100.0
# Implicit solvers take bounded increments, so that their equations have a solution.
path = ds.ImplicitMidpoint().path((), jr.key(2))
terms = ds.hamiltonian_terms(H0, H1, path)


@eqx.filter_jit
def solve(solver):
    steps = diffrax.SaveAt(t0=True, steps=1)
    sol = diffrax.diffeqsolve(
        terms, solver, 0.0, t1, h, y0, sigma, saveat=steps, max_steps=2000
    )
    return sol.ts, *sol.ys


solutions = {
    "ImplicitMidpoint": solve(ds.ImplicitMidpoint()),
    "Heun": solve(diffrax.Heun()),
}

# %% The midpoint rule stays on the unit circle, the path of Heun's method spirals outwards
fig, axes = plt.subplots(1, 2, figsize=(6, 3.3), sharex=True, sharey=True)
angle = np.linspace(0, 2 * np.pi, 200)
colours = {"ImplicitMidpoint": "#0072B2", "Heun": "#D55E00"}
for ax, (name, (_, p, q)) in zip(axes, solutions.items()):
    ax.plot(q, p, ".", ms=2, color=colours[name])
    ax.plot(np.cos(angle), np.sin(angle), "k", lw=0.8)
    ax.set(title=name, xlabel="$q$", ylabel="$p$", aspect="equal")
    print(f"{name:17} largest | |(p, q)| - 1 | = {abs(np.hypot(p, q) - 1).max():.1e}")
plt.show()

# %% [markdown]
# ## What fails, and why
#
# $p^2 + q^2$ is a quadratic invariant. The implicit midpoint rule conserves every
# quadratic invariant of a Stratonovich system, up to rounding and whatever the step size.
# Heun's method multiplies it in each step by a factor that depends on the noise, with the
# mean
#
# $$1 + (h^4 + 6 h^3 \sigma^2 + 3 h^2 \sigma^4) / 4.$$
#
# The term in $h^2$ comes from the noise. So the growth per unit of time falls only like
# $h$: half the step at best halves the drift, so a run that is twice as long needs half
# the step.

# %%
weak_terms = ds.hamiltonian_terms(H0, H1, ds.WeakBrownianPath((), jr.key(0)))
moment_map = eqx.filter_jit(ds.second_moment_map)
for step in (0.1, 0.05, 0.025):
    K = moment_map(weak_terms, diffrax.Heun(), 0.0, step, y0, sigma)
    growth = float(max(abs(np.linalg.eigvals(K)))) ** (t1 / step)
    print(f"Heun, h = {step:5}: E(p^2 + q^2) = {growth:.3f} at t = {t1:.0f}")

# %% [markdown]
# A conserved radius does not mean that the angle is right: on a single path it has an
# error of strong order 1. For means over all paths, `expectation` estimates both the
# error of the step and the error of sampling. Here
# $\mathbb E q = e^{-\sigma^2 t/2} \cos t$.

# %%
estimate = ds.expectation(
    lambda t, y, args: y[1],
    weak_terms,
    ds.StrangGauss(),
    0.0,
    4.0,
    0.25,
    y0,
    sigma,
    key=jr.key(3),
    ts=[1.0, 2.0, 3.0, 4.0],
    sampling=ds.ArrayRQMC(1024),
)
times = np.array([1.0, 2.0, 3.0, 4.0])
exact = np.exp(-(sigma**2) * times / 2) * np.cos(times)
rows = {"estimate": estimate.mean, "its error": estimate.error, "exact": exact}
for name, values in rows.items():
    print(f"{name:10}", *(f"{x:9.5f}" for x in np.asarray(values)))

# %% [markdown]
# ## Exercise
#
# Let the spring alone be noisy, $H_1 = \sigma q^2 / 2$. Now $p^2 + q^2$ is no longer
# constant: its mean grows at the rate $x$ with $x^3 + 4x = 2\sigma^2$, here 0.12452. Find
# the rate of `ImplicitMidpoint`, `StrangGauss` and `Heun` for $h = 0.2$ with
# `second_moment_map`. Which is the most accurate? (Answer: `StrangGauss` by far. The
# rates are 0.12368, 0.12452 and 0.12887.)
