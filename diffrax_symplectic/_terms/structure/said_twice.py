"""Terms that say something twice: one Hamiltonian in two drifts, or one Brownian motion in
a bath and in another noise."""

from typing import Any

import diffrax
import equinox as eqx
import jax.random as jr
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from ..._brownian import is_key, typed_key
from ..._compat import is_traced, unwrapped
from ..._parts import parts_of
from ..._programs import Traced
from ..drift_and_noise import flattened
from ..langevin import BathNoise
from ..paths import brownian_paths
from ..symplectic_gradients import Drift, hamiltonian_parts


def check_drifts_differ(terms: PyTree[diffrax.AbstractTerm]) -> None:
    """Raises a `ValueError` if two drifts have the same Hamiltonian, which would count
    twice."""
    # The Hamiltonians of the drifts so far.
    earlier: list[Any] = []
    for part in hamiltonian_parts(terms):
        H0 = part.H0 if isinstance(part, Drift) else None
        # A noise has no `H0`, and a drift may be only a slow potential.
        if H0 is None:
            continue
        # Traced functions are equal if they compute the same, even if the user wrote two
        # functions. So they are not compared.
        if parts_of(Traced, H0):
            continue
        # For Modules with traced parameters, which may be equal or not, the result of
        # `tree_equal` is traced, and so it is not `True`.
        if any(eqx.tree_equal(H0, other) is True for other in earlier):
            # The name of a function, or of the class of a Module.
            name = getattr(H0, "__name__", type(H0).__name__)
            raise ValueError(
                f"`H0` stands in two drift terms ({name}), so it would count "
                "twice. Make one drift of it, by `hamiltonian_terms` or `langevin_terms`, "
                "and add noise alone by `noise_terms(noise, path)`, or a second bath by "
                "`bath_terms(H0, friction, temperature, path)`: "
                "`diffrax.MultiTerm(*terms.terms, *noise_terms(noise, path).terms)`."
            )
        earlier.append(H0)


def check_baths_have_own_noise(terms: PyTree[diffrax.AbstractTerm]) -> None:
    """Raises a `ValueError` if a bath shares a random key with another term. One Brownian
    motion would drive both, and the temperature would be wrong. Traced keys, whose values
    are not known, are not compared."""
    noise = [term for term in flattened(terms) if len(brownian_paths(term)) > 0]
    keys_of_each = [_known_keys(term) for term in noise]
    for i, term in enumerate(noise):
        if not isinstance(unwrapped(term), BathNoise):
            continue
        keys_of_others = set().union(*keys_of_each[:i], *keys_of_each[i + 1 :])
        if keys_of_each[i] & keys_of_others:
            raise ValueError(
                "The path of a bath has the same random key as the path of another term, "
                "so both would be one Brownian motion, and the temperature would be wrong. "
                "Give each a key of its own, by `key1, key2 = jax.random.split(key)`; or "
                "where shapes are taken, pass the shape of each path."
            )


def _known_keys(term: diffrax.AbstractTerm) -> set[bytes]:
    """The random keys of the paths of a term, each as the bytes of its data. Traced keys
    are left out."""
    keys = filter(is_key, jtu.tree_leaves(brownian_paths(term)))
    data_of_keys = [jr.key_data(typed_key(key)) for key in keys]
    return {np.asarray(x).tobytes() for x in data_of_keys if not is_traced(x)}
