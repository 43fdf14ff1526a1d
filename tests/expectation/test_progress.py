"""A call that takes long says what it is doing."""

import time

import jax.random as jr

import diffrax_symplectic as ds
from diffrax_symplectic._expectation import progress as progress_module
from diffrax_symplectic._expectation.progress import NO_METER, Progress

from ..problems import RecordingMeter


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
