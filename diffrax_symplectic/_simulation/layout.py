"""All numbers of a PyTree of arrays as one vector, and back."""

import math
from typing import Any, NamedTuple

import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float, PyTree


class Layout(NamedTuple):
    """How a vector of all numbers of `phi`, at one time after another, makes PyTrees like
    `phi`.

    - `treedef`, `shapes`: the structure of `phi`, and the shapes of its arrays.
    - `num_times`: the number of times, along the first axis of each array of the PyTree;
        `None` for PyTrees without an axis of times.
    """

    treedef: Any
    shapes: tuple[tuple[int, ...], ...]
    num_times: int | None = None

    @staticmethod
    def of(structs: PyTree, num_times: int | None = None) -> "Layout":
        """The layout for a `phi` with the structure and the shapes of this PyTree."""
        leaves, treedef = jtu.tree_flatten(structs)
        return Layout(treedef, tuple(np.shape(leaf) for leaf in leaves), num_times)

    @property
    def size(self) -> int:
        """The length of a vector."""
        size_of_phi = sum(map(math.prod, self.shapes))
        return size_of_phi * (1 if self.num_times is None else self.num_times)

    def unravel(self, x: Float[Array | np.ndarray, "*axes size"]) -> Any:
        """The PyTree of the numbers in a vector. If `x` has more axes than that of the
        vector, each array of the PyTree has these axes in front."""
        axes = x.shape[:-1]
        if self.num_times is not None:
            axes = (*axes, self.num_times)
        x = x.reshape(*axes, -1)
        arrays = []
        begin = 0
        for shape in self.shapes:
            end = begin + math.prod(shape)
            arrays.append(x[..., begin:end].reshape((*axes, *shape)))
            begin = end
        return self.treedef.unflatten(arrays)

    def labels(self, ts: np.ndarray | None) -> list[str]:
        """A label for each number of a vector, in their order: its time and its place in
        the PyTree, such as `t=2, ['energy'][0]`. If there are times but not their values
        `ts`, the index of the time stands first in the brackets, as in `['energy'][1, 0]`.
        A single number without a time has an empty label."""
        tree = self.treedef.unflatten([np.zeros(shape) for shape in self.shapes])
        is_time_an_index = ts is None and self.num_times is not None
        labels = []
        for k in range(1 if self.num_times is None else self.num_times):
            time = "" if ts is None else f"t={ts[k]:.7g}"
            for keys, leaf in jtu.tree_leaves_with_path(tree):
                for index in np.ndindex(leaf.shape):
                    indices = (k, *index) if is_time_an_index else index
                    entry = f"[{', '.join(map(str, indices))}]" if indices else ""
                    place = jtu.keystr(keys) + entry
                    # Either may be empty.
                    labels.append(", ".join(filter(None, (time, place))))
        return labels


def as_vectors(
    x: Float[Array, "levels times n m"],
) -> Float[Array, "levels n numbers"]:
    """For each level and sample, the `m` numbers at all times as one vector."""
    x = jnp.swapaxes(x, 1, 2)
    return x.reshape(*x.shape[:2], -1)
