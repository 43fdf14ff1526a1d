"""What MkDocs needs to build pages that fetch nothing from elsewhere."""

import functools as ft
import html
import importlib.metadata
import pathlib
import re

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
_mathml = LatexToMathML(annotation=True)


def on_files(files, config):
    # The copy of STIX Two Math that ziamath brings along, for systems without a font that
    # has the sizes of brackets, roots and sums.
    font = "fonts/STIXTwoMath-Regular.ttf"
    path = importlib.metadata.distribution("ziamath").locate_file(f"ziamath/{font}")
    files.append(File.generated(config, font, content=pathlib.Path(path).read_bytes()))
    return files


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
