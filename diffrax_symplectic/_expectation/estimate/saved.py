"""Estimates in files: arrays, and their structure as JSON."""

import dataclasses
import io
import json
import os
import secrets
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from ..._arguments import whole_number
from ..._simulation import Layout, level_weights
from ..sampling import Averaged, MOST_SAMPLES, SAVED_SAMPLINGS
from .moments import Moments


# The fields of `Moments` that are an `Averaged`, and those that are numbers (of samples or
# of paths) or tuples of them.
_AVERAGED = ("mean", "norm", "largest", "size")
_NUMBERS = ("begin", "end", "num_good", "num_failed", "failed_on")
# The fields of an estimate that JSON takes as they are.
_FIELDS_OF_ESTIMATE = (
    "dtype",
    "paths_per_sample",
    "rounding_floor",
    "reason",
    "tol_reached",
)


class OtherVersion(ValueError):
    """An estimate was written by a version that had more than this one."""


class Contents(NamedTuple):
    """What a file holds.

    - `header`: all but the arrays, as `header_of` makes it.
    - `arrays`: the arrays, as `arrays_of` makes them.
    """

    header: dict[str, Any]
    arrays: Mapping[str, np.ndarray]


def write(file: str | Path | BinaryIO, contents: Contents) -> None:
    """Writes a NumPy `.npz` file. A file that is there already is replaced by the whole new
    one, or if anything fails kept as it is."""
    arrays = {**contents.arrays, "header": np.array(json.dumps(contents.header))}
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


def read(file: BinaryIO) -> Contents:
    """The contents of a file that `write` wrote. Raises any error for another file."""
    with zipfile.ZipFile(file) as archive:
        # This compares checksums, before anything is taken for an array.
        arrays = {
            name.removesuffix(".npy"): _array_in(archive.read(name))
            for name in archive.namelist()
        }
    return Contents(json.loads(str(arrays.pop("header"))), arrays)


def _array_in(content: bytes) -> np.ndarray:
    """The array of a NumPy file. Objects in it are refused, so that no code is executed,
    and so are shapes that its numbers do not fill."""
    file = io.BytesIO(content)
    np.lib.format.read_magic(file)
    shape, in_columns, dtype = np.lib.format.read_array_header_1_0(file)
    order = "F" if in_columns else "C"
    return np.frombuffer(file.read(), dtype).reshape(shape, order=order)


def header_of(estimate: Any) -> dict[str, Any]:
    """All of an `Expectation` but its arrays, for JSON. Raises a `ValueError` for PyTree
    nodes that JSON cannot express."""
    # All batches have the same structure.
    batch, *_ = estimate.moments
    numbers_of_batches = [
        [getattr(moments, name) for name in _NUMBERS] for moments in estimate.moments
    ]
    sampling = estimate.sampling
    sampling_fields = {} if sampling is None else vars(sampling)
    # A function, such as `sort_by`, is left out.
    sampling_fields_as_json = {
        name: _number_for_json(x) for name, x in sampling_fields.items() if _is_plain(x)
    }
    # The names here are those of the files.
    header = {
        "ranges": numbers_of_batches,
        "structure": _structure_as_json(_shapes_in(estimate.layout)),
        "num_times": estimate.layout.num_times,
        "averaged": list(batch.mean.fields),
        "sampling": None if sampling is None else type(sampling).__name__,
        "fields": sampling_fields_as_json,
    }
    header |= {name: getattr(estimate, name) for name in _FIELDS_OF_ESTIMATE}
    return header | {"digests": estimate.digests, "caveat": estimate.caveat}


def arrays_of(estimate: Any) -> dict[str, np.ndarray]:
    """The arrays of an `Expectation` (whose module imports this one), by their names. For
    example `mean_value_0` is the field `value` of the `mean` of batch 0."""
    arrays = {"key_data": estimate.key_data}
    if estimate.ts is not None:
        arrays["ts"] = estimate.ts
    for batch, moments in enumerate(estimate.moments):
        for name in _AVERAGED:
            for field, array in getattr(moments, name).fields.items():
                arrays[_name_of_array(name, field, batch)] = np.asarray(array)
    return arrays


def _name_of_array(name: str, field: str, batch: int) -> str:
    return f"{name}_{field}_{batch}"


