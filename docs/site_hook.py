"""Takes README and what the pages link to outside `docs` into the site, and formulas: a hook of MkDocs.

Pages link as files do in the repository, so that both a reader of the repository and one of the site
get somewhere: `docs/frames.md` in README, `../examples/halo_transfer.py` in a page.
"""

from __future__ import annotations

import ast
import posixpath
import re
import tomllib
from contextlib import suppress
from html import unescape
from pathlib import Path
from typing import Any

from latex2mathml.converter import convert
from mkdocs.structure.files import File, Files
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import get_lexer_by_name

_LINK = re.compile(r"(?<=\]\()([^)#\s]+)")
_FORMULA = re.compile(r'(?s)<(?:span|div) class="arithmatex">\\([(\[])(.*?)\\[)\]]</(?:span|div)>')
"""As pymdownx.arithmatex leaves them."""
_CODE = re.compile(
    r'(?s)(<div class="highlight"><pre><span></span><code>)(.*?)(</code></pre></div>)'
)
"""Blocks of code without a language, as pymdownx.highlight leaves them."""
_PAGES = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "CONTRIBUTING.md",
    "CHANGELOG.md": "CHANGELOG.md",
}
"""Pages of the repository's top folder, by their name in the site."""


def on_files(files: Files, config: Any) -> Files:
    """The site's files: those of `docs`, the top folder's pages, and what any of them links to."""
    docs = Path(config.docs_dir)
    for name, page in _PAGES.items():
        files.append(File.generated(config, page, content=_of_top(docs.parent / name)))
    for page in list(files.documentation_pages()):
        for link in _LINK.findall(page.content_string):
            path = posixpath.normpath(posixpath.join(posixpath.dirname(page.src_uri), link))
            outside = path.startswith("../") and path.removeprefix("../") not in _PAGES
            if outside and (docs / path).is_file():
                name, shown = _shown(docs.parent, path.removeprefix("../"))
                if name not in files.src_uris:
                    files.append(File.generated(config, name, content=shown.read_bytes()))
    return files


def _shown(top: Path, name: str) -> tuple[str, Path]:
    """Name in the site, and file, of a file outside `docs`: a notebook as it ran, if it did."""
    ran = Path("runs/notebooks", Path(name).name).with_suffix(".html")
    if Path(name).parent.name == "notebooks" and (top / ran).is_file():
        return f"notebooks/{ran.name}", top / ran
    return f"source/{name}", top / name


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """A page with its links to files outside `docs` led to their copies in the site."""
    here = posixpath.dirname(page.file.src_uri)

    def led(match: re.Match[str]) -> str:
        path = posixpath.normpath(posixpath.join(here, match[0]))
        if not path.startswith("../"):
            return match[0]
        name = path.removeprefix("../")
        inside = _PAGES.get(name) or _shown(Path(config.docs_dir).parent, name)[0]
        return posixpath.relpath(inside, here or ".")

    return _LINK.sub(led, markdown)


def on_page_content(html: str, **_: Any) -> str:
    """A page with formulas as MathML, which browsers typeset without a script, and coloured code."""

    def typeset(match: re.Match[str]) -> str:
        return convert(unescape(match[2]), display="block" if match[1] == "[" else "inline")

    return _CODE.sub(_coloured, _FORMULA.sub(typeset, html))


def _coloured(match: re.Match[str]) -> str:
    """A block of code with its tokens marked, as the theme colours them."""
    code = unescape(match[2])
    lines = highlight(code, get_lexer_by_name(_language(code)), HtmlFormatter(nowrap=True))
    return f"{match[1]}{lines}{match[3]}"


def _language(code: str) -> str:
    """TOML or Python if their readers take the code, else a shell's."""
    for language, reader in (("toml", tomllib.loads), ("python", ast.parse)):
        with suppress(ValueError, SyntaxError):  # what tomllib raises is a ValueError
            if reader(code):
                return language
    return "bash"


def _of_top(file: Path) -> str:
    """A page of the top folder with its links as they are in `docs`."""

    def led(match: re.Match[str]) -> str:
        link = match[0]
        if "://" in link or link in _PAGES:
            return _PAGES.get(link, link)
        return link.removeprefix("docs/") if link.startswith("docs/") else f"../{link}"

    return _LINK.sub(led, file.read_text("utf-8"))
