import os

import jax


# Invariants hold to rounding error; let that be the one of double precision.
jax.config.update("jax_enable_x64", True)
# Pictures go to files.
os.environ.setdefault("MPLBACKEND", "Agg")
