"""What the package uses of other packages that they do not promise to keep. If one of these
tests fails after an upgrade, its name says what broke; other failures follow from it."""

import diffrax
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic import _compat
from diffrax_symplectic._programs import compiled
from diffrax_symplectic._stablehlo import array_types

from .drjit_here import needs_drjit


class Seen(Exception):
    """What a solver gets has been seen: no step is needed."""


def test_diffrax_wraps_the_terms_of_a_solve_with_its_direction():
    """If this fails: find what `diffeqsolve` wraps terms in, and adapt `unwrapped`,
    `direction` and `reversed_in_time`."""

    class Spy(diffrax.Euler):
        def init(self, terms, t0, t1, y0, args):
            raise Seen(terms)

    drift = diffrax.ODETerm(lambda t, y, args: -y)
    with jax.disable_jit(), jax.ensure_compile_time_eval():
        with pytest.raises(Seen) as info:
            diffrax.diffeqsolve(drift, Spy(), 1.0, 0.0, -0.5, jnp.ones(2))
    (seen,) = info.value.args
    assert type(seen) is not type(drift) and _compat.unwrapped(drift) is drift
    assert type(_compat.unwrapped(seen)) is type(drift)
    assert _compat.direction(seen) == -1 and _compat.direction(drift) == 1
    other = _compat.wrapped_like(seen, drift)
    assert _compat.direction(other) == -1 and _compat.unwrapped(other) is drift
    assert _compat.wrapped_like(drift, drift) is drift
    turned = _compat.reversed_in_time({"drift": seen})
    assert _compat.direction(turned) == 1
    assert type(turned["drift"]) is type(seen)


def test_a_control_term_keeps_what_it_was_given_in_place_of_a_path():
    """If this fails: find where Diffrax keeps it, and adapt `not_a_path`."""
    field = lambda t, y, args: jnp.ones(3)
    assert _compat.not_a_path(diffrax.ControlTerm(field, (3,))) == (3,)
    for path in (ds.WeakBrownianPath((3,), jax.random.key(0)), lambda t0, t1: t1 - t0):
        assert _compat.not_a_path(diffrax.ControlTerm(field, path)) is None


def test_the_resolution_of_a_tree_is_the_tolerance_that_it_was_given():
    """If this fails: find how Diffrax stores `tol`, and adapt `resolution`."""
    tree = diffrax.VirtualBrownianTree(1.0, 5.0, 1e-3, (), jax.random.key(0))
    assert jnp.allclose(_compat.resolution(tree), 1e-3)


def test_equinox_refuses_derivatives_of_what_is_nondifferentiable():
    """If this fails: write it by `jax.custom_jvp`, with a rule that raises."""
    f = lambda x: _compat.nondifferentiable(x, name="t")
    assert f(2.0) == 2.0
    with pytest.raises(RuntimeError, match="t"):
        jax.jvp(f, (2.0,), (1.0,))


def test_values_are_told_from_traced_ones():
    """If this fails: find the class of traced values in `jax`, or try `np.asarray`, which
    raises for them."""
    seen = []
    jax.jit(lambda x: seen.append(_compat.is_traced(x)))(1.0)
    assert seen == [True]
    assert not any(map(_compat.is_traced, (1.0, jnp.ones(2), "traced")))


def test_the_default_generator_is_known_by_its_name():
    """If this fails: words of a step are drawn by folding keys, which is slower and gives
    other numbers for the same key. Find the new name of Threefry."""
    assert _compat.is_threefry(jax.random.key(0, impl="threefry2x32"))
    assert not _compat.is_threefry(jax.random.key(0, impl="rbg"))


def test_results_of_all_solves_are_told_from_other_values():
    """If this fails: find the class of the results of Equinox's enumerations."""
    for results in (diffrax.RESULTS, optx.RESULTS, lx.RESULTS):
        assert _compat.is_result(results.successful)
    assert not any(map(_compat.is_result, (1, jnp.ones(2), "successful")))


def test_a_program_may_have_compiler_options_unless_it_is_inside_of_another():
    double = compiled(lambda x: 2 * x, quickly=True)
    x = jnp.ones(())
    assert double(x) == 2
    assert jax.jit(double)(x) == 2

    def captured(x):
        return compiled(lambda y: x * y, quickly=True)(2.0)

    assert jax.grad(captured)(x) == 2


def test_a_function_with_an_error_of_its_own_is_called_once():
    calls = []

    def wrong(x):
        calls.append(x)
        raise ValueError("other")

    with pytest.raises(ValueError, match="other"):
        compiled(wrong, quickly=True)(jnp.ones(()))
    assert len(calls) == 1


@needs_drjit
def test_drjit_knows_the_values_of_constants_and_of_what_follows_from_them():
    """If this fails: find how an array of Dr.Jit tells its state, and adapt `is_literal`.
    Without it loops are not unrolled, and zeros are not left out."""
    number = array_types()["f64"]
    assert _compat.is_literal(number(2)) and _compat.is_literal(2 * number(2) + 1)
    assert not _compat.is_literal(number([1, 2]))
    pair = array_types()["complex<f64>"]
    assert _compat.is_literal(pair(1, 2))
    assert not _compat.is_literal(pair(1, number([1, 2])))


def test_the_versions_with_calls_of_lapack_that_block_each_other(monkeypatch):
    """If this fails: adapt `has_blocking_lapack` to how JAX writes its version."""
    known = {(0, 9, 2): False, (0, 10, 0): True, (0, 10, 2): True, (0, 11, 2): False}
    for version, blocking in known.items():
        monkeypatch.setattr(jax, "__version_info__", version)
        on_cpu = jax.default_backend() == "cpu"
        assert _compat.has_blocking_lapack() == (blocking and on_cpu)
