# pyright: reportArgumentType=false
# %% [markdown]
# # A chain of spins at a temperature
#
# Classical Heisenberg spins, unit vectors $s_i$ with $H_0 = -J \sum_i s_i \cdot s_{i+1}$ on
# an open chain. By the Landau--Lifshitz equation with damping $\alpha$ and a random field
# at each spin they reach the density $e^{-H_0 / T}$, for which
# $\langle s_i \cdot s_{i+r} \rangle = u^r$ with $u = \coth(J / T) - T / J$ (Fisher, 1964).

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
# `spin_terms` takes Hamiltonians of the spins. The state of the solver is a pair of
# spinors, in which the midpoint rule keeps all lengths to rounding error.

# %%
spins, J, alpha = 16, 1.0, 0.5


def exchange(t, s, args):
    return -J * jnp.sum(s[1:] * s[:-1])


def random_fields(t, s, T):
    return jnp.sqrt(2 * alpha * T) * s  # one Hamiltonian for each noise


path = ds.WeakBrownianPath((spins, 3), jr.key(0))
terms = ds.spin_terms(exchange, random_fields, path, damping=alpha)
up = jnp.zeros((spins, 3)).at[:, 2].set(1.0)
ts = jnp.linspace(0, 30, 151)  # ends of steps: other times are interpolated
sol = diffrax.diffeqsolve(
    terms,
    ds.ImplicitMidpoint(),
    t0=0,
    t1=30,
    dt0=0.1,
    y0=ds.to_spinors(up),
    args=jnp.array(0.2),  # the temperature
    saveat=diffrax.SaveAt(ts=ts),
)
s = jax.vmap(ds.from_spinors)(sol.ys)
print(f"lengths: off by at most {np.max(abs(np.linalg.norm(s, axis=2) - 1)):.0e}")

# %% The vertical component of each spin
fig, ax = plt.subplots(figsize=(5, 2.5))
picture = ax.imshow(s[:, :, 2].T, aspect="auto", cmap="RdBu", interpolation="nearest")
ax.set_xticks(range(0, 151, 25), [f"{ts[i]:g}" for i in range(0, 151, 25)])
ax.set(xlabel="t", ylabel="spin")
fig.colorbar(picture)
plt.show()

# %% [markdown]
# ## Correlations
#
# The temperature is in `args`, so one compiled program serves all. Correlations are
# averaged over all pairs at the same distance.


# %%
def correlations(t, y, args):
    s = ds.from_spinors(y)
    return jnp.stack([jnp.mean(jnp.sum(s[r:] * s[:-r], axis=1)) for r in range(1, 6)])


temperatures = (0.2, 0.5, 1.0)
means = [
    ds.expectation(
        correlations,
        ds.spin_terms(exchange, random_fields, (spins, 3), damping=alpha),
        ds.ImplicitMidpoint(),
        t0=0,
        t1=30,
        dt0=0.2,
        y0=ds.to_spinors(up),
        args=jnp.array(T),
        key=jr.key(1),
        sampling=ds.IndependentPaths(400),
    )
    for T in temperatures
]

# %% Correlations against the distance, with the exact ones
fig, ax = plt.subplots(figsize=(5, 3.2))
r = np.arange(1, 6)
for T, mean in zip(temperatures, means):
    exact = (1 / np.tanh(J / T) - T / J) ** r
    ax.errorbar(r, mean.mean, mean.error, fmt="o", label=f"T = {T}")
    ax.plot(r, exact, "k", lw=0.8)
    print(f"T = {T}: {mean.mean[0]:.4f} ± {mean.error[0]:.4f}, exact {exact[0]:.4f}")
ax.set(xlabel="distance", ylabel="correlation")
ax.legend(frameon=False)
plt.show()

# %% [markdown]
# See also [spins and rigid bodies](../spins.md).
