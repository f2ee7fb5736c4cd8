"""Pages of one file that need no network: Plotly's script, the style and the numbers stand in them."""

from __future__ import annotations

import re
from typing import Any

from scp_recon.report.content.numbers import script

OWN = "scp_recon.report"


def render_offline(
    template: str, javascript: str, data: Any, package: str = OWN, **shown: Any
) -> str:
    """A template's HTML with all that it needs; its charts are begun once it can be read.

    Args:
        template: name of a file in the package's `page_files`.
        javascript: the same, of what draws its charts.
        data: what the script is given.
        package: whose page it is; the style and `scripts.html` are the report's.
        shown: what the template names.
    """
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    loader = ChoiceLoader([PackageLoader(name, "page_files") for name in (package, OWN)])
    pages = Environment(
        loader=loader,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )

    def text(name: str) -> str:
        return loader.get_source(pages, name)[0]

    return pages.get_template(template).render(
        **shown,
        css=text("report.css"),
        js=text(javascript),
        plotly=plotly_script(),
        data=script(data),
    )


def plotly_script() -> str:
    """Plotly's script without the loader about it.

    The loader is handed all of the script as one function, which a browser therefore reads twice:
    first to find its end, then to run it.
    """
    from plotly.offline import get_plotlyjs

    whole = get_plotlyjs()
    bare = re.search(r'"use strict";var Plotly=.*window\.Plotly = Plotly;', whole, re.DOTALL)
    return whole if bare is None else whole[: whole.index("*/") + 2] + bare[0]
