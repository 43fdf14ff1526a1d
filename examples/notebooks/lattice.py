# %% [markdown]
# # A kink on a lattice
#
# A field $\phi$ on the sites of a chain has two stable values, $-1$ and $1$. A kink joins
# them. In a heat bath it is a particle by itself: it diffuses with $D = T / (M \gamma)$,
# where $M$ is its mass.

# %%
import jax
import jax.numpy as jnp
import jax.random as jr
import matplotlib.pyplot as plt
import numpy as np

import diffrax_symplectic as ds


jax.config.update("jax_enable_x64", True)

# %% [markdown]
# ## The energy
#
# $H_0 = \sum_i \frac12 p_i^2 + \frac14 (\phi_i^2 - 1)^2
#   + \frac12 \kappa (\phi_{i+1} - \phi_i)^2$ with free ends, and the same friction
# everywhere. The kink at rest is $\tanh(x / \sqrt{2 \kappa})$.

# %%
sites, kappa, friction, T = 128, 16.0, 0.5, 0.04
x = np.arange(sites) - (sites - 1) / 2
kink = jnp.tanh(x / jnp.sqrt(2 * kappa))


def energy(t, p, phi, args):
    bonds = kappa * (phi[1:] - phi[:-1]) ** 2 / 2
    return jnp.sum(p**2 / 2 + (phi**2 - 1) ** 2 / 4) + jnp.sum(bonds)


# %% [markdown]
# ## Paths
#
# `BAOAB` is explicit, with one evaluation of all forces in a step. The fastest frequency is
# $\sqrt{4 \kappa + 2}$, about 8, so that steps must be below 0.25.

# %%
ts = jnp.linspace(0, 120, 61)
paths = ds.ensemble(
    ds.langevin_terms(energy, friction, T, (sites,)),
    ds.BAOAB(),
    t0=0,
    t1=120,
    dt0=0.05,
    y0=(jnp.zeros(sites), kink),
    key=jr.key(1),
    num_paths=400,
    ts=ts,
)
p, phi = paths.ys  # of shape (paths, times, sites)
print(f"temperature of the momenta: {np.mean(p[:, 20:] ** 2):.4f} for {T}")

# %% The field of one path
fig, ax = plt.subplots(figsize=(5, 2.5))
picture = ax.imshow(phi[0].T, aspect="auto", origin="lower", interpolation="nearest")
ax.set_xticks(range(0, 61, 10), [f"{ts[i]:g}" for i in range(0, 61, 10)])
ax.set(xlabel="t", ylabel="site")
fig.colorbar(picture)
plt.show()

# %% [markdown]
# ## Diffusion
#
# The kink is where the field changes its sign. Its mass is
# $M = \sum_i (\partial_x \phi)^2 = 2 \sqrt 2 / (3 \sqrt \kappa)$. It starts at rest, so
# that $\langle X^2 \rangle = 2 D (t - (1 - e^{-\gamma t})(3 - e^{-\gamma t}) / 2 \gamma)$.

# %%
place = -np.sum(np.sign(phi), axis=2) / 2
squares = np.mean(place**2, axis=0)
errors = np.std(place**2, axis=0) / np.sqrt(len(place))
M = 2 * np.sqrt(2) / 3 / np.sqrt(kappa)
decay = np.exp(-friction * ts)
late = ts - (1 - decay) * (3 - decay) / (2 * friction)
exact = 2 * T / (M * friction) * late

# %% The mean square of the displacement, and that of a particle of the mass M
fig, ax = plt.subplots(figsize=(5, 3))
ax.errorbar(ts, squares, errors, fmt=".", ms=3, label="kink")
ax.plot(ts, exact, "k", label="particle")
ax.set(xlabel="t", ylabel="mean square")
ax.legend(frameon=False)
plt.show()
print(f"at t = 120: {squares[-1]:.1f} ± {errors[-1]:.1f}, particle {exact[-1]:.1f}")

# %% [markdown]
# See also [lattices and fields](../lattices.md).
