"""Growth of mean squares in one step of the linear models, exactly."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm

from ._models import (
    ADDITIVE,
    Case,
    EXPLICIT,
    GENERAL,
    growth_factors,
    moment_maps,
    SEPARABLE,
    spring_growth_rate,
)
from ._page import fill, Page, table


ALL = {**GENERAL, **SEPARABLE, **ADDITIVE, **EXPLICIT}
QUICK = ("ImplicitMidpoint", "SRKs3", "Heun", "Euler")
# The pictures have all of them, the table these.
SHOWN = (
    "ImplicitMidpoint", "SRKw1(b=0)", "SRKw2", "StrangGauss", "SRKs3", "SRKw4", "Heun",
    "SlowRK", "Euler",
)  # fmt: skip
# Below this a growth factor is 1 but for rounding.
ROUNDING = 1e-12


def _linear(page: Page, hs, factors: dict[str, np.ndarray]) -> str:
    figure, axes = plt.subplots(figsize=(6, 4))
    alike = {}  # the names of the methods that grow in the same way
    for name, factor in factors.items():
        x = factor - 1
        rate = np.maximum(np.abs(x) / hs, 1e-17)
        if np.any(x > ROUNDING):
            alike.setdefault(f"{rate[-1]:.6g}", (rate, []))[1].append(name)
        else:
            axes.loglog(hs, rate, "k-", lw=0.4)
    for rate, names in alike.values():
        axes.loglog(hs, rate, label=", ".join(names), ls="--")
    axes.plot([], [], "k-", lw=0.4, label="the symplectic ones")
    axes.set(xlabel="h", ylabel="growth per unit time", ylim=(1e-17, 1e3))
    axes.legend(fontsize=7)
    axes.set_title("linear oscillator, additive noise")
    shown = page.picture(figure, "linear", "Growth on the linear oscillator")
    plt.close(figure)
    return shown


def _map(
    page: Page, name: str, title: str, caption: str, hs, strengths, values: dict
) -> str:
    """One picture over h and s for each solver."""
    # As wide as the page, so that labels are shown in their own size.
    columns = 4
    rows = -(-len(values) // columns)
    figure, axes = plt.subplots(
        rows, columns, figsize=(8, 2.1 * rows + 0.9), squeeze=False, sharex=True,
        sharey=True, layout="constrained",
    )  # fmt: skip
    norm, image = LogNorm(1e-16, 1e2), None
    for ax, (label, value) in zip(axes.flat, values.items()):
        shown = np.clip(np.abs(value), 1e-16, 1e2)
        image = ax.pcolormesh(strengths, hs, shown, norm=norm, cmap="magma")
        ax.set(xscale="log", yscale="log")
        ax.set_title(label, fontsize=10)
        ax.set_xticks([0.1, 1], ["0.1", "1"])
        ax.set_yticks([0.01, 0.1, 1], ["0.01", "0.1", "1"])
        ax.minorticks_off()
    # The last picture of each column has the labels of its axis.
    for number, ax in enumerate(axes.flat):
        ax.set_visible(number < len(values))
        if number + columns >= len(values):
            ax.set_xlabel("s")
            ax.tick_params(labelbottom=True)
    for ax in axes[:, 0]:
        ax.set_ylabel("h")
    assert image is not None
    figure.colorbar(image, ax=axes, label=title, location="bottom", aspect=40)
    markdown = page.picture(figure, name, caption)
    plt.close(figure)
    return markdown


def _near(grid, value: float) -> int:
    return int(np.argmin(np.abs(np.log(grid / value))))


def section(page: Page) -> str:
    points = 12 if page.quick else 48
    hs, strengths = np.geomspace(0.01, 4, points), np.geomspace(0.05, 2, points)
    cases: dict[str, Case] = {n: ALL[n] for n in (QUICK if page.quick else ALL)}
    factors = {"linear": {}, "kubo": {}, "spring": {}}
    for name, case in cases.items():
        for model, maps in moment_maps(case, hs, strengths).items():
            factors[model][name] = growth_factors(maps)

    linear = {name: f[:, 0] for name, f in factors["linear"].items()}
    rates = {n: np.log(f) / hs[:, None] for n, f in factors["kubo"].items()}
    exact = spring_growth_rate(strengths)
    errors = {
        n: np.log(f) / hs[:, None] / exact - 1 for n, f in factors["spring"].items()
    }
    i, j = _near(hs, 0.1), _near(strengths, 1.0)
    print(f"\nGrowth on linear models; h = {hs[i]:.2g}, s = {strengths[j]:.2g}")
    rows = [
        (
            name,
            f"{rates[name][i, j]:.1e}" if name in rates else "",
            f"{error[i, 0]:+.1e}",
        )
        for name, error in errors.items()
        if name in SHOWN
    ]
    title = "growth of E(p^2 + q^2) per unit time"
    caption = "Growth on the Kubo oscillator"
    kubo_picture = _map(page, "kubo", title, caption, hs, strengths, rates)
    title = "relative error of the growth rate"
    caption = "Error of the growth on the spring"
    spring_picture = _map(page, "spring", title, caption, hs, strengths, errors)
    return fill(
        __file__,
        table=table(("solver", "Kubo", "spring"), rows),
        linear_picture=_linear(page, hs, linear),
        kubo_picture=kubo_picture,
        spring_picture=spring_picture,
        h=f"{hs[i]:.2g}",
        s=f"{strengths[j]:.2g}",
        weak=f"{strengths[0]:.2g}",
    )
