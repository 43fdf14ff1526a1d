import diffrax
import jax
import jax.flatten_util as jfu
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np

from .._brownian import WeakIncrement
from .._plan import make_plan
from .._tableau import FlatTableau, Stage
from .._terms import (
    apply_one,
    check_state,
    controls,
    drift_driven,
    number_of_noises,
    split_terms,
)
from ._implicit import AbstractImplicitStages, ARGUMENTS
from ._implicit_step import first_failure, take_step
from ._stages import Step
from .base import AbstractSymplecticSolver


_r = np.sqrt(3.0)
# The flow of one vector field: two stages of the Gauss method, of order 4.
_gauss = make_plan(
    FlatTableau(
        stages=tuple(Stage(("h",), 1 / 2 + s * _r / 6, "y", "y") for s in (-1, 1)),
        matrix=np.array([[1 / 4, 1 / 4 - _r / 6], [1 / 4 + _r / 6, 1 / 4]]),
        weights=np.array([1 / 2, 1 / 2]),
    )
)
# Up to so many noises their flows are written out one after another, without a loop.
_WRITTEN_OUT = 2


class NinomiyaVictoir(AbstractSymplecticSolver, AbstractImplicitStages):
    r"""A symplectic method of weak order 2 for any Hamiltonians and any number of noises,
    whether they commute or not: splitting in random order.

    With $F_0(t)$ for the flow of the drift over time $t$, $F_k(x)$ for that of the noise
    $b_k$ over "time" $x$, and the three-point variables $\hat I_k$, by one fair coin

    $$y_{n+1} = F_0(\tfrac h2)\, F_m(\hat I_m) \cdots F_1(\hat I_1)\, F_0(\tfrac h2)\, y_n
      \quad \text{or} \quad
      F_0(\tfrac h2)\, F_1(\hat I_1) \cdots F_m(\hat I_m)\, F_0(\tfrac h2)\, y_n.$$

    Each flow is one step of the Gauss method with two stages, of order 4. (By the midpoint
    rule the method would fall back to weak order 1.) So a step solves $m + 2$ systems of
    two stage vectors, one after another. Memory grows with $m$ plus the size of the state.

    **Many noises.** A flow needs one noise only. What it evaluates depends on the terms:

    - of an [`diffrax_symplectic.IndexedNoise`][] that noise alone: a step costs as much
      as a few evaluations of every noise;
    - of a function that returns all Hamiltonians, all of them: $m$ times as much;
    - of a `diffrax.ControlTerm` the whole matrix, and multiplies one column of it.

    For a thousand sites and a thousand noises that read all sites, a step of one path took
    0.04 s with `IndexedNoise`, and 2.8 s with a function.

    Symplectic path by path for any Hamiltonians, and any Stratonovich system will do:
    quadratic invariants that drift and noises share are conserved. Weak order 2. Order 4
    without noise. No free parameters. For one noise, [`diffrax_symplectic.StrangGauss`][]
    has the same order and is cheaper.

    !!! warning

        For two noises and more the path has to be a
        [`diffrax_symplectic.WeakBrownianPath`][] with `two_point=True`: the coin is the
        sign of the first two-point variable.

    **Source:** [Ninomiya and Victoir (2008)](https://doi.org/10.1080/13504860701413958) for
    the splitting; [Ninomiya and Ninomiya (2009)](https://doi.org/10.1007/s00780-009-0101-4)
    for Runge--Kutta methods of high order, the Gauss method among them, in place of the
    flows.
    """

    @property
    def minimal_levy_area(self):
        """The least that the increments of the path have to hold."""
        return WeakIncrement

    def init(self, terms, t0, t1, y0, args):
        del t0, t1
        check_state(y0, type(self).__name__)
        return None

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        del solver_state, made_jump
        drift, _ = split_terms(terms)
        middle = t0 + (t1 - t0) / 2

        def along_drift(t0, t1, y):
            if len(drift) == 0:
                return y, diffrax.RESULTS.successful
            step = Step(t0, t1 - t0, {"h": drift_driven(drift, t0, t1, args)})
            return take_step(_gauss, step, y, self)

        y, first = along_drift(t0, middle, y0)
        y, second = self._along_noise(terms, t0, t1, middle, y, args)
        y1, third = along_drift(middle, t1, y)
        result = first_failure(first_failure(first, second), third)
        return y1, None, dict(y0=y0, y1=y1), None, result

    def _along_noise(self, terms, t0, t1, time, y0, args):
        """The flows of all noises, the time standing still at `time`."""
        _, noise = split_terms(terms)
        if len(noise) == 0:
            return y0, diffrax.RESULTS.successful
        m = number_of_noises(terms)
        # The flows of several noises have an order, for which a coin is needed.
        names = ["W", "two_point"] if m > 1 else ["W"]
        drawn = controls(noise, names, t0, t1, type(self).__name__)
        increments, _ = jfu.ravel_pytree(drawn["W"])
        numbers = jnp.arange(m)
        if m > 1:
            coin = jtu.tree_leaves(drawn["two_point"])[0].reshape(-1)[0] > 0
            numbers = jnp.where(coin, numbers, numbers[::-1])

        def flow(carry, this):
            y, result = carry
            driven = jtu.Partial(apply_one, noise, *this, args)
            step = Step(time, 0 * (t1 - t0), {"h": driven})
            y, flowed = take_step(_gauss, step, y, self)
            return (y, first_failure(result, flowed)), None

        carry = (y0, diffrax.RESULTS.successful)
        unroll = m if m <= _WRITTEN_OUT else 1
        flows = (numbers, increments[numbers])
        (y1, result), _ = jax.lax.scan(flow, carry, flows, unroll=unroll)
        return y1, result

    def order(self, terms):
        return 4

    def weak_order(self, terms):
        """Order of convergence of expectations."""
        return 2


NinomiyaVictoir.__init__.__doc__ = ARGUMENTS
