"""Stage equations solved in the plainest way, for tests of what does not depend on that.
The default root finder is most of the program of a step: with this one, a step is traced
and compiled in a third of the time."""

import dataclasses

import jax
import jax.numpy as jnp
import optimistix as optx


class Picard(optx.AbstractRootFinder):
    """`k` becomes `f(k)` until the residual `k - f(k)` is at most `atol`. A step for which
    that takes too long is reported as failed."""

    atol: float = 1e-15
    rtol: float = 0.0
    norm = staticmethod(optx.max_norm)

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        return jnp.full((), jnp.inf, jnp.result_type(*jax.tree.leaves(y)))

    def step(self, fn, y, args, options, state, tags):
        residual, aux = fn(y, args)
        return jax.tree.map(jnp.subtract, y, residual), self.norm(residual), aux

    def terminate(self, fn, y, args, options, state, tags):
        return state <= self.atol, optx.RESULTS.successful

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        return y, aux, {}


def by_picard(solver, atol: float = 1e-15):
    """The same solver with this root finder, if it has one."""
    fields = [field.name for field in dataclasses.fields(solver)]
    if "solver" in fields:
        return dataclasses.replace(solver, solver=by_picard(solver.solver, atol))
    if "root_finder" not in fields:
        return solver
    return dataclasses.replace(solver, root_finder=Picard(atol))
