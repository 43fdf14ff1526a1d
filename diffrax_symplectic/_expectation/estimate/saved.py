"""Estimates in NumPy `.npz` files: arrays, and a header in JSON with all that is no array,
such as numbers, words and the structure of `phi`."""

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


# The fields of `Moments` that are an `Averaged`. Each is one array of a file.
_AVERAGED = ("mean", "norm", "largest", "size")
# The fields of an `Expectation` that are written to the header as they are.
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
    """Raised for an estimate with a sampling that this version does not have."""


def write(
    file: str | Path | BinaryIO, header: dict[str, Any], arrays: dict[str, np.ndarray]
) -> None:
    """Writes a NumPy `.npz` file of arrays and a header. A file at the same path is
    replaced only by a complete new one: if anything fails, the older file is kept."""
    arrays = {**arrays, "header": np.array(json.dumps(header))}
    if not isinstance(file, str | Path):
        np.savez(file, **arrays)  # pyright: ignore
        return
    path = Path(file).resolve()
    # The part of the name in hexadecimal digits is random, since several processes may save
    # to one path at the same time.
    unfinished = path.with_name(f"{path.name}.{secrets.token_hex(4)}.part")
    try:
        with open(unfinished, "xb") as opened:
            np.savez(opened, **arrays)  # pyright: ignore
            opened.flush()
            os.fsync(opened.fileno())
        os.replace(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def read(file: BinaryIO) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header and the arrays of a file that `write` wrote. For any other file it may
    raise any error."""
    arrays = {}
    with zipfile.ZipFile(file) as archive:
        for name in archive.namelist():
            # `read` compares checksums, before anything is taken for an array.
            content = io.BytesIO(archive.read(name))
            # Without pickles no code of the file is executed.
            array = np.lib.format.read_array(content, allow_pickle=False)
            arrays[name.removesuffix(".npy")] = array
    return json.loads(str(arrays.pop("header"))), arrays


def contents_of(estimate: Any) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header and the arrays of a file, from an `Expectation` (whose module imports this
    one). Raises a `ValueError` for PyTree nodes in `phi` that JSON cannot express.

    The estimate holds the `Moments` of its samples in several parts. Their counts go to the
    header, as `ranges`. Their statistics go to the arrays `mean`, `norm`, `largest` and
    `size`, whose axes are parts, fields of `Averaged` (named in the header as `averaged`),
    combinations of levels, and numbers of `phi`."""
    layout = estimate.layout
    sampling = estimate.sampling
    # Only fields that are numbers, words or `None` are saved: functions in a sampling, such
    # as `sort_by`, are left out.
    fields_of_sampling = {}
    for name, x in ({} if sampling is None else vars(sampling)).items():
        if isinstance(x, np.integer):
            fields_of_sampling[name] = int(x)
        elif x is None or isinstance(x, int | float | str):
            fields_of_sampling[name] = x
    structs = [jax.ShapeDtypeStruct(shape, float) for shape in layout.shapes]
    # All parts have the same fields of `Averaged`, so the first part tells their names.
    first, *_ = estimate.moments
    # The names here are part of the format of files, so they must not be changed.
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
    arrays = {}
    for name in _AVERAGED:
        parts = [[*getattr(part, name).fields.values()] for part in estimate.moments]
        arrays[name] = np.array(parts)
    arrays["key_data"] = estimate.key_data
    if estimate.ts is not None:
        arrays["ts"] = estimate.ts
    return header, arrays


def fields_from(
    header: dict[str, Any], arrays: dict[str, np.ndarray]
) -> dict[str, Any]:
    """The inverse of `contents_of`: the fields of an `Expectation`. Raises an
    `OtherVersion` for an unknown sampling. For contents that no estimate has it may raise
    any error."""
    layout = Layout.of(_tree_of(header["structure"]), header["num_times"])
    whole_number("rounding_floor", header["rounding_floor"])
    # Raises an error unless this is a dtype of floating-point numbers.
    jnp.finfo(header["dtype"])
    _check(arrays["key_data"].dtype == np.uint32)
    moments = _moments_from(header, arrays, layout)
    if header["digests"] is None:
        warnings.warn(
            "This estimate was saved without digests of its arguments: `merge` and "
            "`start=` cannot check that others have the same.",
            stacklevel=3,
        )
    fields = {name: header[name] for name in _FIELDS_OF_ESTIMATE}
    return fields | {
        "moments": moments,
        "key_data": arrays["key_data"],
        "layout": layout,
        "sampling": _sampling_from(header),
        # A mean at `t1` alone has no array of times.
        "ts": arrays.get("ts"),
    }


def _moments_from(
    header: dict[str, Any], arrays: dict[str, np.ndarray], layout: Layout
) -> tuple[Moments, ...]:
    """The moments of an estimate, from the counts in `ranges` of the header and the arrays
    of statistics (see `contents_of`). Raises a `ValueError` for counts and shapes that no
    estimate has."""
    levels = whole_number("levels", header["levels"])
    paths_per_sample = whole_number("paths_per_sample", header["paths_per_sample"])
    names = header["averaged"]
    # With more levels than three there are no more combinations of levels.
    num_combinations = len(level_weights(1, min(levels, 3)))
    # Each array of statistics has this shape, and there is at least one part.
    shape = (len(header["ranges"]), len(names), num_combinations, layout.size)
    _check(len(header["ranges"]) > 0)
    for name in _AVERAGED:
        _check(arrays[name].shape == shape and arrays[name].dtype == np.float64)
    moments = []
    # Parts are in the order of their samples, and do not overlap. So the samples of a part
    # begin at the end of the part before, or later.
    end_before = 0
    for k, (begin, end, num_good, num_failed, failed_on) in enumerate(header["ranges"]):
        whole_number("begin", begin, least=end_before)
        whole_number("end", end, least=begin + 1, most=MOST_SAMPLES)
        whole_number("num_good", num_good, least=0, most=end - begin)
        num_paths = (end - begin) * paths_per_sample
        whole_number("num_failed", num_failed, least=0, most=num_paths)
        _check(len(failed_on) == levels)
        for number in failed_on:
            whole_number("failed_on", number, least=0, most=num_failed)
        averaged = {
            name: Averaged(**dict(zip(names, arrays[name][k]))) for name in _AVERAGED
        }
        # JSON has made a list of the tuple `failed_on`.
        part = Moments(begin, end, num_good, num_failed, tuple(failed_on), **averaged)
        moments.append(part)
        end_before = end
    return tuple(moments)


def _check(condition: bool) -> None:
    """Raises a `ValueError` unless the condition holds. The error needs no message, since
    `Expectation.load` says that the file is damaged."""
    if not condition:
        raise ValueError


def _sampling_from(header: dict[str, Any]) -> Any:
    """The sampling of an estimate (`None` if it had none), without the functions that it
    may have had. Raises an `OtherVersion` for a sampling whose class, or one of whose
    fields, this version does not have."""
    name = header["sampling"]
    if name is None:
        return None
    unknown = f"`{name}`"
    sampling_class = SAVED_SAMPLINGS.get(name)
    if sampling_class is not None:
        known_fields = {field.name for field in dataclasses.fields(sampling_class)}
        unknown_fields = sorted(header["fields"].keys() - known_fields)
        if not unknown_fields:
            return sampling_class(**header["fields"])
        unknown += f" with {', '.join(unknown_fields)}"
    raise OtherVersion(
        f"The estimate was sampled by {unknown}, which this version does not have. Read it "
        "with the version that wrote it."
    )


def _structure_as_json(tree: Any) -> Any:
    """The structure of a PyTree of arrays, for JSON. Each node of the PyTree becomes a
    dictionary with one entry, from the kind of the node to its contents. For example,
    `[x, None]` with an array `x` of shape `(3,)` becomes
    `{"list": [{"array": [3]}, {"none": 0}]}`. (The zero for `None` means nothing.)"""
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
    """The inverse of `_structure_as_json`: a PyTree with a shape in place of each array."""
    ((kind, contents),) = structure.items()
    if kind == "dict":
        return {name: _tree_of(child) for name, child in contents.items()}
    if kind == "none":
        return None
    if kind == "array":
        return jax.ShapeDtypeStruct(contents, float)
    children = [_tree_of(child) for child in contents]
    return children if kind == "list" else tuple(children)
