"""The report: one self-contained page put together from the registered sections."""

from __future__ import annotations

import logging
from importlib import util
from pathlib import Path

from yid_ocp.files import write_text
from yid_ocp.report.sections import SECTIONS, Findings, written_sections

log = logging.getLogger(__name__)


def write_report(path: Path, findings: Findings) -> bool:
    """Write the page; plotly's script is embedded once, so it needs no network.

    Parameters
    ----------
    path : Path
    findings : Findings

    Returns
    -------
    bool
        False, with one notice, where the extra `report` is not installed.

    Raises
    ------
    OutputError
    """
    if util.find_spec("jinja2") is None or util.find_spec("plotly") is None:
        log.warning("no report: install it with  pip install 'yid-ocp[report]'")
        return False
    import jinja2
    import plotly.offline

    beside = {str(SECTIONS[name].folder) for name in SECTIONS}
    loader = jinja2.ChoiceLoader([jinja2.PackageLoader("yid_ocp.report"), jinja2.FileSystemLoader(sorted(beside))])
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined)
    environment.filters["number"] = number
    sections = written_sections(findings, environment)
    page = environment.get_template("page.html").render(
        findings=findings, sections=sections, script=plotly.offline.get_plotlyjs()
    )
    write_text(path, page)
    return True


def number(value: object, digits: int = 4) -> str:
    """A number for people; what is not known is a dash."""
    if value is None:
        return "–"
    return f"{value:.{digits}g}" if isinstance(value, float) else str(value)
