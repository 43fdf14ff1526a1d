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
        """A label for each number of a vector, in order: its time and its indices in `phi`.

        - `t=2, ['energy'][0]`: the usual form, if the times `ts` are known.
        - `['energy'][1, 0]`: if `ts` is `None` although `phi` has an axis of times. The
          index of the time stands first in the brackets.
        - `['energy'][0]`: if `phi` has no axis of times.

        The label is empty for a `phi` that is a single number without a time."""
        # Only the structure of this `phi` is used, and the shapes of its arrays.
        phi = self.treedef.unflatten([np.zeros(shape) for shape in self.shapes])
        is_time_an_index = ts is None and self.num_times is not None
        labels = []
        for k in range(1 if self.num_times is None else self.num_times):
            time = "" if ts is None else f"t={ts[k]:.7g}"
            for keys, leaf in jtu.tree_leaves_with_path(phi):
                for index in np.ndindex(leaf.shape):
                    indices = (k, *index) if is_time_an_index else index
                    brackets = f"[{', '.join(map(str, indices))}]" if indices else ""
                    in_phi = jtu.keystr(keys) + brackets
                    # Either may be empty.
                    labels.append(", ".join(filter(None, (time, in_phi))))
        return labels


def as_vectors(
    x: Float[Array, "levels times n m"],
) -> Float[Array, "levels n numbers"]:
    """For each level and sample, the `m` numbers of `phi` at each time as one vector of
    `times * m` numbers."""
    x = jnp.swapaxes(x, 1, 2)
    return x.reshape(*x.shape[:2], -1)
