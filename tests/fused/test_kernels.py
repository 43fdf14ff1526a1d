"""What a fused kernel is compiled for, and who may call it."""

import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import jax.random as jr

import diffrax_symplectic as ds
from diffrax_symplectic._stablehlo import dr

from ..drjit_here import needs_drjit


pytestmark = needs_drjit


def follow(k=0.5, **options):
    spring = lambda t, p, q, args: p**2 / 2 + args * q**2
    push = lambda t, p, q, args: 0.2 * jnp.sin(q)
    terms = ds.hamiltonian_terms(spring, push, ds.WeakBrownianPath((), jr.key(0)))
    given = terms, ds.StormerVerlet(), 0.0, 1.0, 0.25, (0.0, 1.0), jnp.array(k)
    options = dict(key=jr.key(1), num_paths=60, engine="drjit") | options
    return ds.ensemble(*given, **options)


def test_batches_share_their_kernels():
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        follow(batch_size=20)
        history = dr.kernel_history([dr.KernelType.JIT])
    # By their hashes: a kernel may also come from the cache on disk.
    hashes = [str(kernel["hash"]) for kernel in history]
    assert len(hashes) == 3 * len({*hashes})


THREADS = """
import sys, threading
from tests.fused.test_kernels import follow

position = lambda k: float(follow(1.0 + k).ys[1][0])
expected = {k: {position(k)} for k in range(4)}
found = {}

def several(k):
    found[k] = {position(k) for _ in range(25)}

# Threads change as often as Python allows.
sys.setswitchinterval(1e-6)
threads = [threading.Thread(target=several, args=(k,)) for k in expected]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert found == expected
"""


def test_threads_may_call_the_engine_at_the_same_time():
    root = str(Path(__file__).parents[2])
    # In a process of its own, which Dr.Jit would abort, or never end.
    subprocess.run(
        [sys.executable, "-c", THREADS],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": root},
        check=True,
        timeout=120,
    )
