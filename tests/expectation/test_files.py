"""A file holds an estimate as it was saved, or is refused."""

import io
import json
import os
import pickle
import random

import jax.random as jr
import numpy as np
import pytest

import diffrax_symplectic as ds


def _phi(key):
    return {"pair": jr.normal(key, (2,)), "rest": (jr.normal(key), None)}


@pytest.fixture(scope="module")
def estimate():
    return ds.monte_carlo(_phi, key=jr.key(0), num_paths=40, batch_size=16)


def _saved(estimate) -> bytes:
    file = io.BytesIO()
    estimate.save(file)
    return file.getvalue()


def _loaded(content: bytes) -> ds.Expectation:
    return ds.Expectation.load(io.BytesIO(content))


def test_an_estimate_comes_back_from_a_path_without_suffix_and_from_an_open_file(
    tmp_path, estimate
):
    estimate.save(tmp_path / "estimate")
    estimate.save(str(tmp_path / "estimate"))
    assert [*tmp_path.iterdir()] == [tmp_path / "estimate"]
    for got in (ds.Expectation.load(tmp_path / "estimate"), _loaded(_saved(estimate))):
        assert str(got) == str(estimate) and got.samples == estimate.samples
    with pytest.raises(FileNotFoundError, match="nothing"):
        ds.Expectation.load(tmp_path / "nothing")


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path, monkeypatch, estimate):
    file = tmp_path / "estimate.npz"
    estimate.save(file)
    before = file.read_bytes()
    replace, sync = os.replace, os.fsync
    done = []
    monkeypatch.setattr(os, "fsync", lambda fd: done.append("sync") or sync(fd))
    monkeypatch.setattr(os, "replace", lambda *of: done.append("move") or replace(*of))
    whole = np.savez

    def half(opened, **arrays):
        whole(opened, **arrays)
        opened.truncate(len(before) // 2)
        raise stop

    for stop in (OSError("disk full"), KeyboardInterrupt()):
        monkeypatch.setattr(np, "savez", half)
        with pytest.raises(type(stop)):
            estimate.save(file)
        assert file.read_bytes() == before and [*tmp_path.iterdir()] == [file]
    monkeypatch.setattr(np, "savez", whole)
    done.clear()
    estimate.save(file)
    assert done == ["sync", "move"] and [*tmp_path.iterdir()] == [file]


def test_a_damaged_file_is_read_as_it_was_or_refused(estimate):
    whole = _saved(estimate)
    rng = random.Random(0)
    damaged = [whole[:end] for end in range(0, len(whole), 37)]
    for place in range(0, len(whole), 11):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << rng.randrange(8)
        damaged.append(bytes(flipped))
    num_refused = 0
    for content in damaged:
        try:
            got = _loaded(content)
        except ValueError as error:
            num_refused += 1
            assert "is damaged, or was not written by" in str(error)
        else:
            assert str(got) == str(estimate) and got.samples == estimate.samples
    assert num_refused > len(damaged) / 2


def test_other_files_are_refused_without_advice_to_unpickle(tmp_path):
    objects = io.BytesIO()
    np.savez(objects, header=np.array([{}], object))
    single = io.BytesIO()
    np.save(single, np.ones(3))
    others = b"", b"mean 1.0\n" * 9, pickle.dumps({"mean": 1.0})
    for content in (*others, objects.getvalue(), single.getvalue()):
        (tmp_path / "other.npz").write_bytes(content)
        with pytest.raises(ValueError, match="other.npz is damaged, or was") as info:
            ds.Expectation.load(tmp_path / "other.npz")
        assert "pickle" not in str(info.value) and info.value.__suppress_context__


def _with_header(estimate, **changes) -> bytes:
    """A whole file, with other entries in its header, or without those that are `...`."""
    arrays = dict(np.load(io.BytesIO(_saved(estimate))))
    header = json.loads(str(arrays.pop("header"))) | changes
    header = {name: x for name, x in header.items() if x is not ...}
    file = io.BytesIO()
    np.savez(file, header=np.array(json.dumps(header)), **arrays)
    return file.getvalue()


RANGES = [[0, 32, 32, 0, [0]], [32, 40, 8, 0, [0]]]


@pytest.mark.parametrize(
    "changes",
    [
        *[{"ranges": [first, RANGES[1]]} for first in (
            [0, 32, -1, 0, [0]], [0, 32, 33, 0, [0]], [0, 32, 31, 33, [33]],
            [0, 32, 32, 0, [1]], [0, 33, 32, 0, [0]], [0, 32.0, 32, 0, [0]],
            [-8, 32, 32, 0, [0]], [0, 32, 32, 0, []], [0, 32, 32, 0, [0, 0]],
        )],
        {"ranges": []},
        {"ranges": [RANGES[0], [2**70, 2**70 + 8, 8, 0, [0]]]},
        {"ranges": [*RANGES, [40, 48, 8, 0, [0]]]},
        {"ranges": ...},
        {"paths_per_sample": 0},
        {"rounding_floor": -1},
        {"dtype": "int64"},
        {"num_times": 2},
        {"structure": {"array": []}},
        {"structure": {"tree": []}},
        {"averaged": ["value", "weight"]},
        {"fields": {"num_paths": -3}},
        {"sampling": ...},
    ],
    ids=str,
)  # fmt: skip
def test_a_header_that_no_estimate_has_is_refused(changes, estimate):
    assert str(_loaded(_with_header(estimate, ranges=RANGES))) == str(estimate)
    with pytest.raises(ValueError, match="is damaged, or was not written by"):
        _loaded(_with_header(estimate, **changes))


def test_what_is_no_file_is_refused_before_it_is_used(estimate):
    for use in (estimate.save, ds.Expectation.load):
        with pytest.raises(ValueError, match="`file` must be a path, or a file that"):
            use(3)  # pyright: ignore
