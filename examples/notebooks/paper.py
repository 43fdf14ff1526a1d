# %% [markdown]
# # The test models of the paper
#
# The four models of [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
# and why other methods fail on them. They are imported from the folder `examples`, so run
# this notebook in a checkout. The [gallery](../gallery.md) has the figures of the paper.

# %%
import inspect

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds
from examples import kubo, linear_oscillator, rigid_body, synchrotron


jax.config.update("jax_enable_x64", True)
weak = ds.WeakBrownianPath((), jr.key(0))
moment_map = eqx.filter_jit(ds.second_moment_map)

# %% [markdown]
# ## A linear oscillator with additive noise
#
# $\mathrm{d}p = -q\,\mathrm{d}t + \sigma\,\mathrm{d}w$, $\mathrm{d}q = p\,\mathrm{d}t$: the
# noise does work, and $\mathbb E(p^2 + q^2)$ grows by $\sigma^2$ per unit of time.

# %%
print(inspect.getsource(linear_oscillator.make_terms))

# %% [markdown]
# One step maps the second moments to the next ones by a matrix. Its spectral radius, the
# factor by which a step amplifies the mean square, should be 1. A symplectic step preserves
# area in phase space, so it can't inflate all orbits. Without noise, a step of Heun's
# method multiplies $p^2 + q^2$ by $1 + h^4/4$, and one of Euler's method by $1 + h^2$.

# %%
h, t1 = 0.2, 1000.0
linear = linear_oscillator.make_terms(weak)
for solver in (ds.StormerVerlet(), diffrax.Heun(), diffrax.Euler()):
    K = moment_map(linear, solver, 0.0, h, linear_oscillator.Y0)
    growth = float(max(abs(np.linalg.eigvals(K))))
    print(f"{type(solver).__name__:13} factor - 1 = {growth - 1:9.1e}", end="")
    print(f"   after t = {t1:.0f}: {growth ** (t1 / h):.3g}")

# %% [markdown]
# ## The Kubo oscillator
#
# With $H_1 = \sigma H_0$ the noise changes only how fast $(q, p)$ rotates: each path stays
# on its circle, and $\mathbb E q = e^{-\sigma^2 t/2} \cos t$ from $(p, q) = (0, 1)$.

# %%
print(inspect.getsource(kubo.make_terms))

# %% [markdown]
# The implicit midpoint rule conserves every quadratic invariant, here $p^2 + q^2$. Heun's
# method multiplies it by $1 + (h^4 + 6 h^3 \sigma^2 + 3 h^2 \sigma^4) / 4$ on average, so
# half the step at best halves the drift. A conserved radius does not mean that the angle is
# right: `expectation` estimates the error of the step and of sampling.

# %%
sigma, times = 0.5, np.array([1.0, 2.0, 3.0, 4.0])
noisy = kubo.make_terms(weak, sigma)
for step in (0.1, 0.05, 0.025):
    K = moment_map(noisy, diffrax.Heun(), 0.0, step, kubo.Y0)
    growth = float(max(abs(np.linalg.eigvals(K)))) ** (100 / step)
    print(f"Heun, h = {step:5}: E(p^2 + q^2) = {growth:.3f} at t = 100")
position = lambda t, y, args: y[1]
problem = position, noisy, ds.StrangGauss(), 0.0, 4.0, 0.25, kubo.Y0
sampling = ds.ArrayRQMC(1024)
print(ds.expectation(*problem, key=jr.key(3), ts=times, sampling=sampling))
print("exact", np.exp(-(sigma**2) * times / 2) * np.cos(times))

# %% [markdown]
# ## Synchrotron oscillations
#
# The phase $Q$ of a particle in a storage ring swings like a pendulum. Noise in the phase
# and in the amplitude of the voltage heats a bunch of particles, and some leave the
# *bucket*, in which $Q$ swings. The system is separable, so explicit solvers apply.

# %%
print(inspect.getsource(synchrotron.make_terms))
bunches = {}
for solver, h in ((ds.StormerVerlet(), 0.1), (diffrax.Euler(), 0.02)):
    terms = synchrotron.make_terms(ds.FixedStepBrownianPath((2,), jr.key(0)))
    problem = terms, solver, 0.0, 100.0, h, synchrotron.Y0
    paths = ds.ensemble(*problem, key=jr.key(1), num_paths=2000)
    bunches[f"{type(solver).__name__}, h = {h}"] = jax.tree.map(jnp.ravel, paths.ys)

# %% Phase space at t = 100: Euler's method has heated nearly all particles out
fig, axes = plt.subplots(1, 2, figsize=(6, 3.3), sharey=True)
edge = np.linspace(-np.pi, np.pi, 200)
for ax, (name, (P, Q)) in zip(axes, bunches.items()):
    ax.plot((Q + np.pi) % (2 * np.pi) - np.pi, P, ".", ms=2)
    for sign in (1, -1):
        ax.plot(edge, 2 * sign * synchrotron.OMEGA * np.cos(edge / 2), "k", lw=0.8)
    outside = jnp.mean(synchrotron.H0(0.0, P, Q, None) > synchrotron.OMEGA**2)
    ax.set(title=f"{name}\n{outside:.1%} outside", xlabel="$Q$", ylim=(-10, 10))
axes[0].set_ylabel("$P$")
plt.show()

# %% [markdown]
# Each step of Euler's method multiplies the energy of small oscillations by
# $1 + \omega^2 h^2$. Shorter steps only delay this.
#
# ## A rigid body
#
# The angular momentum $X$ of a free body is turned at random about the first axis, so $|X|$
# is constant. The flow is also a *Poisson map*: it preserves the bracket
# $\{X_1, X_2\} = -X_3$. The midpoint rule for $X$ conserves the length but not the bracket;
# `spin_terms`, here with a noise about each axis, conserve both.

# %%
print(inspect.getsource(rigid_body.make_terms))
print(inspect.getsource(rigid_body.spinor_terms))
poisson_defect = eqx.filter_jit(ds.poisson_defect)
turns = rigid_body.spinor_terms(ds.ImplicitMidpoint().path((3,), jr.key(0)))
plain = rigid_body.make_terms(ds.ImplicitMidpoint().path((), jr.key(0)))
X0 = rigid_body.X0
for name, terms, solver, y0 in (
    ("ImplicitMidpoint, spin_terms", turns, ds.ImplicitMidpoint(), ds.to_spinors(X0)),
    ("ImplicitMidpoint for X", plain, ds.ImplicitMidpoint(), X0),
    ("Heun for X", plain, diffrax.Heun(), X0),
):
    print(f"{name:29} {poisson_defect(terms, solver, 0.0, 0.1, y0):.1e}")
