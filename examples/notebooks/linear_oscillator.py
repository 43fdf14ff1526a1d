# %% [markdown]
# # A linear oscillator with additive noise
#
# A mass on a spring is kicked by white noise of strength $\sigma$: the position $q$ and
# the momentum $p$ follow
#
# $$\mathrm{d}p = -q\,\mathrm{d}t + \sigma\,\mathrm{d}w, \qquad
#   \mathrm{d}q = p\,\mathrm{d}t.$$
#
# The noise does work on the mass, so $\mathbb E(p^2 + q^2)$ grows by exactly $\sigma^2$
# per unit of time. A solver that adds growth of its own heats the oscillator, and in long
# runs this spurious heating exceeds the real one.
#
# This is the first test model of [Wang, Hong and Xu
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
# The system is Hamiltonian, with the energy $H_0 = (p^2 + q^2)/2$ and the noise
# Hamiltonian $H_1 = -\sigma q$. We take $\sigma = 1$, start at $p = 1$, $q = 0$, and
# average 2,000 paths up to $t = 1000$ with long steps, $h = 0.2$.


# %%
def H0(t, p, q, args):
    return (p**2 + q**2) / 2


def H1(t, p, q, args):
    return -q


path = ds.FixedStepBrownianPath((), jr.key(0))
terms = ds.hamiltonian_terms(H0, H1, path)
y0 = (jnp.array(1.0), jnp.array(0.0))  # (p, q)
h, t1 = 0.2, 1000.0
ts = np.linspace(100, t1, 10)


def mean_square(solver):
    """E(p^2 + q^2) at the times `ts`, and its standard error."""
    paths = ds.ensemble(
        terms, solver, 0.0, t1, h, y0, key=jr.key(1), num_paths=2000, ts=ts
    )
    p, q = paths.ys
    square = p**2 + q**2
    return square.mean(axis=0), square.std(axis=0) / np.sqrt(len(square))


sampled = {
    "StormerVerlet": mean_square(ds.StormerVerlet()),
    "Heun": mean_square(diffrax.Heun()),
}

# %% Mean square against time: StormerVerlet follows the exact line, Heun leaves it
fig, ax = plt.subplots(figsize=(6, 3.5))
colours = {"StormerVerlet": "#009E73", "Heun": "#D55E00"}
ax.plot([0, t1], [1, 1 + t1], "k:", label="exact: $1 + t$")
for name, (mean, error) in sampled.items():
    ax.errorbar(ts, mean, 3 * error, fmt="o", ms=4, label=name, color=colours[name])
ax.set(xlabel="$t$", ylabel="$E[p^2 + q^2]$", title="bars of three standard errors")
ax.legend()
plt.show()

# %% [markdown]
# ## What fails, and why
#
# The system is linear, so one step maps the second moments to the next ones by a matrix,
# which `second_moment_map` computes without sampling. Its spectral radius is the factor
# by which a step amplifies the mean square, apart from what the noise adds. It should be
# 1.

# %%
moment_map = eqx.filter_jit(ds.second_moment_map)
for solver in (ds.StormerVerlet(), diffrax.Heun(), diffrax.Euler()):
    K = moment_map(terms, solver, 0.0, h, y0)
    growth = float(max(abs(np.linalg.eigvals(K))))
    print(f"{type(solver).__name__:13} factor - 1 = {growth - 1:9.1e}", end="")
    print(f"   after t = {t1:.0f}: {growth ** (t1 / h):.3g}")

# %% [markdown]
# A symplectic step preserves area in phase space, so it can't inflate all orbits: the
# factor is 1 up to rounding. Without noise, a step of Heun's method multiplies
# $p^2 + q^2$ by $1 + h^4/4$, and one of Euler's method by $1 + h^2$. Each factor is close
# to 1, but a long run multiplies thousands of them.
#
# `StormerVerlet` is explicit, like Heun's method, and evaluates the force once per step
# instead of twice. It has to resolve the oscillation, $\omega h < 2$. Implicit methods
# such as `ImplicitMidpoint` are stable at any step size.

# %% [markdown]
# ## Exercise
#
# How short do Heun's steps have to be for the factor up to $t = 1000$ to stay below 1.01?
# How many evaluations of the force is that, compared with the 5,000 of `StormerVerlet`?
#
# *Hint:* the factor is about $e^{h^3 t / 4}$. (Answer: $h \approx 0.034$, and about
# 59,000 evaluations.)
