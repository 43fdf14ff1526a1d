"""Problems that several tests share."""

import functools as ft
from collections.abc import Callable

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.random as jr
import lineax as lx
import numpy as np
from jaxtyping import PyTree

import diffrax_symplectic as ds


def as_friction(matrix):
    """A symmetric positive semidefinite matrix, as `langevin_terms` takes it."""
    return lx.MatrixLinearOperator(jnp.asarray(matrix), lx.positive_semidefinite_tag)


class TrigonometricSum:
    """`H(p, q) = sum_j a_j cos(u_j . p + v_j . q + phi_j)`: smooth, bounded, and with no
    structure. The coefficients are `args[name]`, with a leading axis for the noises."""

    def __init__(self, name: str):
        self.name = name

    def __call__(self, t, p, q, args):
        a, u, v, phi = args[self.name]
        phase = jnp.einsum("...jd,d->...j", u, p) + jnp.einsum("...jd,d->...j", v, q)
        return jnp.sum(a * jnp.cos(phase + phi + t), axis=-1)


def _coefficients(key, noises, d: int, size: float, dtype):
    ka, ku, kv, kp = jr.split(key, 4)
    shape = noises + (4,)
    return (
        size * jr.normal(ka, shape, dtype),
        jr.normal(ku, shape + (d,), dtype),
        jr.normal(kv, shape + (d,), dtype),
        jr.uniform(kp, shape, dtype, 0, 2 * np.pi),
    )


H0 = TrigonometricSum("drift")
noise = TrigonometricSum("noise")


# One program in place of one for each operation.
compiled = ft.partial(jax.jit, static_argnums=(1, 2, 3))


@compiled
def random_problem(key, d: int, m: int, dtype=jnp.float64) -> tuple[PyTree, PyTree]:
    """A random state and random `args` for `H0` and `noise`."""
    kd, kn, ky = jr.split(key, 3)
    args = {
        "drift": _coefficients(kd, (), d, 0.5, dtype),
        "noise": _coefficients(kn, (m,), d, 0.2, dtype),
    }
    p, q = jr.normal(ky, (2, d), dtype)
    return (p, q), args


class System(eqx.Module):
    """Random systems of one structure, the parameters in `args`."""

    H0: Callable = eqx.field(static=True)
    noise: Callable = eqx.field(static=True)
    random: Callable = eqx.field(static=True)

    def draw(self, key, d: int, m: int, dtype, kind="others", strength=1.0):
        """A state and `args`: with `"one"` noise, the others being of size zero, with two
        that are `"commuting"`, or with any `"others"`, which are multiplied by
        `strength`."""
        y0, args = self.random(key, d, m, dtype)
        sizes = jnp.ones(m, dtype)
        if kind == "one":
            sizes = sizes.at[1:].set(0)
        args["sizes"] = strength * sizes
        args["commuting"] = jnp.zeros((), dtype)
        if kind == "commuting" and self is SYSTEMS["any"]:
            args["sizes"], args["commuting"] = 0 * sizes, jnp.ones((), dtype)
        return y0, args

    def terms(self, path, sizes=(1.0, 1.0), commuting=False):
        """Drift and noise, multiplied by `sizes`; with those that commute, if asked for."""
        drift, noise = sizes

        def noises(t, p, q, args):
            own = args["sizes"] * self.noise(t, p, q, args)
            if not commuting or self is not SYSTEMS["any"]:
                return noise * own
            # Two functions of one function, for the first two noises.
            G = jnp.sum(p**2 / 2 + jnp.cos(q) + p * q / 2)
            both = args["commuting"] * jnp.stack([0.4 * jnp.sin(G), 0.3 * G])
            return noise * (own + jnp.zeros_like(own).at[:2].set(both[: len(own)]))

        H0 = lambda t, p, q, args: drift * self.H0(t, p, q, args)
        return ds.hamiltonian_terms(H0, noises, path)


def _potential(t, q, a, v, phi):
    return jnp.sum(a * jnp.cos(v @ q + phi + t), axis=-1)


def separable_H0(t, p, q, args):
    a, u, v, phi = args["drift"]
    kinetic = jnp.sum(a * jnp.sin(u @ p)) + jnp.sum(p**2) / 2
    return kinetic + _potential(t, q, a, v, phi)


