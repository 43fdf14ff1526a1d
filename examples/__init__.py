import os
import sys


# Invariants hold to rounding error; let that be the one of double precision. The process
# that only waits for others need not import JAX.
os.environ["JAX_ENABLE_X64"] = "1"
if "jax" in sys.modules:
    sys.modules["jax"].config.update("jax_enable_x64", True)
# Pictures go to files.
os.environ.setdefault("MPLBACKEND", "Agg")
