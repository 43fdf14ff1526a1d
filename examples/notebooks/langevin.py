# pyright: reportOptionalIterable=false, reportGeneralTypeIssues=false
# %% [markdown]
# # A pendulum in a heat bath
#
# With friction $\gamma$ and noise at a temperature $T$,
#
# $$\mathrm{d}p = -\sin q\,\mathrm{d}t - \gamma p\,\mathrm{d}t
#     + \sqrt{2 \gamma T}\,\mathrm{d}w, \qquad
#   \mathrm{d}q = p\,\mathrm{d}t,$$
#
# a pendulum forgets its start, and $(p, q)$ gets the density $e^{-H_0 / T}$ of Gibbs with
# $H_0 = p^2 / 2 - \cos q$.

# %%
import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds


jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## One path
#
# `langevin_terms` takes the Hamiltonian, the friction, the temperature, and the Brownian
# path. `BAOAB` is explicit and evaluates the force once in a step.


# %%
def pendulum(t, p, q, args):
    return p**2 / 2 - jnp.cos(q)


friction, T = 0.2, 0.6
y0 = (jnp.array(0.0), jnp.array(0.0))  # (p, q)
path = ds.BAOAB().path((), jr.key(3), want="strong")
terms = ds.langevin_terms(pendulum, friction, T, path)
ts = jnp.linspace(0, 200, 2001)
saveat = diffrax.SaveAt(ts=ts)
sol = diffrax.diffeqsolve(
    terms, ds.BAOAB(), 0, 200, 0.1, y0, saveat=saveat, max_steps=None
)
p, q = sol.ys

# %% It turns over now and then
fig, ax = plt.subplots(figsize=(6, 3))
ax.plot(ts, q / (2 * np.pi))
ax.set(xlabel="t", ylabel="turns")
plt.show()

# %% [markdown]
# ## Many paths, and the law of Gibbs
#
# `ensemble` returns the states of many paths. Here they are drawn next to the exact
# density of the angle, $e^{\cos q / T}$.

# %%
paths = ds.ensemble(
    ds.langevin_terms(pendulum, friction, T, ()),
    ds.BAOAB(),
    t0=0,
    t1=60,
    dt0=0.2,
    y0=y0,
    key=jr.key(4),
    num_paths=20_000,
)
p, q = paths.ys
angle = np.linspace(-np.pi, np.pi, 200)
density = np.exp(np.cos(angle) / T)
density /= np.trapezoid(density, angle)

# %% The angles of 20,000 pendulums, and the exact density
fig, ax = plt.subplots(figsize=(6, 3))
ax.hist(np.mod(q + np.pi, 2 * np.pi) - np.pi, bins=60, density=True, alpha=0.4)
ax.plot(angle, density, "k")
ax.set(xlabel="q", ylabel="density")
plt.show()
print(f"<p^2> = {np.mean(p**2):.3f}, and the temperature is {T}")

# %% [markdown]
# `BAOAB` is slightly too cold in its momenta, by $\omega^2 h^2 / 4$ in a well of frequency
# $\omega$, and very accurate in its positions.
#
# ## A mean, and what the step does to it
#
# `expectation` solves with the steps `dt0` and half of it, extrapolates to steps of size
# zero, and prints an error that holds both: sampling, and what is left of the step.

# %%
exact = np.sum(np.cos(angle) * density) / np.sum(density)
rows = []
for dt0 in (0.25, 0.5, 1.0):
    estimate = ds.expectation(
        lambda t, y, args: jnp.cos(y[1]),
        ds.langevin_terms(pendulum, friction, T, ()),
        ds.BAOAB(),
        t0=0,
        t1=60,
        dt0=dt0,
        y0=y0,
        key=jr.key(5),
        sampling=ds.IndependentPaths(40_000),
    )
    rows.append((dt0, float(estimate.mean), float(estimate.error)))
    print(f"dt0 = {dt0}: {estimate.mean:.4f} ± {estimate.error:.4f}, exact {exact:.4f}")

# %% The mean of cos q from three steps, with its errors, and the exact one
fig, ax = plt.subplots(figsize=(5, 3))
steps, means, errors = np.array(rows).T
ax.errorbar(steps, means, errors, fmt="o")
ax.axhline(exact, color="k", lw=0.8)
ax.set(xlabel="dt0", ylabel="mean of cos q", xlim=(0, 1.1))
plt.show()

# %% [markdown]
# See also [Langevin dynamics](../solvers/langevin.md): masses that depend on positions,
# expensive forces, two baths, transport.
