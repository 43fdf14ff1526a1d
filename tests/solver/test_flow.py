"""`BAOAB` with a flow between its kicks and its bath: another solver, or a linear flow."""

import functools as ft

import diffrax
import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds

from ..drjit_here import needs_drjit
from ..families import slow_except
from ..picard import by_picard
from ..problems import as_friction, Given, one_step


KEY = jr.key(0)
N, GAMMA, T = 4, 0.6, 1.3
REST = jnp.arange(float(N))
MASSES = jnp.array([1.0, 2.0, 0.5, 1.0])
# A chain with free ends, of which one mode is at rest.
SPRINGS = 40 * (2 * np.eye(N) - np.eye(N, k=1) - np.eye(N, k=-1))
SPRINGS[0, 0] = SPRINGS[-1, -1] = 40
CHAIN = ds.linear_flow(SPRINGS, masses=MASSES, rest=REST)


def _stiff(t, p, q, args):
    return (
        jnp.sum(p**2 / MASSES) / 2 + (q - REST) @ jnp.asarray(SPRINGS) @ (q - REST) / 2
    )


def _soft(t, q, args):
    return jnp.sum(q**2) / 2 + jnp.sum(jnp.cos(q[1:] - q[:-1])) / 4


def _chain(slow=_soft, friction=GAMMA, temperature=T, path=None, **kwargs):
    path = ds.WeakBrownianPath((N,), KEY) if path is None else path
    if temperature is None:
        path = None
    return ds.langevin_terms(_stiff, friction, temperature, path, slow=slow, **kwargs)


FLOWS = {
    "midpoint": ds.BAOAB(ds.ImplicitMidpoint()),
    "Verlet": ds.BAOAB(ds.StormerVerlet(), steps=3),
    "Cayley": ds.BAOAB(CHAIN),
}
START = jnp.array([0.3, -0.4, 0.1, 0.5]), REST + jnp.array([0.1, -0.2, 0.3, 0.2])


def _stationary(solver, terms, *hs):
    """The second moments of two momenta and of two positions that steps of each size
    keep."""
    y0 = jnp.zeros(2), jnp.zeros(2)
    moment_map = jax.jit(lambda h: ds.second_moment_map(terms, solver, 0.0, h, y0))
    for h in hs:
        # Of a contraction, up to the constant moment.
        A = np.asarray(moment_map(h)) - np.eye(25)
        A[0] = np.eye(25)[0]
        moments = np.linalg.lstsq(A, np.eye(25)[0], rcond=None)[0].reshape(5, 5)
        yield moments[1:3, 1:3], moments[3:, 3:]


def _harmonic(slow):
    K = jnp.asarray([[90.0, -30.0], [-30.0, 50.0]])
    masses = jnp.array([1.0, 3.0])
    H0 = lambda t, p, q, args: jnp.sum(p**2 / masses) / 2 + q @ K @ q / 2
    friction = as_friction([[0.9, 0.3], [0.3, 0.5]])
    path = ds.WeakBrownianPath((2,), KEY)
    terms = ds.langevin_terms(H0, friction, T, path, slow=slow)
    return terms, K, masses, ds.linear_flow(K, masses=masses)


def test_the_flow_of_the_whole_energy_keeps_the_law_of_a_harmonic_system_exactly():
    # omega h = 70, friction gamma h = 6.
    terms, K, masses, flow = _harmonic(None)
    for solver in (ds.BAOAB(ds.ImplicitMidpoint()), ds.BAOAB(flow)):
        ((pp, qq),) = _stationary(solver, terms, 7.0)
        np.testing.assert_allclose(pp, T * np.diag(masses), atol=2e-8)
        np.testing.assert_allclose(qq, T * np.linalg.inv(K), atol=2e-8)


def test_a_harmonic_slow_force_leaves_an_error_of_order_two_or_by_cayleys_angles_none():
    # Of positions. The angle of two half steps is that of the midpoint rule, with which
    # kicks of a linear force keep the law of positions.
    slow = lambda t, q, args: 2 * (q[0] - 0.5 * q[1]) ** 2
    terms, K, _, flow = _harmonic(slow)
    exact = T * np.linalg.inv(K + 4 * np.array([[1, -0.5], [-0.5, 0.25]]))

    def errors(solver, *hs):
        found = _stationary(solver, terms, *hs)
        return [np.max(abs(qq - exact)) for _, qq in found]

    long, short = errors(FLOWS["Verlet"], 0.1, 0.05)
    assert 1.95 < np.log2(long / short) < 2.05
    assert max(errors(ds.BAOAB(flow), 0.05, 0.4, 0.8)) < 1e-12


