"""How pictures look: the same solver has the same colour, line and marker in all of them.

Colours are those of Okabe and Ito (https://jfly.uni-koeln.de/color) and three of Tol's
(https://sronpersonalpages.nl/~pault), which people with any colour vision can tell apart.
Lines of solvers here are solid, those of solvers around a flow dash-dotted, and Diffrax's
are dashed. To be imported before figures are made.
"""

import re
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
from cycler import cycler


BLUE, SKY, GREEN, ORANGE = "#0072B2", "#56B4E9", "#009E73", "#E69F00"
VERMILION, PINK, BLACK, GREY = "#D55E00", "#CC79A7", "#000000", "#808080"
WINE, OLIVE, INDIGO = "#882255", "#999933", "#332288"

# In inches. On a phone, where 360 pixels are left for it, letters of 10 points have 8 of
# them, and on a wide screen 17 of 720.
WIDTH = 6.0
plt.rcParams.update(
    {
        "axes.grid": True,
        "axes.labelsize": 10,
        "axes.prop_cycle": cycler(color=[BLUE, VERMILION, GREEN, ORANGE, PINK]),
        "axes.titlesize": 10,
        "errorbar.capsize": 2,
        "figure.constrained_layout.use": True,
        "font.size": 10,
        "grid.alpha": 0.3,
        "legend.fontsize": 10,
        "legend.frameon": False,
        "lines.linewidth": 1.3,
        "lines.markersize": 5,
        "savefig.dpi": 120,
    }
)


class Style(NamedTuple):
    colour: str
    line: str
    marker: str


STYLES = {
    "ImplicitMidpoint": Style(BLUE, "-", "o"),
    "StormerVerlet": Style(GREEN, "-", "s"),
    "PlateauVerlet": Style(WINE, "-", "s"),
    "PlateauGauss": Style(WINE, "-", "X"),
    "AdditiveGauss": Style(WINE, "-", "h"),
    "StrangGauss": Style(BLACK, "-", "D"),
    "NinomiyaVictoir": Style(ORANGE, "-", "P"),
    "LevyAreaMidpoint": Style(INDIGO, "-", "o"),
    "SRKs1": Style(OLIVE, "-", ">"),
    "SRKs2": Style(GREY, "-", "<"),
    "SRKs3": Style(PINK, "-", "<"),
    "SRKs4": Style(INDIGO, "-", "<"),
    "SRKw1": Style(PINK, "-", "v"),
    "SRKw2": Style(SKY, "-", "^"),
    "SRKw3": Style(INDIGO, "-", "^"),
    "SRKw3c": Style(WINE, "-", "v"),
    "SRKw4": Style(SKY, "-", "X"),
    "SRKw5": Style(OLIVE, "-", "p"),
    "BAOAB": Style(ORANGE, "-", "o"),
    "LangevinMiddle": Style(GREEN, "-", "v"),
    "BAOAB(ImplicitMidpoint)": Style(SKY, "-.", "o"),
    "BAOAB(StormerVerlet)": Style(GREEN, "-.", "s"),
    "BAOAB(exact_flow)": Style(BLACK, "-.", "D"),
    "BAOAB(linear_flow)": Style(INDIGO, "-.", "^"),
    "LinearFlow": Style(INDIGO, "-.", "^"),
    "Euler": Style(BLACK, "--", "s"),
    "EulerHeun": Style(PINK, "--", "^"),
    "Heun": Style(VERMILION, "--", "o"),
    "StratonovichMilstein": Style(GREY, "--", "v"),
    "SlowRK": Style(ORANGE, "--", "D"),
    "ShARK": Style(BLACK, "--", "X"),
    "ALIGN": Style(BLUE, "--", "<"),
    "QUICSORT": Style(BLACK, "--", ">"),
}


# As the paper calls it.
STYLES["Milstein"] = STYLES["StratonovichMilstein"]


# Of solvers that have no style yet.
_OTHER = Style("0.4", ":", "x")


def style(name: str) -> dict[str, Any]:
    """The arguments of `plot` for a solver, by the name of its class, perhaps
    with arguments in brackets and more after a comma: `SRKw1(b=0)`, `Heun, springs`."""
    solver, *arguments = re.findall(r"\w+", name)
    # With the solver or the flow within, if that has a style of its own.
    full = f"{solver}({arguments[0]})" if arguments else solver
    plain = "SRKw3" if solver.startswith("SRKw3") else solver
    names = (name, full, solver, plain)
    found = next((STYLES[key] for key in names if key in STYLES), _OTHER)
    return dict(color=found.colour, ls=found.line, marker=found.marker)


def line(name: str) -> dict[str, Any]:
    """The same for curves of many points: without markers."""
    return style(name) | dict(marker="")


def colour(name: str) -> str:
    return style(name)["color"]
