"""Estimates in files: arrays, and their structure as JSON."""

import dataclasses
import io
import json
import os
import secrets
import warnings
import zipfile
from pathlib import Path
from typing import Any, BinaryIO

import jax
import jax.numpy as jnp
import numpy as np

from ..._arguments import whole_number
from ..._simulation import Layout, level_weights
from ..sampling import Averaged, MOST_SAMPLES, SAVED_SAMPLINGS
from .moments import Moments


# The fields of `Moments` that are an `Averaged`.
_AVERAGED = ("mean", "norm", "largest", "size")
# The fields of an estimate that JSON takes as they are.
_FIELDS_OF_ESTIMATE = (
    "levels",
    "dtype",
    "paths_per_sample",
    "rounding_floor",
    "reason",
    "tol_reached",
    "caveat",
    "digests",
)


class OtherVersion(ValueError):
    """An estimate was written by a version that had more than this one."""


def write(
    file: str | Path | BinaryIO, header: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    """Writes a NumPy `.npz` file of arrays and a header. A file that is there already is
    replaced by the whole new one, or if anything fails kept as it is."""
    arrays = {**arrays, "header": np.array(json.dumps(header))}
    if not isinstance(file, str | Path):
        np.savez(file, **arrays)  # pyright: ignore
        return
    path = Path(file).resolve()
    # Several processes may save to one path.
    beside = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        with open(beside, "xb") as opened:
            np.savez(opened, **arrays)  # pyright: ignore
            opened.flush()
            os.fsync(opened.fileno())
        os.replace(beside, path)
    finally:
        beside.unlink(missing_ok=True)


def read(file: BinaryIO) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header and the arrays of a file that `write` wrote. Raises any error for another
    file."""
    arrays = {}
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            # This compares checksums, before anything is taken for an array.
            content = io.BytesIO(archive.read(name))
            # Objects are refused, so that no code is executed.
            array = np.lib.format.read_array(content, allow_pickle=False)
            arrays[name.removesuffix(".npy")] = array
    return json.loads(str(arrays.pop("header"))), arrays


def contents_of(estimate: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The arrays of an `Expectation` (whose module imports this one), and all else of it,
    for JSON. Raises a `ValueError` for PyTree nodes that JSON cannot express."""
    layout = estimate.layout
    sampling = estimate.sampling
    # A function, such as `sort_by`, is left out. Integers may be those of NumPy.
    fields_of_sampling = {
        name: int(x) if isinstance(x, np.integer) else x
        for name, x in ({} if sampling is None else vars(sampling)).items()
        if x is None or isinstance(x, int | float | str | np.integer)
    }
    structs = [jax.ShapeDtypeStruct(shape, float) for shape in layout.shapes]
    # All batches have the same fields.
    first, *_ = estimate.moments
    # The names here are those of the files.
    header = {
        "ranges": [
            [part.begin, part.end, part.num_good, part.num_failed, part.failed_on]
            for part in estimate.moments
        ],
        "structure": _structure_as_json(layout.treedef.unflatten(structs)),
        "num_times": layout.num_times,
        "averaged": list(first.mean.fields),
        "sampling": None if sampling is None else type(sampling).__name__,
        "fields": fields_of_sampling,
    }
    header |= {name: getattr(estimate, name) for name in _FIELDS_OF_ESTIMATE}
    # With axes for batches, fields, combinations of levels, and numbers.
    arrays = {
        name: np.array(
            [[*getattr(part, name).fields.values()] for part in estimate.moments]
        )
        for name in _AVERAGED
    }
    arrays["key_data"] = estimate.key_data
    if estimate.ts is not None:
        arrays["ts"] = estimate.ts
    return header, arrays


def fields_from(
    header: dict[str, Any], arrays: dict[str, np.ndarray]
) -> dict[str, Any]:
    """The fields of the `Expectation` from which `contents_of` made these. Raises an
    `OtherVersion` for an unknown sampling, and any error for contents that no estimate
    has."""
    fields = {name: header[name] for name in _FIELDS_OF_ESTIMATE}
    layout = Layout.of(_tree_of(header["structure"]), header["num_times"])
    levels = whole_number("levels", header["levels"])
    paths_per_sample = whole_number("paths_per_sample", header["paths_per_sample"])
    whole_number("rounding_floor", header["rounding_floor"])
    names = header["averaged"]
    # More levels than three have no further combinations.
    num_combinations = len(level_weights(1, min(levels, 3)))
    shape = len(header["ranges"]), len(names), num_combinations, layout.size
    _check(shape[0] > 0)
    _check(bool(jnp.finfo(header["dtype"])))
    _check(arrays["key_data"].dtype == np.uint32)
    for name in _AVERAGED:
        _check(arrays[name].shape == shape and arrays[name].dtype == np.float64)
    moments = []
    # Batches are in order, and do not overlap.
    end_before = 0
    for k, (begin, end, num_good, num_failed, failed_on) in enumerate(header["ranges"]):
        whole_number("begin", begin, end_before)
        whole_number("end", end, begin + 1, MOST_SAMPLES)
        whole_number("num_good", num_good, 0, end - begin)
        num_paths = (end - begin) * paths_per_sample
        whole_number("num_failed", num_failed, 0, num_paths)
        _check(len(failed_on) == levels)
        for number in failed_on:
            whole_number("failed_on", number, 0, num_failed)
        averaged = {
            name: Averaged(**dict(zip(names, arrays[name][k]))) for name in _AVERAGED
        }
        # JSON has lists only.
        counts = begin, end, num_good, num_failed, tuple(failed_on)
        moments.append(Moments(*counts, **averaged))
        end_before = end
    if header["digests"] is None:
        warnings.warn(
            "This estimate was saved without digests of its arguments: `merge` and "
            "`start=` cannot check that others have the same.",
            stacklevel=3,
        )
    return fields | {
        "moments": tuple(moments),
        "key_data": arrays["key_data"],
        "layout": layout,
        "sampling": _sampling_from(header),
        # There are none for the mean at `t1` alone.
        "ts": arrays.get("ts"),
    }


def _check(condition: bool) -> None:
    """Raises a `ValueError` unless the condition holds. It needs no message: `load` says
    that the file is damaged."""
    if not condition:
        raise ValueError


def _sampling_from(header: dict[str, Any]) -> Any:
    """The sampling, without the functions that it may have had. Raises an `OtherVersion` if
    this version does not have it, or not all of its fields."""
    name = header["sampling"]
    if name is None:
        return None
    unknown = f"`{name}`"
    sampling = SAVED_SAMPLINGS.get(name)
    if sampling is not None:
        own_names = {field.name for field in dataclasses.fields(sampling)}
        unknown_names = sorted(header["fields"].keys() - own_names)
        if not unknown_names:
            return sampling(**header["fields"])
        unknown += f" with {', '.join(unknown_names)}"
    raise OtherVersion(
        f"The estimate was sampled by {unknown}, which this version does not have. Read it "
        "with the version that wrote it."
    )


def _structure_as_json(tree: Any) -> Any:
    """The structure of a PyTree of arrays, for JSON. Each node is a dictionary from its
    kind to its contents: `{"list": [{"array": [3]}, {"none": 0}]}` for `[x, None]` with `x`
    of shape `(3,)`. The contents of `None` are a zero without a meaning."""
    if type(tree) is dict and all(type(name) is str for name in tree):
        # Keys are sorted, as JAX sorts them when it takes the leaves.
        children = {name: _structure_as_json(tree[name]) for name in sorted(tree)}
        return {"dict": children}
    if type(tree) in (list, tuple):
        return {type(tree).__name__: [_structure_as_json(child) for child in tree]}
    if tree is None:
        return {"none": 0}
    if isinstance(tree, jax.ShapeDtypeStruct):
        return {"array": list(tree.shape)}
    raise ValueError(
        "`save` takes dictionaries with strings as keys, lists, tuples and arrays; phi "
        f"holds a `{type(tree).__name__}`."
    )


def _tree_of(structure: Any) -> Any:
    """The PyTree with this structure, from `_structure_as_json`, of arrays of these
    shapes."""
    # A node has a single entry.
    ((kind, contents),) = structure.items()
    if kind == "dict":
        return {name: _tree_of(child) for name, child in contents.items()}
    if kind == "none":
        return None
    if kind == "array":
        return jax.ShapeDtypeStruct(contents, float)
    children = [_tree_of(child) for child in contents]
    return children if kind == "list" else tuple(children)
