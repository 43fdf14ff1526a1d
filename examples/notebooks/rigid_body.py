# pyright: reportArgumentType=false, reportCallIssue=false
# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false
# %% [markdown]
# # A rigid body with noise
#
# A free rigid body with the moments of inertia $I_1, I_2, I_3$ is turned at random about
# each of its axes. (A random torque would change $|X|$.) In the frame of the body, its
# angular momentum $X \in \mathbb R^3$ follows
#
# $$\mathrm{d}X = X \times \nabla H_0(X)\,\mathrm{d}t + \mu \sum_k X \times e_k \circ
#   \mathrm{d}w_k, \qquad H_0 = \sum_i \frac{X_i^2}{2 I_i}.$$
#
# Both terms rotate $X$, so $|X|$ is constant on every path, while the noise changes the
# energy $H_0$. The flow is also a *Poisson map*: it preserves the bracket
# $\{X_1, X_2\} = -X_3$, as the flow of a canonical pair $(p, q)$ preserves area.
#
# In the fourth test model of [Wang, Hong and Xu
# (2017)](https://doi.org/10.4208/cicp.261014.230616a) the random turns are about the
# first axis only.

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
# `spin_terms` represents $X$ by a pair $(p, q)$ of vectors in $\mathbb R^2$. `to_spinors`
# and `from_spinors` convert between the two. Every symplectic solver for general systems
# is then a Poisson integrator. For comparison we also write the system as plain Diffrax
# terms for $X$.

# %%
inertia = jnp.array([0.8, 0.6, 0.2])
mu = jnp.array(0.2)


def H0(t, X, args):
    return jnp.sum(X**2 / inertia) / 2


def noise(t, X, mu):
    return mu * X  # one noise about each axis


path = ds.ImplicitMidpoint().path((3,), jr.key(0))
terms = ds.spin_terms(H0, noise, path)

drift = lambda t, X, args: jnp.cross(X, X / inertia)
diffusion = lambda t, X, mu: mu * jnp.cross(X, jnp.eye(3)).T
plain = diffrax.MultiTerm(diffrax.ODETerm(drift), diffrax.ControlTerm(diffusion, path))

X0 = jnp.array([np.cos(1.1), 0.0, np.sin(1.1)])
h, steps = 0.1, 500


@eqx.filter_jit
def solve(terms, solver, y0, mu, fn=lambda X: X):
    saveat = diffrax.SaveAt(t0=True, steps=1, fn=lambda t, y, args: fn(y))
    sol = diffrax.diffeqsolve(
        terms, solver, 0.0, h * steps, h, y0, mu, saveat=saveat, max_steps=steps
    )
    return sol.ts, sol.ys


y0 = ds.to_spinors(X0)
ts, X = solve(terms, ds.ImplicitMidpoint(), y0, mu, ds.from_spinors)
_, X_heun = solve(plain, diffrax.Heun(), X0, mu)

# %% A path on the sphere, and the change of the length of X in time
fig = plt.figure(figsize=(6, 7))
ax = fig.add_subplot(2, 1, 1, projection="3d")
blue, vermilion = "#0072B2", "#D55E00"
ax.plot(*X.T, ".", ms=2, color=blue)
ax.set(title="ImplicitMidpoint with spin_terms", aspect="equal")
ax = fig.add_subplot(2, 1, 2)
error = lambda X: abs(np.linalg.norm(X, axis=1) - 1) + 1e-17
ax.semilogy(ts, error(X), color=blue, label="ImplicitMidpoint with spin_terms")
ax.semilogy(ts, error(X_heun), color=vermilion, ls="--", label="Heun")
ax.set(xlabel="$t$", ylabel="$||X| - 1|$")
ax.legend(loc="center right")
fig.tight_layout()
plt.show()

# %% [markdown]
# ## What fails, and why
#
# A step of Heun's method is not a rotation, so the path leaves the sphere. One remedy is
# to divide $X$ by its length after each step; another is the midpoint rule applied to
# $X$, which conserves the length by itself. Both stay on the sphere, but neither is a
# Poisson map. `poisson_defect` measures how far one step is from preserving the bracket.

# %%
cases = {
    "ImplicitMidpoint with spin_terms": (terms, ds.ImplicitMidpoint(), y0),
    "ImplicitMidpoint for X": (plain, ds.ImplicitMidpoint(), X0),
    "Heun for X": (plain, diffrax.Heun(), X0),
}
poisson_defect = eqx.filter_jit(ds.poisson_defect)
for name, (system, solver, start) in cases.items():
    defect = poisson_defect(system, solver, 0.0, h, start, mu)
    print(f"{name:33} Poisson defect {defect:.1e}")

# %% [markdown]
# A Poisson integrator also keeps the energy close to its initial value in long runs
# without noise, where the exact energy is constant. Heun's method with $X$ renormalized
# does not, although every point lies on the sphere. (The midpoint rule for $X$ conserves
# the energy of this body, but only because it is quadratic.)


# %%
def renormalized_heun(X, _):
    k1 = drift(0.0, X, None)
    k2 = drift(0.0, X + h * k1, None)
    X = X + h / 2 * (k1 + k2)
    X = X / jnp.linalg.norm(X)
    return X, X


_, X_renormalized = jax.lax.scan(renormalized_heun, X0, None, length=steps)
_, X_silent = solve(terms, ds.ImplicitMidpoint(), y0, 0 * mu, ds.from_spinors)

# %% Energy without noise: within a narrow band with spin_terms, drifting with Heun
energy = jax.vmap(lambda X: H0(0.0, X, None))
fig, ax = plt.subplots(figsize=(6, 3.2))
label = "ImplicitMidpoint with spin_terms"
ax.plot(ts, energy(X_silent), color=blue, label=label)
label = "Heun, renormalized"
ax.plot(ts[1:], energy(X_renormalized), color=vermilion, ls="--", label=label)
ax.set(xlabel="$t$", ylabel="$H_0$ without noise")
ax.legend()
plt.show()

# %% [markdown]
# ## Exercise
#
# With noise about each axis all directions of $X$ are equally likely after a long time,
# so that $\mathbb E X_i^2$ tends to 1/3. What does the mean energy tend to? Check your
# result with `ds.ensemble`, 2,000 paths and $t = 100$. (Answer:
# $(1/I_1 + 1/I_2 + 1/I_3)/6 = 1.319$.)
