"""Solvers for H0 = V(p) + U(t, q) and noise Hamiltonians U_k(t, q)."""

from typing import Any, ClassVar, get_args, Literal, TypeAlias

import equinox as eqx
import optimistix as optx

from .._tableau import PartitionedTableau, SeparableTableau
from .._terms import constraint_of
from .base import (
    AbstractImplicitStages,
    AbstractSymplecticRungeKutta,
    free_parameter,
)
from .constrained import end_on_surface, init_constrained
from .driven import drawn_variables
from .pieces import Flight, Kick, Moving, setting_of
from .record import Record
from .step import Outcome, result_of
from .times import result_with_times_checked


Variant: TypeAlias = Literal["a", "b", "c", "d", "e", "f"]


# The coefficients beta, A1 and B0 of a one-stage method with `alpha = 1` and `A0 = 1 / 2`.
_SRKW3 = {
    "a": (1, 1 / 2, 1 / 2),
    "b": (1, 1, 0),
    "c": (1, 0, 1),
    "d": (-1, 1 / 2, -1 / 2),
    "e": (-1, 1, 0),
    "f": (-1, 0, -1),
}


class SRKw3(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The one-stage symplectic methods SRKw3a to SRKw3f of Wang, Hong and Xu, of weak
    order 1, for $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    In the form of [`diffrax_symplectic.SeparableTableau`][], $\alpha = 1$,
    $A^0 = 1/2$, and

    | | a | b | c | d | e | f |
    |---|---|---|---|---|---|---|
    | $\beta$ | 1 | 1 | 1 | -1 | -1 | -1 |
    | $A^1$ | 1/2 | 1 | 0 | 1/2 | 1 | 0 |
    | $B^0$ | 1/2 | 0 | 1 | -1/2 | 0 | -1 |

    The `variant` `"a"` is the midpoint rule; `"b"` is a midpoint step of the drift, then an
    explicit kick by the noise; `"c"`, the default, is the kick, then the midpoint step.
    `"d"`, `"e"` and `"f"` are the same with negated increments, which have the same law.
    Weak order 1 for any number of noises.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 3.1.
    """

    record: ClassVar[Record] = Record(
        weak=1,
        strong=None,
        choose="Solves for half of the state, with explicit noise. For low accuracy.",
    )
    variant: Variant = eqx.field(default="c", static=True)

    def __check_init__(self):
        if self.variant not in get_args(Variant):
            raise ValueError(
                f"`variant` must be one of {get_args(Variant)}; got {self.variant!r}."
            )

    @property
    def tableau(self) -> SeparableTableau:
        beta, A1, B0 = _SRKW3[self.variant]
        return SeparableTableau(
            alpha=[1], beta=[beta], A0=[[1 / 2]], B0=[[B0]], A1=[[A1]]
        )


class SRKw4(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic methods SRKw4 of Wang, Hong and Xu, of weak order 2, for
    $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    In the form of [`diffrax_symplectic.SeparableTableau`][], $\alpha = \beta =
    (\frac12, \frac12)$ and

    $$A^0 = \begin{pmatrix} \frac14 & \frac12 - a_{21} \\ a_{21} & \frac14
      \end{pmatrix}, \quad B^0 = \begin{pmatrix} 1 & 0 \\ 0 & 0 \end{pmatrix}, \quad
      A^1 = \begin{pmatrix} -\frac12 & \frac12 \\ \frac12 & \frac12 \end{pmatrix}.$$

    A step depends only on these coefficients: the paper's third drift stage has weight 0,
    its second and third noise stages are evaluated at the same point, and its other
    parameters only affect these stages. For $a_{21} = 0$ and the default $1/2$ the matrix
    $A^0$ is triangular; for $\frac14 \pm \frac{\sqrt 3}{6}$ it is the Gauss method, of
    order 4 without noise.

    Weak order 2: by the paper for one noise, and measured for two and three noises.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 3.1.
    """

    record: ClassVar[Record] = Record(
        weak=2,
        strong=None,
        choose="Solves for half of the state. For stiff systems.",
        right_energy_unresolved=False,
    )
    a21: float = free_parameter("a21", 0.5)

    @property
    def tableau(self) -> SeparableTableau:
        return SeparableTableau(
            alpha=[1 / 2, 1 / 2],
            beta=[1 / 2, 1 / 2],
            A0=[[1 / 4, 1 / 2 - self.a21], [self.a21, 1 / 4]],
            B0=[[1, 0], [0, 0]],
            # The second noise stage is at the end of the step, the first at its start.
            A1=[[-1 / 2, 1 / 2], [1 / 2, 1 / 2]],
        )


class SRKs2(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic method SRKs2 of Wang, Hong and Xu, of strong order 1, for
    $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    Two of the paper's three noise stages are evaluated at the same point, with opposite
    weights. What remains is the midpoint rule: in the form of
    [`diffrax_symplectic.SeparableTableau`][], $\alpha = \beta = 1$ and
    $A^0 = B^0 = A^1 = \frac12$. Strong order 1 and weak order 1.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 3.2.
    """

    record: ClassVar[Record] = Record(
        weak=1,
        strong=1,
        choose="The midpoint rule on half of the state. For stiff systems.",
        right_energy_unresolved=False,
    )
    tableau: ClassVar[SeparableTableau] = SeparableTableau(
        alpha=[1], beta=[1], A0=[[1 / 2]], B0=[[1 / 2]], A1=[[1 / 2]]
    )


class SRKs3(AbstractSymplecticRungeKutta, AbstractImplicitStages):
    r"""The symplectic methods SRKs3 of Wang, Hong and Xu, of strong order 1 for any
    number of noises, for $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    In the form of [`diffrax_symplectic.SeparableTableau`][], $B^0 = 0$ and

    $$A^0 = \begin{pmatrix} a & 0 \\ 2a & \frac12 - a \end{pmatrix}, \quad
      \alpha = (2a,\; 1 - 2a), \quad
      A^1 = (2a,\; 1 - 2a), \quad
      \beta = 1.$$

    These are two midpoint steps of the drift over the fractions $2a$ and $1 - 2a$ of the
    step, then the kick $\sum_k \sigma_k(t_{n+1}, Q_1) I_k$. The default $a = 0$ gives a
    single midpoint step: in six problems $a$ changed the strong error by at most 3%, and
    any value other than 0 and 1/2 costs twice as much. The paper's other parameters cancel,
    since both of its noise stages are evaluated at $Q_1$. Strong order 1 and weak order 1.

    **Source:** [Wang, Hong and Xu (2017)](https://doi.org/10.4208/cicp.261014.230616a),
    section 3.2.
    """

    record: ClassVar[Record] = Record(
        weak=1,
        strong=1,
        choose="`SRKs2` with explicit noise. For many expensive noises.",
    )
    a: float = free_parameter("a", 0.0)

    @property
    def tableau(self) -> SeparableTableau:
        A0 = [[self.a, 0], [2 * self.a, 1 / 2 - self.a]]
        alpha = [2 * self.a, 1 - 2 * self.a]
        # The positions at the noise are those at the end of the step: its row is `alpha`.
        return SeparableTableau(alpha=alpha, beta=[1], A0=A0, B0=[[0], [0]], A1=[alpha])


# A step of `StormerVerlet` as the pieces of a splitting, whose flights keep a constraint.
_CONSTRAINED_STEP = (Flight(1 / 2), Kick(1), Flight(1 / 2))


class StormerVerlet(AbstractSymplecticRungeKutta):
    r"""The Störmer--Verlet method with the noise in its kick: explicit, symplectic, of weak
    order 2 and strong order 1 for any number of noises, for $H_0 = V(p) + U_0(t, q)$ and
    $H_k = U_k(t, q)$.

    $$\bar q = Q + \tfrac h2 g(P), \qquad
      P_1 = P + h f(t_n + \tfrac h2, \bar q)
        + \sum_k \sigma_k(t_n + \tfrac h2, \bar q) I_k, \qquad
      Q_1 = \bar q + \tfrac h2 g(P_1)$$

    in the notation of [`diffrax_symplectic.SeparableTableau`][]. Force and noise are
    evaluated at the same $q$, so the kick is the exact flow of both together. A step takes
    one evaluation of the forces, and must resolve the fastest frequency $\omega$ of $H_0$:
    $\omega h < 2$.

    **Constraints.** For constrained terms each drift over $h / 2$ is a step of
    RATTLE, $q \gets q + \frac h2 M^{-1} p$ with $p \gets p - J(q)^\top \lambda$ and
    multipliers $\lambda$ for which the new $q$ satisfies the constraint, and momenta are
    made tangent, $J M^{-1} p = 0$. Multipliers are found by Newton's method to rounding; a
    step fails if there are none, as happens if it is too long. It is symplectic on the
    allowed states, and reversible.

    **Source:** [Strang (1968)](https://doi.org/10.1137/0705041) for the splitting;
    [Ninomiya and Victoir (2008)](https://doi.org/10.1080/13504860701413958) for the weak
    order of symmetric splittings; [Leimkuhler and Skeel
    (1994)](https://doi.org/10.1006/jcph.1994.1085) for RATTLE.
    """

    keeps_constraints: ClassVar[bool] = True
    record: ClassVar[Record] = Record(
        weak=2,
        strong=1,
        choose="Explicit, with the cheapest step. Not for frequencies omega > 2 / h.",
    )
    tableau: ClassVar[PartitionedTableau] = PartitionedTableau(
        alpha=[1],
        alpha_hat=[1 / 2, 1 / 2],
        beta=[1],
        # The momenta before and after the kick, which is a single force stage: the first
        # velocity moves half a step, the second the other half.
        A=[[0], [1]],
        A_hat=[[1 / 2, 0]],
        B0=[[0], [1]],
        A1=[[1 / 2, 0]],
    )

    def init(self, terms, t0, t1, y0, args) -> Outcome:
        if constraint_of(terms) is None:
            return super().init(terms, t0, t1, y0, args)
        return init_constrained(self, terms, t0, y0, args)

    def step(self, terms, t0, t1, y0, args, solver_state: Any, made_jump) -> Any:
        if constraint_of(terms) is None:
            return super().step(terms, t0, t1, y0, args, solver_state, made_jump)
        setting = setting_of(terms, t0, t1, y0, args, has_flow=False)
        increments = []
        if setting.noise:
            name = type(self).__name__
            increments = drawn_variables(setting.noise, ["W"], t0, t1, name)["W"]
        # Multipliers are not sought for a path that failed before: others of its batch
        # would wait for it.
        pending = solver_state == optx.RESULTS.successful
        # The list has one entry, for the one kick.
        setting = setting._replace(increments=[increments], pending=pending)
        moving = Moving(y0, forces=None, flows={})
        for number, piece in enumerate(_CONSTRAINED_STEP):
            moving = piece.move(setting, moving, number)
        assert setting.surface is not None
        y1, outcome = end_on_surface(moving, setting.surface, solver_state)
        result = result_with_times_checked(terms, t0, t1, result_of(outcome, y1))
        return y1, None, dict(y0=y0, y1=y1), outcome, result


# The three kicks of `PlateauVerlet`, as combinations of random variables: with
# M = W / 2 + H these are M - C, 2 C and W - M - C.
_KICKS = {"W": [1 / 2, 0, 1 / 2], "H": [1, 0, -1], "C": [-1, 2, -1]}


class PlateauVerlet(AbstractSymplecticRungeKutta):
    r"""An explicit symplectic method of strong order 3/2 for any number of noises, for
    $H_0 = V(p) + U_0(t, q)$ and $H_k = U_k(t, q)$.

    Let $M_k = \frac1h \int (w_k(s) - w_k(t_n))\,\mathrm{d}s = \frac12 W_k + H_k$, with the
    increment $W_k$ and the space-time Lévy area $H_k$, and
    $C_k = \pm\sqrt{\frac{1}{15} h + \frac{1}{12} W_k^2 + \frac15 H_k^2}$ with fair,
    independent signs. A step is: a kick by $\sum_k \sigma_k (M_k - C_k)$; a
    Störmer--Verlet step of $H_0$ over $h / 2$; a kick by $\sum_k 2 \sigma_k C_k$; a
    Störmer--Verlet step over $h / 2$; a kick by $\sum_k \sigma_k (W_k - M_k - C_k)$; each
    kick at the current $q$. Thus the Brownian path is replaced by two plateaus,
    $M \mp C$, with the same mean and, in expectation given $W$ and $H$, the same mean
    square, which gives order 3/2 if the noise is not constant.

    Strong order 3/2 and weak order 2. The step must resolve the fastest frequency $\omega$
    of $H_0$: $\omega h < 4$. The path must be a
    [`diffrax_symplectic.PlateauBrownianPath`][].

    **Source:** the plateaus are from [Foster, dos Reis and Strange
    (2024)](https://doi.org/10.1137/23M155147X). There the signs of the $C_k$ depend on a
    third integral of the path; here they are independent of it. With their signs, errors
    were half as large; with $C_k = \pm\sqrt{h / 6}$, up to 1.3 times as large for small
    steps. For additive noise and second-order systems see [Milstein and Tretyakov
    (2021)](https://doi.org/10.1007/978-3-030-82040-4), chapters 4 and 5.
    """

    record: ClassVar[Record] = Record(
        weak=2,
        strong=3 / 2,
        choose="Explicit, with accurate paths. Not for frequencies omega > 4 / h.",
    )
    tableau: ClassVar[PartitionedTableau] = PartitionedTableau(
        alpha=[1 / 2, 1 / 2],
        alpha_hat=[1 / 4, 1 / 4, 1 / 4, 1 / 4],
        beta=_KICKS,
        # The momenta after the first kick, the first force, the second kick and the second
        # force.
        A=[[0, 0], [1 / 2, 0], [1 / 2, 0], [1 / 2, 1 / 2]],
        A_hat=[[1 / 4, 0, 0, 0], [1 / 4, 1 / 4, 1 / 4, 0]],
        # Momenta contain the kicks that came before. The last kick is in none of them.
        B0={
            name: [[first, 0, 0], [first, 0, 0], [first, second, 0], [first, second, 0]]
            for name, (first, second, _) in _KICKS.items()
        },
        # The positions of the three kicks: at the start, in the middle and at the end.
        A1=[[0, 0, 0, 0], [1 / 4, 1 / 4, 0, 0], [1 / 4, 1 / 4, 1 / 4, 1 / 4]],
    )
