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
# A cell of a table with a number, perhaps in bold: browsers break those like 1e-9.
_NUMBER = re.compile(r"<td>((?:<strong>)?[-+]?\d[^\s<]*(?:</strong>)?)</td>")
# A row with one cell in bold and the others empty: a heading within a table.
_HEADING = re.compile(r"<td>(<strong>.*?</strong>)</td>((?:\s*<td></td>)+)(?=\s*</tr>)")
# A command, or another character.
_TOKEN = re.compile(r"\\[a-zA-Z]+|\\?.", re.DOTALL)
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
    page_html = _HEADING.sub(_over_the_row, page_html)
    page_html = _NUMBER.sub(r'<td class="number">\1</td>', page_html)
    return _FORMULA.sub(_render, page_html)


def _over_the_row(heading: re.Match) -> str:
    columns = 1 + heading[2].count("<td>")
    return f'<td colspan="{columns}">{heading[1]}</td>'


def _render(formula: re.Match) -> str:
    tex = html.unescape(formula["tex"])
    if formula["tag"] == "span":
        return _convert(tex, False)
    # Browsers do not break formulas into lines, but they do between formulas.
    parts = [_convert(part, True) for part in _equations(tex)]
    return f'<div class="formula">{" ".join(parts)}</div>'


def _equations(tex: str) -> list[str]:
    """What stands in a displayed formula between wide spaces that are not within a matrix
    or braces."""
    parts = [""]
    depth = 0
    for token in _TOKEN.findall(tex):
        if token in (r"\begin", "{"):
            depth += 1
        elif token in (r"\end", "}"):
            depth -= 1
        if token in (r"\quad", r"\qquad") and depth == 0:
            parts.append("")
        else:
            parts[-1] += token
    return [part for part in parts if part.strip()]


@ft.cache
def _convert(tex: str, displayed: bool) -> str:
    return _mathml.convert_with_local_state(tex.strip(), displaystyle=displayed)
