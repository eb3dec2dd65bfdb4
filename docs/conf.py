"""The documentation site, built by ``make docs``. Pages are plain Markdown that GitHub shows as well.

Hooks keep the pages and the docstrings free of the markup of this tool: the lists of ``index.md`` become the navigation, and a
link to a file outside of docs/ leads to the checkout, or to the address that ``DOCS_SOURCE_URL`` names.
"""

import os
import re
from pathlib import Path
from typing import Any

from sphinx.util import logging

import stable_data

ROOT = Path(__file__).resolve().parents[1]
SOURCE_URL = os.environ.get("DOCS_SOURCE_URL", "../..")  # from build/docs to the checkout

project = "stable-data"
version = release = stable_data.__version__
extensions = ["myst_parser", "sphinx.ext.apidoc", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.viewcode"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
html_theme = "furo"
html_title = f"stable-data {version}"
html_copy_source = False
html_show_copyright = False
highlight_language = "none"
exclude_patterns = ["api/modules.rst"]

myst_heading_anchors = 4
myst_url_schemes = {"http": None, "https": None, "source": SOURCE_URL + "/{{path}}"}

apidoc_modules = [
    {
        "path": "../stable_data",
        "destination": "api",
        "exclude_patterns": ["../stable_data/embedded_world/families", "../stable_data/embedded_world/groups"],
        "separate_modules": True,
        "module_first": True,
        "automodule_options": {"members"},
    }
]
autodoc_mock_imports = ["lance", "pydrake"]  # optional, and not in the environment of the site
autodoc_default_options = {"ignore-module-all": True}  # a name is described in the module that defines it
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
napoleon_use_ivar = True
add_module_names = False

_COLON = "\ue000"  # a private character: napoleon would read the words before a colon as a type


def add_navigation(_app: Any, page: str, source: list[str]) -> None:
    """Makes the lists of links of the first page the navigation, each with its heading as the caption."""
    if page != "index":
        return
    source[0] = source[0].replace("](../stable_data)", "](api/stable_data.rst)")
    for caption, section in re.findall(r"^## (.+)\n((?:.|\n(?!## ))*)", source[0], re.MULTILINE):
        pages = re.findall(r"^- \[.+?\]\((\w+)\.md\)", section, re.MULTILINE)
        pages += ["api/stable_data"] if caption == "Reference" else []
        source[0] += "\n".join(["", "```{toctree}", ":hidden:", f":caption: {caption}", *pages, "```", ""])


def link_to_sources(_app: Any, page: str, source: list[str]) -> None:
    """Turns links that leave docs/ into links to the files of the checkout."""

    def to_source(link: re.Match[str]) -> str:
        if not (ROOT / link[1].partition("#")[0]).exists():
            logging.getLogger(__name__).warning("%s: no file %s in the checkout", page, link[1], type="source")
        return f"](source:{link[1]})"

    source[0] = re.sub(r"\]\(\.\./([^)]+)\)", to_source, source[0])


def shorten_titles(_app: Any, page: str, source: list[str]) -> None:
    """Names the pages of the API by module; the navigation shows the last part of a name."""
    if page.startswith("api/"):
        source[0] = re.sub(r"^(\S+) (?:package|module)$", r"\1", source[0], flags=re.MULTILINE)
        source[0] = re.sub(r"^   (stable_data\.(?:\w+\.)*(\w+))$", r"   \2 <\1>", source[0], flags=re.MULTILINE)


def escape_docstring(_app: Any, what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    """Keeps the bars of absolute values, and the first colon of a constant's description."""
    for k, line in enumerate(lines):
        parts = re.split(r"(``.+?``|`.+?`)", line)
        lines[k] = "".join(part if part.startswith("`") else part.replace("|", r"\|") for part in parts)
    if what in ("attribute", "data", "property") and lines:
        lines[0] = lines[0].replace(":", _COLON)


def restore_colon(_app: Any, _what: str, _name: str, _obj: object, _options: object, lines: list[str]) -> None:
    """Puts back the colons that :func:`escape_docstring` hid."""
    lines[:] = [line.replace(_COLON, ":") for line in lines]


def setup(app: Any) -> None:
    """Connects the hooks; napoleon reads docstrings at priority 500."""
    app.connect("source-read", add_navigation)
    app.connect("source-read", link_to_sources)
    app.connect("source-read", shorten_titles)
    app.connect("autodoc-process-docstring", escape_docstring, priority=400)
    app.connect("autodoc-process-docstring", restore_colon, priority=600)
