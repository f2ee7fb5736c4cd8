"""Pages of one file that need no network: Plotly's script, the style and the numbers stand in them."""

from __future__ import annotations

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
    from plotly.offline import get_plotlyjs

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
        plotly=get_plotlyjs(),
        data=script(data),
    )