def separable_noise(t, p, q, args):
    a, v, phi = args["noise"]
    return jax.vmap(lambda a, v, phi: _potential(t, q, a, v, phi))(a, v, phi)


@compiled
def separable_problem(key, d, m, dtype=jnp.float64):
    ks = jr.split(key, 8)
    draw = lambda i, *shape: jr.normal(ks[i], shape, dtype)
    args = {
        "drift": (0.5 * draw(0, 4), draw(1, 4, d), draw(2, 4, d), draw(3, 4)),
        "noise": (0.3 * draw(4, m, 4), draw(5, m, 4, d), draw(6, m, 4)),
    }
    p, q = jr.normal(ks[7], (2, d), dtype)
    return (p, q), args


def constant_noise(t, p, q, args):
    return -args["sigma"] @ q + args["gamma"] @ p


def constant_forces(t, p, q, args):
    return -args["sigma"] @ q


def moving_noise(t, p, q, args):
    sigma, gamma = args["sigma"], args["gamma"]
    return -jnp.cos(2 * t) * (sigma @ q) + jnp.exp(-t) * (gamma @ p)


@compiled
def additive_problem(key, d, m, dtype=jnp.float64):
    k_drift, k_sigma, k_gamma = jr.split(key, 3)
    y0, args = random_problem(k_drift, d, m, dtype)
    sigma = 0.5 * jr.normal(k_sigma, (m, d), dtype)
    gamma = 0.5 * jr.normal(k_gamma, (m, d), dtype)
    return y0, {"drift": args["drift"], "sigma": sigma, "gamma": gamma}


@compiled
def constant_problem(key, d, m, dtype=jnp.float64):
    y0, args = separable_problem(key, d, m, dtype)
    sigma = 0.5 * jr.normal(jr.fold_in(key, 1), (m, d), dtype)
    return y0, {"drift": args["drift"], "sigma": sigma}


SYSTEMS = {
    "any": System(H0, noise, random_problem),
    "separable": System(separable_H0, separable_noise, separable_problem),
    "additive": System(H0, moving_noise, additive_problem),
    "constant": System(H0, constant_noise, additive_problem),
    "separable and constant": System(separable_H0, constant_forces, constant_problem),
}


class _AnyIncrement(diffrax.AbstractSpaceTimeLevyArea, ds.WeakIncrement):
    """An increment with everything that a solver may ask for."""

    H: PyTree = None
    K: PyTree = None
    C: PyTree = None
    A: PyTree = None


class Given(diffrax.AbstractBrownianPath):
    """An increment drawn beforehand, the same over every step."""

    W: jax.Array
    H: jax.Array | None = None
    second: jax.Array | None = None
    third: jax.Array | None = None
    C: jax.Array | None = None
    A: jax.Array | None = None
    two_point: jax.Array | None = None
    K: jax.Array | None = None
    t0 = -jnp.inf
    t1 = jnp.inf
    levy_area = _AnyIncrement

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        if not use_levy:
            return self.W
        return _AnyIncrement(
            dt=t1 - t0,
            W=self.W,
            second=self.second,
            two_point=self.two_point,
            third=self.third,
            H=self.H,
            K=self.K,
            C=self.C,
            A=self.A,
        )


class FineSample(diffrax.AbstractBrownianPath):
    """One Brownian path over [0, 1] by the values of `w` and of its integral over time on
    a fine grid, jointly Gaussian: coarse increments and areas are sums of fine ones."""

    w: jax.Array
    integral: jax.Array
    t0 = 0
    t1 = 1
    levy_area = diffrax.SpaceTimeLevyArea

    @staticmethod
    def draw(key, steps: int, m: int, dtype=jnp.float64) -> "FineSample":
        dw, H = jr.normal(key, (2, steps, m), dtype) / np.sqrt(steps)
        H = H / np.sqrt(12)
        from_zero = lambda x: jnp.concatenate([jnp.zeros_like(x[:1]), jnp.cumsum(x, 0)])
        w = from_zero(dw)
        return FineSample(w, from_zero((w[:-1] + dw / 2 + H) / steps))

    def evaluate(self, t0, t1=None, left=True, use_levy=False):
        i, j = (jnp.round(t * (len(self.w) - 1)).astype(int) for t in (t0, t1))
        W = self.w[j] - self.w[i]
        if not use_levy:
            return W
        h = t1 - t0
        mean = (self.integral[j] - self.integral[i]) / h - self.w[i]
        return diffrax.SpaceTimeLevyArea(dt=h, W=W, H=mean - W / 2)


