"""What MkDocs needs to build pages that fetch nothing from elsewhere."""

import functools as ft
import html
import importlib.metadata
import io
import re

from fontTools.ttLib import TTFont
from math_core import LatexToMathML
from mkdocs.structure.files import File


# Docstrings refer to these. Written down here, an inventory need not be fetched.
_ELSEWHERE = {
    "diffrax.AbstractBrownianPath.evaluate": "https://docs.kidger.site/diffrax/api/"
    "brownian/#diffrax.AbstractBrownianPath.evaluate",
}

_FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\s*\\[(\[](?P<tex>.*?)\\[)\]]\s*</(?P=tag)>',
    re.DOTALL,
)
# Raises an error for what it does not know, which ends the build.
_mathml = LatexToMathML()


def on_files(files, config):
    files.append(File.generated(config, "fonts/formulas.woff", content=_font()))
    return files


def _font() -> bytes:
    """STIX Two Math, for readers whose system has no font with brackets, roots and sums of
    all sizes: the copy that ziamath brings along, with one change.

    Browsers reserve for every root sign the width of the largest there is, which leaves a
    gap behind the small ones. So the larger ones are made as narrow as the smallest.
    """
    ttf = "ziamath/fonts/STIXTwoMath-Regular.ttf"
    path = importlib.metadata.distribution("ziamath").locate_file(ttf)
    font = TTFont(str(path))
    glyphs, metrics = font["glyf"], font["hmtx"]
    root = (font.getBestCmap() or {})[ord("√")]
    width, _ = metrics[root]
    for name in font.getGlyphOrder():
        if name.startswith(f"{root}.") and metrics[name][0] > width:
            glyph = glyphs[name]
            glyph.coordinates.scale((width / metrics[name][0], 1))
            glyph.coordinates.toInt()
            glyph.recalcBounds(glyphs)
            metrics[name] = (width, glyph.xMin)
    font.flavor = "woff"
    out = io.BytesIO()
    font.save(out)
    return out.getvalue()


def on_env(env, config, files):
    for identifier, url in _ELSEWHERE.items():
        config.plugins["autorefs"].register_url(identifier, url)
    return env


def on_page_content(page_html, page, config, files):
    return _FORMULA.sub(_render, page_html)


def _render(formula: re.Match) -> str:
    displayed = formula["tag"] == "div"
    mathml = _convert(html.unescape(formula["tex"]), displayed)
    return f'<div class="formula">{mathml}</div>' if displayed else mathml


@ft.cache
def _convert(tex: str, displayed: bool) -> str:
    return _mathml.convert_with_local_state(tex.strip(), displaystyle=displayed)
