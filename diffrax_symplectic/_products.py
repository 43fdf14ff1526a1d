"""Products of arrays in full precision. By default accelerators round the factors to half
their digits, or fewer."""

import functools as ft

import jax
import jax.numpy as jnp


_EXACT = jax.lax.Precision.HIGHEST
dot = ft.partial(jnp.matmul, precision=_EXACT)
tensordot = ft.partial(jnp.tensordot, precision=_EXACT)
