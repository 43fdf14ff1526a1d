"""BibTeX for the methods of a solve."""

import importlib.resources
import inspect
import re
from typing import Any

import diffrax
import jax.tree_util as jtu


# A link in a docstring.
_DOI = re.compile(r"https://doi\.org/([^\s)]+)")
# A field of an entry in BibTeX.
_DOI_FIELD = re.compile(r"doi = \{(.*?)\}")


def citation(*args: Any, **kwargs: Any) -> None:
    """Prints BibTeX for the numerical methods of a solve: the output of `diffrax.citation`,
    and the sources of this package's solvers and Brownian paths.

    ```python
    ds.citation(terms, ds.SRKw2(), t0=0, t1=1, dt0=0.01, y0=y0)
    ```

    **Arguments:** any arguments of `diffrax.diffeqsolve`.
    """
    diffrax.citation(*args, **kwargs)
    # Like Diffrax, this accepts arguments by position and by name, and any part of them.
    bound = inspect.signature(diffrax.diffeqsolve).bind_partial(*args, **kwargs)
    entries = _entries()
    for cls in _classes(bound.arguments):
        # The sources of a class are the links in its docstring. Each counts once.
        dois = list(dict.fromkeys(_DOI.findall(cls.__doc__ or "")))
        if len(dois) > 0:
            print(
                f"\n% `diffrax_symplectic.{cls.__name__}` is from, or builds on, doi:"
            )
            print(*(f"% - {doi}" for doi in dois), sep="\n")
        for doi in dois:
            # BibTeX rejects repeated keys, so each entry is printed once.
            if doi in entries:
                print(entries.pop(doi))


def _classes(tree: Any) -> list[type]:
    """The classes of this package that occur in `tree`, in order."""
    # A dictionary in place of a set keeps the order.
    classes: dict[type, None] = {}

    # JAX calls `is_leaf` for each node on the way down, also for containers and modules.
    def record(node: Any) -> bool:
        if type(node).__module__.split(".")[0] == "diffrax_symplectic":
            classes[type(node)] = None
        # With `False`, JAX goes on to what the node holds.
        return False

    jtu.tree_leaves(tree, is_leaf=record)
    return list(classes)


def _entries() -> dict[str, str]:
    """The entries of `references.bib`, by DOI."""
    bib = importlib.resources.files("diffrax_symplectic").joinpath("references.bib")
    entries = bib.read_text(encoding="utf-8").strip().split("\n\n")
    by_doi = {}
    for entry in entries:
        match = _DOI_FIELD.search(entry)
        # A book without a DOI cannot be linked to, so no docstring asks for its entry.
        if match is not None:
            by_doi[match[1]] = entry
    return by_doi
