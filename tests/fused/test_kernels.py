"""What a fused kernel is compiled for."""

import os
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import jax.random as jr

import diffrax_symplectic as ds
from diffrax_symplectic._stablehlo import dr

from ..drjit_here import needs_drjit


ONE = jnp.array(0.0), jnp.array(1.0)


def spring(t, p, q, args):
    return p**2 / 2 + args * q**2


def push(t, p, q, args):
    return 0.2 * jnp.sin(q)


TERMS = ds.hamiltonian_terms(spring, push, ds.WeakBrownianPath((), jr.key(0)))


@needs_drjit
def test_batches_share_their_kernels():
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        ds.ensemble(
            TERMS,
            ds.StormerVerlet(),
            0.0,
            1.0,
            0.25,
            ONE,
            jnp.array(0.5),
            key=jr.key(1),
            num_paths=60,
            batch_size=20,
            engine="drjit",
        )
        history = dr.kernel_history([dr.KernelType.JIT])
    # By their hashes: a kernel may also come from the cache on disk.
    hashes = [str(kernel["hash"]) for kernel in history]
    assert len(hashes) == 3 * len({*hashes})


THREADS = """
import sys, threading
import jax.numpy as jnp
import jax.random as jr
import diffrax_symplectic as ds
from tests.fused.test_kernels import ONE, TERMS

def position(k):
    at = TERMS, ds.StormerVerlet(), 0.0, 1.0, 0.25, ONE, jnp.array(1.0 + k)
    paths = ds.ensemble(*at, key=jr.key(0), num_paths=64, engine="drjit")
    return float(paths.ys[1][0])

expected = [{position(k)} for k in range(4)]
found = {}

def several(k):
    found[k] = {position(k) for _ in range(25)}

# Threads change as often as Python allows.
sys.setswitchinterval(1e-6)
threads = [threading.Thread(target=several, args=(k,)) for k in range(4)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
assert [found[k] for k in range(4)] == expected
"""


@needs_drjit
def test_threads_may_call_the_engine_at_the_same_time():
    root = str(Path(__file__).parents[2])
    # In a process of its own, which Dr.Jit would abort.
    subprocess.run(
        [sys.executable, "-c", THREADS],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": root},
        cwd=root,
        check=True,
        timeout=120,
    )