@pytest.mark.parametrize("name", slow_except(["midpoint", "Cayley"], FLOWS))
def test_a_step_is_symplectic_without_friction_leads_back_and_has_order_two(name):
    terms = _chain(friction=0.0, temperature=None)
    solver, h = FLOWS[name], 0.3
    if name == "midpoint":
        # Longer steps need Newton's method.
        solver, h = ds.BAOAB(by_picard(ds.ImplicitMidpoint())), 0.05
    defect = jax.jit(lambda y: ds.symplecticity_defect(terms, solver, 0.0, h, y))
    assert defect(START) < 1e-13
    there = jax.jit(lambda h, y: one_step(solver, terms, h, y, 0.0))
    back = there(-0.05, there(0.05, START))
    for x, y in zip(back, START):
        np.testing.assert_allclose(x, y, atol=1e-13)
    # One step against two of half the size: the difference is of the third order.
    gaps = []
    for h in (0.02, 0.01):
        two = there(h / 2, there(h / 2, START))
        gaps.append(max(np.max(abs(x - y)) for x, y in zip(there(h, START), two)))
    assert 2.7 < np.log2(gaps[0] / gaps[1]) < 3.3


def test_other_solvers_take_the_slow_potential_as_a_part_of_the_energy():
    whole = lambda t, p, q, args: _stiff(t, p, q, args) + _soft(t, q, args)
    path = ds.WeakBrownianPath((N,), KEY)
    both = _chain(), ds.langevin_terms(whole, GAMMA, T, path)
    conservative = ds.hamiltonian_terms(_stiff, slow=_soft), ds.hamiltonian_terms(whole)
    cases = (
        (ds.BAOAB(), both),
        (diffrax.Heun(), both),
        (ds.StormerVerlet(), conservative),
    )
    ends = lambda y0: [
        [one_step(solver, terms, 0.05, y0) for terms in pair] for solver, pair in cases
    ]
    for got, expected in jax.jit(ends)(START):
        np.testing.assert_allclose(got, expected, rtol=1e-12)


@needs_drjit
def test_a_fused_kernel_takes_the_same_paths():
    given = _chain(path=(N,)), FLOWS["Cayley"], 0, 1, 0.1, START
    run = lambda engine: ds.ensemble(*given, key=KEY, num_paths=16, engine=engine)
    for x, y in zip(run("drjit").ys, run("jax").ys):
        np.testing.assert_allclose(x, y, rtol=1e-11, atol=1e-12)


def test_single_precision_stays_single():
    y0 = tuple(x.astype(jnp.float32) for x in START)
    struct = jax.ShapeDtypeStruct((N,), jnp.float32)
    terms = _chain(path=ds.FixedStepBrownianPath(struct, KEY))
    step = lambda y0: one_step(FLOWS["Cayley"], terms, jnp.float32(0.1), y0)
    assert jax.eval_shape(step, y0) == (struct, struct)


def test_one_step_keeps_the_law_of_gibbs_of_masses_at_positions_to_second_order():
    # The angle between two rods of three equal masses. By quadrature over the law of Gibbs
    # and the noise, without sampling. The change of a mean in a step, over h, has the order
    # of the law that the step keeps.
    T = 0.8
    mass = lambda q: (4 - jnp.cos(q) ** 2) / 3
    potential = lambda q: 3 * (1 - jnp.cos(q + 1))
    H0 = lambda t, p, q, args: p**2 / mass(q) / 2 + potential(q)
    terms = lambda path: ds.langevin_terms(H0, lambda t, q, args: mass(q), T, path)
    normal, weights = np.polynomial.hermite_e.hermegauss(10)
    angles = np.pi * np.linspace(-1, 1, 60, endpoint=False)
    density = mass(angles) ** 0.5 * np.exp(-potential(angles) / T)
    weight = np.einsum("i,j,k->ijk", density, weights, weights).ravel()
    weight = weight / weight.sum()
    axes = np.meshgrid(angles, normal, normal, indexing="ij")
    q, number, noise = [jnp.asarray(axis.ravel()) for axis in axes]
    p = number * (T * mass(q)) ** 0.5
    observed = lambda y: y[0] * jnp.stack([jnp.sin(y[1]), jnp.cos(y[1])])

    def changes(solver, hs):
        @jax.jit
        @ft.partial(jax.vmap, in_axes=(None, 0, 0, 0))
        def change(h, p, q, w):
            y1 = one_step(solver, terms(Given(w * h**0.5)), h, (p, q))
            return observed(y1) - observed((p, q))

        return [weight @ np.asarray(change(h, p, q, noise)) / h for h in hs]

    midpoint = by_picard(ds.ImplicitMidpoint())
    long, short = changes(ds.BAOAB(midpoint), (0.1, 0.05))
    assert np.all(abs(long / short - 4) < 0.25)
    (other,) = changes(midpoint, (0.05,))
    assert np.max(abs(other)) > 3 * np.max(abs(short))


