"""Growth of mean squares in one step of the linear models, exactly."""

import numpy as np

from ._models import (
    EXPLICIT,
    GENERAL,
    growth_factors,
    moment_maps,
    SEPARABLE,
    spring_growth_rate,
)
from ._page import fill, Page, table


ALL = {**GENERAL, **SEPARABLE, **EXPLICIT}
QUICK = ("ImplicitMidpoint", "SRKs3", "Heun", "Euler")
SHOWN = (
    "ImplicitMidpoint", "SRKw1(b=0)", "StrangGauss", "SRKs3", "SRKw4", "Heun", "SlowRK",
    "Euler",
)  # fmt: skip
# A short step and a long one, weak noise and strong noise.
HS = np.array([0.1, 2.0])
STRENGTHS = np.array([0.05, 1.0])


def section(page: Page) -> str:
    exact = spring_growth_rate(STRENGTHS)
    short, long = HS
    weak, strong = STRENGTHS
    print(f"\nGrowth on linear models; h = {short:g}, s = {strong:g}")
    rows = []
    for name in QUICK if page.quick else SHOWN:
        rates = {
            model: np.log(growth_factors(maps)) / HS[:, None]
            for model, maps in moment_maps(ALL[name], HS, STRENGTHS).items()
        }
        linear = f"{rates['linear'][0, 1]:.1e}"
        kubo = f"{rates['kubo'][0, 1]:.1e}" if "kubo" in rates else ""
        errors = rates["spring"] / exact - 1
        rows.append(
            (name, linear, kubo, f"{errors[0, 0]:+.1e}", f"{errors[1, 1]:+.1e}")
        )
    heads = "solver", "linear", "Kubo", "spring", f"spring, $h = {long:g}$"
    return fill(
        __file__,
        table=table(heads, rows),
        h=f"{short:g}",
        long=f"{long:g}",
        s=f"{strong:g}",
        weak=f"{weak:g}",
    )
