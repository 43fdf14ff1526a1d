"""Estimates in files: arrays, and their structure as JSON."""

from collections.abc import Mapping
from typing import Any

import jax.tree_util as jtu
import numpy as np

from .moments import Moments
from .sampling import AbstractSampling


_TREES = "mean", "norm", "largest", "size"


def described(estimate: Any) -> dict[str, Any]:
    """Raises a `ValueError` for PyTree nodes that JSON cannot express."""
    sampling, one = estimate.sampling, estimate.moments[0]
    fields = {} if sampling is None else vars(sampling)
    plain = lambda x: x is None or isinstance(x, int | float | str | np.integer)
    kept = {k: int(x) if isinstance(x, np.integer) else x for k, x in fields.items()}
    return {
        "ranges": [(x.begin, x.end, x.good, x.failed) for x in estimate.moments],
        "structure": _structure(one.mean),
        "dtypes": jtu.tree_leaves(one.dtypes),
        "paths_per_sample": estimate.paths_per_sample,
        "roundings": estimate.roundings,
        "sampling": None if sampling is None else type(sampling).__name__,
        "fields": {k: x for k, x in kept.items() if plain(x)},
        "reason": estimate.reason,
        "tol_reached": estimate.tol_reached,
        "far": estimate.far is not None,
    }


def arrays_of(estimate: Any) -> dict[str, np.ndarray]:
    out = {"key_data": estimate.key_data}
    trees = [
        (f"{name}_{i}", getattr(x, name))
        for i, x in enumerate(estimate.moments)
        for name in _TREES
    ]
    for name, tree in [*trees, ("far", estimate.far)]:
        leaves = jtu.tree_leaves(tree)
        out |= {f"{name}_{k}": np.asarray(leaf) for k, leaf in enumerate(leaves)}
    return out


def rebuilt(
    kind: type, header: dict[str, Any], arrays: Mapping[str, np.ndarray]
) -> Any:
    structure = header["structure"]

    def tree(name: str) -> Any:
        count = len(header["dtypes"])
        return _filled(structure, iter([arrays[f"{name}_{k}"] for k in range(count)]))

    dtypes = _filled(structure, iter(header["dtypes"]))
    moments = tuple(
        Moments(*numbers, dtypes=dtypes, **{k: tree(f"{k}_{i}") for k in _TREES})
        for i, numbers in enumerate(header["ranges"])
    )
    kinds = {x.__name__: x for x in AbstractSampling.__subclasses__()}
    name, fields = header["sampling"], header["fields"]
    sampling = None if name is None else kinds[name](**fields)
    far = tree("far") if header["far"] else None
    names = "paths_per_sample", "roundings", "reason", "tol_reached"
    about = {name: header[name] for name in names}
    return kind(moments, arrays["key_data"], sampling=sampling, far=far, **about)


def _structure(tree: Any) -> Any:
    if type(tree) is dict and all(type(k) is str for k in tree):
        # JAX sorts keys.
        return {"dict": {k: _structure(tree[k]) for k in sorted(tree)}}
    if type(tree) in (list, tuple):
        return {type(tree).__name__: [_structure(x) for x in tree]}
    if tree is None:
        return {"none": 0}
    if isinstance(tree, np.ndarray | np.generic):
        return {"array": 0}
    raise ValueError(
        "`save` takes dictionaries with strings as keys, lists, tuples and arrays; phi "
        f"holds a `{type(tree).__name__}`."
    )


def _filled(structure: Any, leaves: Any) -> Any:
    ((kind, inner),) = structure.items()
    if kind == "dict":
        return {k: _filled(x, leaves) for k, x in inner.items()}
    if kind == "none":
        return None
    if kind == "array":
        return next(leaves)
    return (list if kind == "list" else tuple)(_filled(x, leaves) for x in inner)
