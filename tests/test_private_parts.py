"""What the package uses of other packages that they do not promise to keep. If one of these
tests fails after an upgrade, its name says what broke; other failures follow from it."""

import ast
import re
from pathlib import Path

import diffrax
import equinox.internal as eqxi
import jax
import jax.extend.random as jer
import jax.numpy as jnp
import lineax as lx
import lineax.internal as lxi
import pytest
from equinox.internal import ω

import diffrax_symplectic as ds


# Private modules, and public ones for internal use.
KNOWN = {
    "diffrax._term.WrapTerm",
    "equinox.internal",
    "equinox.internal.ω",
    "lineax.internal",
}


def test_no_further_private_parts_are_used():
    found = set()
    for file in Path(ds.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            if isinstance(node, ast.ImportFrom) and node.level == 0:
                found |= {f"{node.module}.{alias.name}" for alias in node.names}
    private = re.compile(r"\._(?!_)|\.internal|jax\.interpreters")
    assert {name for name in found if private.search(name)} == KNOWN


@pytest.fixture
def terms():
    H0, noise = (lambda t, p, q, args: p**2 / 2), (lambda t, p, q, args: q)
    path = ds.WeakBrownianPath((), jax.random.key(0))
    return ds.hamiltonian_terms(H0, noise, path)


def test_diffrax_wraps_the_terms_of_a_solve_backward_in_time(terms):
    seen = []

    class Spy(diffrax.Euler):
        def init(self, terms, t0, t1, y0, args):
            seen.append(terms)

    y0 = jnp.array(0.3), jnp.array(0.7)
    drift = terms.terms[0]
    jax.eval_shape(lambda: diffrax.diffeqsolve(drift, Spy(), 1.0, 0.0, -0.5, y0).ys)
    assert type(seen[0]) is diffrax._term.WrapTerm
    assert type(seen[0].term) is type(drift)
    assert diffrax._term.WrapTerm(drift, -1).direction == -1


def test_a_solve_of_diffrax_is_found_on_the_stack_with_its_controller(terms):
    y0 = jnp.array(0.3), jnp.array(0.7)
    adaptive = diffrax.PIDController(rtol=1e-3, atol=1e-3)
    with pytest.raises(ValueError, match="adaptive step size controller"):
        diffrax.diffeqsolve(
            terms, diffrax.Heun(), 0.0, 1.0, 0.1, y0, stepsize_controller=adaptive
        )


def test_omega_does_arithmetic_on_pytrees():
    x = {"a": jnp.array([1.0, 2.0]), "b": (jnp.array(3.0),)}
    y = (2 * x**ω - x**ω / 2).ω
    assert jnp.array_equal(y["a"], jnp.array([1.5, 3.0])) and y["b"][0] == 4.5


def test_equinox_refuses_derivatives_of_what_is_nondifferentiable():
    f = lambda x: eqxi.nondifferentiable(x, name="t")
    assert f(2.0) == 2.0
    with pytest.raises(RuntimeError, match="t"):
        jax.jvp(f, (2.0,), (1.0,))


def test_lineax_packs_the_structures_of_an_operator():
    operator = lx.MatrixLinearOperator(jnp.eye(2))
    structures = lxi.pack_structures(operator)
    vector = jnp.array([1.0, 2.0])
    ravelled = lxi.ravel_vector(vector, structures)
    turned = lxi.transpose_packed_structures(structures)
    for s in (structures, turned):
        assert jnp.array_equal(lxi.unravel_solution(ravelled, s), vector)
    assert lxi.default_floating_dtype() == jnp.float64


def test_jax_has_the_threefry_function_of_random123():
    # Known answer for the key and the counters 0 of its authors.
    words = jer.threefry_2x32(jnp.zeros(2, jnp.uint32), jnp.zeros(2, jnp.uint32))
    assert [hex(int(w)) for w in words] == ["0x6b200159", "0x99ba4efe"]
