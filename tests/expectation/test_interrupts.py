"""A call that takes long says what it is doing, and an interrupt loses no batch that was
finished, wherever it comes."""

import sys
import time

import jax.numpy as jnp
import jax.random as jr
import pytest

import diffrax_symplectic as ds
from diffrax_symplectic._expectation import progress as progress_module
from diffrax_symplectic._expectation.progress import NO_METER, Progress

from ..problems import RecordingMeter


# The functions of the same names hide their modules.
EXPECTATION = sys.modules["diffrax_symplectic._expectation.expectation"]
MONTE_CARLO = sys.modules["diffrax_symplectic._expectation.monte_carlo"]
TERMS = ds.hamiltonian_terms(
    lambda t, p, q, args: p**2 / 2 - jnp.cos(q), lambda t, p, q, args: 0.01 * q, ()
)


def _mean(num_paths=512, **options):
    y0 = jnp.array(0.0), jnp.array(1.0)
    sampling = ds.IndependentPaths(num_paths, 256)
    square = lambda t, y, args: y[1] ** 2
    given = square, TERMS, ds.StormerVerlet(), 0, 1, 0.5, y0
    return ds.expectation(*given, key=jr.key(0), sampling=sampling, **options)


def _interrupted(*args, **kwargs):
    raise KeyboardInterrupt


# Takes so long to close that the user interrupts it.
CLOSING = RecordingMeter([], "close", KeyboardInterrupt)


def _check_interrupted(call, num_paths):
    with pytest.raises(KeyboardInterrupt) as info:
        call()
    assert isinstance(info.value, ds.ExpectationInterrupted)
    assert info.value.estimate.num_paths == num_paths
    return info.value.estimate


@pytest.mark.parametrize(
    "name",
    ["is_finite_at_start", "cautions", "too_long_steps", "trial_with_finer_level"],
)
def test_an_interrupt_after_the_last_sample_keeps_all(name, monkeypatch):
    if name == "is_finite_at_start":
        # It is asked if most paths fail.
        monkeypatch.setattr(ds.Expectation, "num_failed", 1000)
    monkeypatch.setattr(EXPECTATION, name, _interrupted)
    _check_interrupted(_mean, 512)


def test_an_interrupt_while_the_meter_closes_or_a_user_is_warned_keeps_all(monkeypatch):
    # Later parts are not looked at.
    _check_interrupted(lambda: _mean(progress_meter=CLOSING, first=512), 512)
    draw = lambda **options: ds.monte_carlo(
        jr.normal, key=jr.key(0), num_paths=16, **options
    )
    _check_interrupted(lambda: draw(progress_meter=CLOSING), 16)
    monkeypatch.setattr(MONTE_CARLO, "cautions", _interrupted)
    _check_interrupted(draw, 16)


def test_an_interrupt_between_levels_keeps_the_finished_one(monkeypatch):
    choose = EXPECTATION.choose
    calls = iter([choose, _interrupted])
    interrupted_at_third_level = lambda *given: next(calls)(*given)

    whole = _mean(512, levels=2)
    monkeypatch.setattr(EXPECTATION, "choose", interrupted_at_third_level)
    # A third of the discretization error of two levels.
    tol = float(whole.discretization_error) / 3
    got = _check_interrupted(lambda: _mean(10**6, tol=tol), 256)
    assert got.levels == 2 and got.tol_reached is False
    monkeypatch.undo()
    assert _mean(512, start=got).mean == whole.mean


def test_an_interrupt_before_the_first_batch_is_a_plain_one(monkeypatch):
    monkeypatch.setattr(EXPECTATION, "choose", _interrupted)
    with pytest.raises(KeyboardInterrupt) as info:
        _mean()
    assert info.type is KeyboardInterrupt


def test_a_long_call_prints_one_line(monkeypatch, capsys):
    monkeypatch.setattr(progress_module, "_SECONDS_OF_SILENCE", 0.01)
    ds.monte_carlo(jr.normal, key=jr.key(0), num_paths=2**14, batch_size=2**10)
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("`monte_carlo` after 0 s: ")
    assert printed.err.count("\n") == 1


def test_the_line_says_what_is_being_done(monkeypatch, capsys):
    monkeypatch.setattr(progress_module, "_SECONDS_OF_SILENCE", 0.2)
    with Progress("expectation", NO_METER, "`levels=1`") as progress:
        progress.stage("sampling")
        progress.step(0.25)
        time.sleep(0.5)
    line = capsys.readouterr().err
    assert "sampling, 25% of the samples done" in line
    assert "pass `levels=1`" in line


def test_short_calls_and_calls_with_a_meter_print_nothing(monkeypatch, capsys):
    with Progress("expectation", NO_METER, ""):
        pass
    monkeypatch.setattr(progress_module, "_SECONDS_OF_SILENCE", 0.01)
    with Progress("expectation", RecordingMeter([]), ""):
        time.sleep(0.1)
    assert capsys.readouterr().err == ""
