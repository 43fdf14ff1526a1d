"""Shows each notebook of `examples/` as a page of the site."""

import base64
import json
from pathlib import PurePosixPath

from mkdocs.structure.files import File


def on_files(files, config):
    notebooks = [f for f in files if f.src_uri.endswith(".ipynb")]
    for notebook in notebooks:
        for uri, content in _page(PurePosixPath(notebook.src_uri), notebook):
            files.append(File.generated(config, uri, content=content))
    return files


def _page(uri: PurePosixPath, notebook: File):
    """Pairs of the address and the content of a page, and of its pictures."""
    cells = json.loads(notebook.content_string)["cells"]
    parts, pictures = [], []
    for cell in cells:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            if output["output_type"] == "stream":
                parts.append(f"```text\n{''.join(output['text']).rstrip()}\n```")
            elif png := output["data"].get("image/png"):
                pictures.append(base64.b64decode("".join(png)))
                name = f"{uri.stem}-{len(pictures)}.png"
                parts.append(f"![{cell['metadata']['title']}]({name})")
    parts.insert(1, f"*This page is a [notebook]({uri.name}), which you can download.*")
    yield str(uri.with_suffix(".md")), "\n\n".join(parts) + "\n"
    for number, picture in enumerate(pictures, start=1):
        yield str(uri.with_name(f"{uri.stem}-{number}.png")), picture
