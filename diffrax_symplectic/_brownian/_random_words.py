"""Random words for a step, as a function of a key and of where the step lies."""

from typing import TypeAlias

import jax
import jax.numpy as jnp
import jax.random as jr
import numpy as np
from jaxtyping import Array, Integer, PRNGKeyArray, UInt32

from .._materialize import materialize


# A number that counts places, and one that says what is counted.
Place: TypeAlias = tuple[Integer[Array, ""], Integer[Array, ""]]

# The words of one step are numbered. Those of wrappers begin at these numbers.
PLATEAU_WORDS, AREA_WORDS = 2**18, 2**19


def random_words(
    key, place: Place, sets: int, n: int, begin: int = 0
) -> UInt32[Array, "sets n"]:
    """Random words for a step at `place`: `sets` sets of `n` words each. To ask for more
    sets does not change the first ones. Words for different values of `begin` are
    independent, so that a path and a wrapper around it may have the same key."""
    key = _typed(key)
    count, exponent = place
    blocks = (sets * n + 1) // 2
    if str(jr.key_impl(key)) == "threefry2x32" and 0 < blocks < 2**20 - begin:
        # The place is used as the counter of the generator: one hash then makes two words.
        # With folded and split keys the first word alone would take three hashes.
        numbers = np.arange(begin, begin + blocks, dtype=np.uint32)
        counter = (
            count.astype(jnp.uint32),
            (exponent.astype(jnp.uint32) << 20) + numbers,
        )
        words = materialize(lambda: _threefry(jr.key_data(key), *counter))
        words = jnp.stack(words, axis=1)
        return words.reshape(-1)[: sets * n].reshape(sets, n)
    at = jr.fold_in(jr.fold_in(key, count), exponent)
    return jnp.stack(
        [jr.bits(jr.fold_in(at, begin + i), (n,), jnp.uint32) for i in range(sets)]
    )


def _threefry(key: UInt32[Array, "2"], a: Array, b: Array) -> tuple[Array, Array]:
    """Threefry-2x32 with 20 rounds, by Salmon et al. (SC'11, doi:10.1145/2063384.2063405):
    the words that JAX's generator makes for this key, for counters `(a, b)`.

    On CPUs JAX's own is a loop of eighty kernels. Written out, XLA fuses all of it into
    one or two: three words for each of 512 paths take 3 ns a path in place of 16.
    """
    keys = key[0], key[1], key[0] ^ key[1] ^ np.uint32(0x1BD11BDA)
    a, b = a + keys[0], b + keys[1]
    for i in range(5):
        for bits in ((13, 15, 26, 6), (17, 29, 16, 24))[i % 2]:
            a = a + b
            b = a ^ ((b << bits) | (b >> (32 - bits)))
        a, b = a + keys[(i + 1) % 3], b + keys[(i + 2) % 3] + np.uint32(i + 1)
    return a, b


def check_key(key, user: str) -> None:
    """Raises a `ValueError` unless `key` is a random key (as from `jax.random.key` or
    `jax.random.PRNGKey`) or an array of keys, which is meant for `jax.vmap`."""
    dtype = getattr(key, "dtype", None)
    if dtype is None or not (
        jnp.issubdtype(dtype, jax.dtypes.prng_key) or dtype == jnp.uint32
    ):
        raise ValueError(
            f"`{user}` needs a random key, as from `jax.random.key(0)`; got {key!r}."
        )


def _typed(key) -> PRNGKeyArray:
    typed = jnp.issubdtype(key.dtype, jax.dtypes.prng_key)
    key = key if typed else jr.wrap_key_data(key)
    if key.ndim > 0:
        raise ValueError(
            "A Brownian path needs one random key; got an array of keys of shape "
            f"{key.shape}. Use `jax.vmap` over it."
        )
    return key


def place_of(t0, t1) -> Place:
    """Where a step lies, in integers, the same for times that differ by rounding.

    The middle of the step is counted in units of a power of two, which is the second
    integer and lies between a third and 0.7 of the step. All steps with the same unit are
    longer than it, so that two steps have the same integers only if they overlap. The two
    odd constants keep round numbers away from where the roundings change.
    """
    h = jnp.abs(t1 - t0)
    _, exponent = jnp.frexp(h * 1.37)
    exponent = exponent.astype(jnp.int32) - 2
    # The middle itself would be rounded to the resolution of time. Late in a long solve
    # in float32 that is not far below the step, and two steps may have one middle. So the
    # integer part of the start, which is exact, is split off before half a step is added.
    start, half = (jnp.ldexp(x, -exponent) for x in (t0, (t1 - t0) / 2))
    whole = jnp.floor(start)
    rest = jnp.floor(start - whole + half + 0.29)
    # Starts again after 2^31 counts. (`fmod` is exact, also for negative times.)
    return jnp.fmod(whole, 2.0**31).astype(jnp.int32) + rest.astype(jnp.int32), exponent
