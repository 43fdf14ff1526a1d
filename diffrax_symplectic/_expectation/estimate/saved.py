"""Estimates in files: arrays, and their structure as JSON."""

import dataclasses
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ..sampling import Averaged, SAVED_SAMPLINGS
from .moments import Moments


# The fields of `Moments` that are an `Averaged`, and those that are numbers (of samples or
# of paths) or tuples of them.
_AVERAGED = ("mean", "norm", "largest", "size")
_NUMBERS = ("begin", "end", "num_good", "num_failed", "failed_on")
# The fields of an estimate that JSON takes as they are.
_FIELDS_OF_ESTIMATE = ("paths_per_sample", "rounding_floor", "reason", "tol_reached")


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
        "structure": _structure_as_json(batch.mean.value),
        "averaged": list(batch.mean.fields),
        "dtypes": jtu.tree_leaves(batch.dtypes),
        "sampling": None if sampling is None else type(sampling).__name__,
        "fields": sampling_fields_as_json,
        "tails": estimate.tails is not None,
    }
    header |= {name: getattr(estimate, name) for name in _FIELDS_OF_ESTIMATE}
    return header | {"digests": estimate.digests, "caveat": estimate.caveat}


def arrays_of(estimate: Any) -> dict[str, np.ndarray]:
    """The arrays of an `Expectation` (whose module imports this one), by their names. For
    example `mean_value_0_1` is leaf 1 of the field `value` of the `mean` of batch 0."""
    trees = {"tails": estimate.tails}
    for batch, moments in enumerate(estimate.moments):
        for name in _AVERAGED:
            for field, tree in getattr(moments, name).fields.items():
                trees[_name_of_tree(name, field, batch)] = tree
    arrays = {"key_data": estimate.key_data}
    if estimate.ts is not None:
        arrays["ts"] = estimate.ts
    for name, tree in trees.items():
        for leaf, array in enumerate(jtu.tree_leaves(tree)):
            arrays[_name_of_leaf(name, leaf)] = np.asarray(array)
    return arrays


def _name_of_tree(name: str, field: str, batch: int) -> str:
    return f"{name}_{field}_{batch}"


def _name_of_leaf(tree: str, leaf: int) -> str:
    return f"{tree}_{leaf}"


def fields_from(
    header: dict[str, Any], arrays: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """The fields of the `Expectation` from which `header_of` and `arrays_of` made these.
    Raises a `ValueError` for an unknown sampling."""
    structure = header["structure"]
    num_leaves = len(header["dtypes"])

    def tree(name: str) -> PyTree[np.ndarray]:
        leaves = [arrays[_name_of_leaf(name, leaf)] for leaf in range(num_leaves)]
        return _tree_of(structure, iter(leaves))

    def averaged(name: str, batch: int) -> Averaged:
        fields = header["averaged"]
        trees = {field: tree(_name_of_tree(name, field, batch)) for field in fields}
        return Averaged(**trees)

    def moments_of_batch(batch: int, values: list[Any]) -> Moments:
        numbers: Any = dict(zip(_NUMBERS, values))
        # JSON has lists only.
        numbers["failed_on"] = tuple(numbers["failed_on"])
        trees: Any = {name: averaged(name, batch) for name in _AVERAGED}
        dtypes = _tree_of(structure, iter(header["dtypes"]))
        return Moments(**numbers, **trees, dtypes=dtypes)

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
        "sampling": _sampling_from(header),
        "tails": tree("tails") if header["tails"] else None,
        "ts": arrays["ts"] if "ts" in arrays else None,
    }


def _sampling_from(header: dict[str, Any]) -> Any:
    """The sampling, without the functions that it may have had. Raises a `ValueError` if
    this version does not have it, or not all of its fields."""
    name = header["sampling"]
    if name is None:
        return None
    if name not in SAVED_SAMPLINGS:
        raise ValueError(
            f"The estimate was sampled by `{name}`, which this version does not have. Read "
            "it with the version that wrote it."
        )
    sampling = SAVED_SAMPLINGS[name]
    own_names = {field.name for field in dataclasses.fields(sampling)}
    unknown_names = sorted(header["fields"].keys() - own_names)
    if unknown_names:
        raise ValueError(
            f"The estimate was sampled by `{name}` with {', '.join(unknown_names)}, which "
            "this version does not have. Read it with the version that wrote it."
        )
    return sampling(**header["fields"])


def _is_plain(x: Any) -> bool:
    """Whether JSON takes this value, from `_number_for_json`."""
    return x is None or isinstance(x, int | float | str | np.integer)


def _number_for_json(x: Any) -> Any:
    """The value, as an integer of Python if it is one of NumPy."""
    return int(x) if isinstance(x, np.integer) else x


def _structure_as_json(tree: Any) -> Any:
    """The structure of a PyTree of arrays, for JSON. Each node is a dictionary from its
    kind to its contents: `{"list": [{"array": 0}, {"none": 0}]}` for `[x, None]`. The
    contents of an array or of `None` are a zero without a meaning."""
    if type(tree) is dict and all(type(name) is str for name in tree):
        # Keys are sorted, as JAX sorts them when it takes the leaves.
        children = {name: _structure_as_json(tree[name]) for name in sorted(tree)}
        return {"dict": children}
    if type(tree) in (list, tuple):
        return {type(tree).__name__: [_structure_as_json(child) for child in tree]}
    if tree is None:
        return {"none": 0}
    if isinstance(tree, np.ndarray | np.generic):
        return {"array": 0}
    raise ValueError(
        "`save` takes dictionaries with strings as keys, lists, tuples and arrays; phi "
        f"holds a `{type(tree).__name__}`."
    )


def _tree_of(structure: Any, leaves: Iterator[Any]) -> Any:
    """The PyTree with this structure, from `_structure_as_json`, and these leaves."""
    # A node has a single entry.
    ((kind, contents),) = structure.items()
    if kind == "dict":
        return {name: _tree_of(child, leaves) for name, child in contents.items()}
    if kind == "none":
        return None
    if kind == "array":
        return next(leaves)
    children = [_tree_of(child, leaves) for child in contents]
    return children if kind == "list" else tuple(children)