def weak_path(m: int, key=None, dtype=jnp.float64, **kwargs):
    key = jr.key(0) if key is None else key
    return ds.WeakBrownianPath(jax.ShapeDtypeStruct((m,), dtype), key, **kwargs)


def kubo_terms(path, s=1.0):
    H0 = lambda t, p, q, args: (p**2 + q**2) / 2
    noise = lambda t, p, q, args: s * (p**2 + q**2) / 2
    return ds.hamiltonian_terms(H0, noise, path)


def rigid_body_terms(path, mu=0.1, inertia=(0.8, 0.6, 0.2)):
    """The rigid body with one noise, as plain Diffrax terms in three variables."""
    I1, I2, I3 = inertia

    def drift(t, X, args):
        X1, X2, X3 = X
        return jnp.stack(
            [
                (1 / I3 - 1 / I2) * X3 * X2,
                (1 / I1 - 1 / I3) * X3 * X1,
                (1 / I2 - 1 / I1) * X2 * X1,
            ]
        )

    def diffusion(t, X, args):
        _, X2, X3 = X
        return mu * jnp.stack([jnp.zeros_like(X2), X3, -X2])

    return diffrax.MultiTerm(
        diffrax.ODETerm(drift), diffrax.ControlTerm(diffusion, path)
    )


def damped_terms(H0, friction, noise=None, path=None) -> diffrax.MultiTerm:
    """The terms of a system with friction, and with other noise than that of a bath."""
    terms = ds.langevin_terms(H0, friction).terms
    if noise is not None:
        terms = *terms, ds.hamiltonian_terms(H0, noise, path).terms[1]
    return diffrax.MultiTerm(*terms)


def one_step(solver, terms, h, y0, t0=0.1):
    """The end of the first step of a solve."""
    state = solver.init(terms, t0, t0 + h, y0, None)
    return solver.step(terms, t0, t0 + h, y0, None, state, False)[0]


def slope(hs, errors):
    """The order that errors at several step sizes show, by least squares."""
    return np.polyfit(np.log(hs), np.log(np.abs(errors)), 1)[0]


def values_of_a_step(t, y, args):
    """Test functions of one degree of freedom."""
    p, q = y[0][0], y[1][0]
    return jnp.stack([p, q**2, p * q, jnp.sin(p + q), jnp.exp(p / 2)])


def over_steps(fn, hs, y0, args, batch=jax.vmap):
    """A function of step, state and `args` for all systems and then for all steps, in one
    `batch`: a batch of batches takes twice as long to compile."""
    number, count = len(jax.tree.leaves(y0)[0]), len(hs)
    systems = jax.tree.map(lambda x: jnp.repeat(x, count, axis=0), (y0, args))
    out = jax.jit(batch(fn))(jnp.tile(jnp.asarray(hs), number), *systems)
    return out.reshape(number, count, *out.shape[1:])


def one_after_another(fn):
    """As `jax.vmap`, for functions that make a batch of their own."""
    return lambda *x: jax.lax.map(lambda x: fn(*x), x)


def local_weak_orders(terms, solver, y0, args, hs, order: int, **kwargs) -> list[float]:
    """Slopes of the local weak defect over the steps `hs`, for a batch of systems and
    each of the functions above, or of those of `fn`."""

    def defect(h, y0, args):
        kw = dict(fn=values_of_a_step, order=order) | kwargs
        return ds.weak_order_defect(terms, solver, 0.1, 0.1 + h, y0, args, **kw)

    defects = np.asarray(over_steps(defect, hs, y0, args))
    return [slope(hs, d) for d in np.moveaxis(defects, 1, 2).reshape(-1, len(hs))]


class RecordingMeter(diffrax.AbstractProgressMeter):
    """Writes down what is asked of it."""

    calls: list
    # The number of a step, or "close".
    fails_at: int | str | None = None
    error: type[BaseException] = RuntimeError

    def init(self):
        self.calls.append("init")
        return 0

    def step(self, state, progress):
        self.calls.append(float(progress))
        if state == self.fails_at:
            raise self.error("stop here")
        return state + 1

    def close(self, state):
        self.calls.append(("closed after", state))
        if self.fails_at == "close":
            raise self.error("stop here")