def test_a_linear_flow_is_half_a_step_of_the_midpoint_rule():
    # Whose step is Cayley's transform, of which these are the square root.
    terms, h = ds.hamiltonian_terms(_stiff), 1.0
    flow = jax.jit(lambda *x: CHAIN(*x))
    half = flow(h / 2, START, None)
    expected = one_step(ds.ImplicitMidpoint(), terms, h, START)
    for x, y in zip(flow(h / 2, half, None), expected):
        np.testing.assert_allclose(x, y, atol=1e-11)
    energies = [_stiff(0.0, *y, None) for y in (START, half)]
    np.testing.assert_allclose(energies[1], energies[0], rtol=1e-13)
    # Modes at rest drift.
    p, q = MASSES * 0.7, REST + 3.0
    moved = flow(0.5, (p, q), None)
    np.testing.assert_allclose(moved, (p, q + 0.35), atol=1e-13)
    # Modes that are given are those of the matrix.
    n, k = 6, 5.0
    K = k * (2 * np.eye(n) - np.roll(np.eye(n), 1, 0) - np.roll(np.eye(n), -1, 0))
    fourier = ds.linear_flow(
        frequencies=2 * k**0.5 * np.sin(np.pi * np.arange(n // 2 + 1) / n),
        to_modes=jnp.fft.rfft,
        from_modes=lambda x: jnp.fft.irfft(x, n),
    )
    y = jnp.arange(6.0), jnp.cos(jnp.arange(6.0))
    flows = jax.jit(lambda y: [x(0.3, y, None) for x in (fourier, ds.linear_flow(K))])
    np.testing.assert_allclose(*flows(y), atol=1e-13)


def test_thermometers_show_what_a_step_leaves_of_the_temperature():
    # Of positions and of momenta, by second moments, without sampling.
    terms, K, masses, flow = _harmonic(None)
    phi = ds.equipartition(terms)
    for solver, h in ((ds.BAOAB(flow), 0.5), (ds.BAOAB(), 0.05)):
        ((pp, qq),) = _stationary(solver, terms, h)
        # Of a quadratic form the mean is that over the columns of the roots.
        columns = [jnp.asarray(np.linalg.cholesky(x).T * 2**0.5) for x in (pp, qq)]
        found = jax.vmap(lambda *y: phi(0.0, y, None))(*columns)
        means = {name: np.mean(values) for name, values in found.items()}
        np.testing.assert_allclose(means["configurational"], T, rtol=1e-9)
        if solver == ds.BAOAB():
            assert means["kinetic"] < 0.99 * T
        else:
            np.testing.assert_allclose(means["kinetic"], T, rtol=1e-9)
    with pytest.raises(ValueError, match="takes no constrained terms"):
        on_a_sphere = lambda q, args: jnp.sum(q**2, keepdims=True) - 14.0
        ds.equipartition(_chain(slow=None, constraint=on_a_sphere))


def _call(solver, terms=None, y0=START):
    terms = _chain() if terms is None else terms
    return lambda: solver.init(terms, 0.0, 0.1, y0, None)


def _divides_by_zero(time, y, args):
    """A mode of frequency zero, without a case for it."""
    p, q = y
    return p, q + jnp.sin(0.0 * time) / jnp.zeros(N) * p


# Friction that sees no velocity.
SEES_NOTHING = ds.langevin_terms(
    lambda t, p, q, args: 0.0 * jnp.sum(q), 1.0, T, ds.WeakBrownianPath((N,), KEY)
)


@pytest.mark.parametrize(
    "call, said",
    [
        (_call(ds.BAOAB(CHAIN), SEES_NOTHING), "Pass the whole Hamiltonian.*slow="),
        (_call(ds.BAOAB(_divides_by_zero)), "returned NaN"),
        (lambda: ds.BAOAB(diffrax.Heun()), "solver of this package.* got `Heun`"),
        (lambda: ds.BAOAB(3.0), "flow"),
        (lambda: ds.BAOAB(steps=0), "`steps`"),
        (lambda: ds.BAOAB(steps=2), "those of a solver: pass one as `flow`"),
        (lambda: ds.BAOAB(CHAIN, steps=2), "those of a solver"),
        (_call(ds.BAOAB(lambda time, y, args: y[0])), "must return a pair like the state"),
        (_call(FLOWS["midpoint"], ds.hamiltonian_terms(_stiff)), "takes friction on"),
        (lambda: _chain(slow=lambda t, p, q, args: 0.0), "`slow`"),
        (lambda: ds.linear_flow(np.array([[1.0, 2.0], [0.0, 1.0]])), "symmetric"),
        (lambda: ds.linear_flow(-np.eye(2)), "negative eigenvalue -1"),
        (lambda: ds.linear_flow(np.ones((2, 3))), r"shape of `q` twice.* got \(2, 3\)"),
        (lambda: ds.linear_flow(np.eye(2), masses=[1.0, 0.0]), "`masses` must be positive"),
        (lambda: ds.linear_flow(), "Pass either `stiffness`, or `frequencies`"),
        (lambda: ds.linear_flow(np.eye(2), frequencies=[1.0]), "Pass either"),
    ],
)  # fmt: skip
def test_bad_input_is_told(call, said):
    with pytest.raises(ValueError, match=said):
        call()