def fields_from(contents: Contents) -> dict[str, Any]:
    """The fields of the `Expectation` from which `header_of` and `arrays_of` made these.
    Raises an `OtherVersion` for an unknown sampling, and any error for contents that no
    estimate has."""
    header, arrays = contents
    _check_counts(header)
    layout = Layout.of(_tree_of(header["structure"]), header["num_times"])
    levels = _num_levels(header)
    # More levels than three have no further combinations.
    num_combinations = len(level_weights(1, min(levels, 3)))
    _check(bool(jnp.finfo(header["dtype"])))
    _check(arrays["key_data"].dtype == np.uint32)

    def array(name: str) -> np.ndarray:
        _check(arrays[name].shape == (num_combinations, layout.size))
        _check(arrays[name].dtype == np.float64)
        return arrays[name]

    def averaged(name: str, batch: int) -> Averaged:
        fields = header["averaged"]
        return Averaged(
            **{field: array(_name_of_array(name, field, batch)) for field in fields}
        )

    def moments_of_batch(batch: int, values: list[Any]) -> Moments:
        numbers: Any = dict(zip(_NUMBERS, values))
        # JSON has lists only.
        numbers["failed_on"] = tuple(numbers["failed_on"])
        arrays_of_batch: Any = {name: averaged(name, batch) for name in _AVERAGED}
        return Moments(**numbers, **arrays_of_batch)

    moments = [moments_of_batch(*of_batch) for of_batch in enumerate(header["ranges"])]
    fields = {name: header[name] for name in _FIELDS_OF_ESTIMATE}
    # Files of earlier versions have none.
    fields["digests"] = header.get("digests")
    fields["caveat"] = header.get("caveat", "")
    if fields["digests"] is None:
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
        "ts": arrays["ts"] if "ts" in arrays else None,
    }


def _check_counts(header: dict[str, Any]) -> None:
    """Raises a `ValueError` for numbers of samples and paths that no estimate has."""
    paths_per_sample = whole_number("paths_per_sample", header["paths_per_sample"])
    whole_number("rounding_floor", header["rounding_floor"])
    levels = _num_levels(header)
    _check(levels > 0)
    # Batches are in order, and do not overlap.
    end_before = 0
    for begin, end, num_good, num_failed, failed_on in header["ranges"]:
        whole_number("begin", begin, end_before)
        whole_number("end", end, begin, MOST_SAMPLES)
        whole_number("num_good", num_good, 0, end - begin)
        num_paths = (end - begin) * paths_per_sample
        whole_number("num_failed", num_failed, 0, num_paths)
        _check(len(failed_on) == levels)
        for number in failed_on:
            whole_number("failed_on", number, 0, num_failed)
        end_before = end


def _num_levels(header: dict[str, Any]) -> int:
    """The number of levels, each of which has an entry in the `failed_on` of a batch."""
    first_batch = header["ranges"][0]
    *_, failed_on = first_batch
    return len(failed_on)


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
    if name not in SAVED_SAMPLINGS:
        raise OtherVersion(
            f"The estimate was sampled by `{name}`, which this version does not have. Read "
            "it with the version that wrote it."
        )
    sampling = SAVED_SAMPLINGS[name]
    own_names = {field.name for field in dataclasses.fields(sampling)}
    unknown_names = sorted(header["fields"].keys() - own_names)
    if unknown_names:
        raise OtherVersion(
            f"The estimate was sampled by `{name}` with {', '.join(unknown_names)}, which "
            "this version does not have. Read it with the version that wrote it."
        )
    return sampling(**header["fields"])


def _is_plain(x: Any) -> bool:
    """Whether JSON takes this value once `_number_for_json` has converted it."""
    return x is None or isinstance(x, int | float | str | np.integer)


def _number_for_json(x: Any) -> Any:
    """The value, as an integer of Python if it is one of NumPy."""
    return int(x) if isinstance(x, np.integer) else x


class _Shape(NamedTuple):
    """The shape of an array, as a leaf of a PyTree."""

    axes: tuple[int, ...]


def _shapes_in(layout: Layout) -> Any:
    """The PyTree of the shapes of all arrays."""
    return layout.treedef.unflatten(map(_Shape, layout.shapes))


def _structure_as_json(tree: Any) -> Any:
    """The structure of a PyTree of shapes, for JSON. Each node is a dictionary from its
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
    if isinstance(tree, _Shape):
        return {"array": list(tree.axes)}
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
