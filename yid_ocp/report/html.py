"""The HTML report: one self-contained page with all registered sections that have content."""

from __future__ import annotations

import base64
import contextlib
import functools
import gzip
import inspect
import logging
import os
import re
from importlib import metadata, util
from pathlib import Path

from yid_ocp.errors import OutputError, YidError
from yid_ocp.files import write_text
from yid_ocp.inference.uncertainty import VERDICT_TABLE_TEXTS
from yid_ocp.integrator.compiler import private_cache_folder
from yid_ocp.report.figures import figure_html
from yid_ocp.report.sections import REPORT_SECTIONS, ReportData, rendered_section_dicts
from yid_ocp.report.terminal import CodeBlock, SummaryTable
from yid_ocp.solvers.base import Status

log = logging.getLogger(__name__)
_SHARED_SCRIPT_LEVELS = 2  # number of folders above a page that are searched for a shared script, as of a batch
_WRAP_LENGTH = 24  # characters from which the cells of a column are wrapped
_STATE_WORDS = {*VERDICT_TABLE_TEXTS.values(), *(status.value for status in Status)}  # in a column of numbers
_NUMBER = re.compile(
    r"^(–|-|unknown|failed|(< |± )?[-+]?\d[\d.]*(e[-+]?\d+)?( %| ms| s| Hz| times)?( ± [\d.]+(e[-+]?\d+)?( %)?)?)?$"
)


def write_report(path: Path, findings: ReportData) -> bool:
    """Write the HTML report, and return whether it was written. Raises `OutputError` if writing fails.

    The page works offline: it contains Plotly's script, unless `write_shared_plotly_script` has written one to the
    page's folder or up to two levels above. Without the extra `report`, a warning is logged and no page is written.
    """
    if not _installed():
        log.warning("no report is written, because plotly is missing: pip install '.[report]' in the project's clone")
        return False
    import jinja2

    # the template of a plug-in is next to its file
    folders = {str(Path(inspect.getfile(own.prepare_context)).parent) for own in REPORT_SECTIONS.values()}
    loader = jinja2.ChoiceLoader([jinja2.PackageLoader("yid_ocp.report"), jinja2.FileSystemLoader(sorted(folders))])
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.filters |= {"listed": _column_classes, "drawn": figure_html}
    environment.filters["number"] = lambda x, n=4: "–" if x is None else f"{x:.{n}g}" if isinstance(x, float) else x
    environment.filters["verdict"] = {words: verdict for verdict, words in VERDICT_TABLE_TEXTS.items()}.get
    environment.tests["table"] = lambda block: isinstance(block, SummaryTable)
    environment.tests["command"] = lambda block: isinstance(block, CodeBlock)
    shared = _shared_script(path)
    scripts = {"shared": shared, "packed": "" if shared else _packed_script()}
    page = environment.get_template("page.html")
    write_text(path, page.render(findings=findings, sections=rendered_section_dicts(findings, environment), **scripts))
    return True


def write_shared_plotly_script(folder: Path) -> None:
    """Write Plotly's script to a folder, for pages in it and up to two levels below. Raises `OutputError`."""
    if _installed():
        name, text = _plotly_script()
        if not _is_plotly_script(folder / name):
            write_text(folder / name, text)


def _installed() -> bool:
    return util.find_spec("plotly") is not None


@functools.cache
def _plotly_script() -> tuple[str, str]:
    import plotly.offline

    return f"plotly-{plotly.offline.get_plotlyjs_version()}.min.js", plotly.offline.get_plotlyjs()


def _shared_script(path: Path) -> str:
    folders = [path.parent, *path.parent.parents][: _SHARED_SCRIPT_LEVELS + 1]
    scripts = (script for folder in folders for script in sorted(folder.glob("plotly-*.min.js")))
    found = next(filter(_is_plotly_script, scripts), None)
    return "" if found is None else Path(os.path.relpath(found, path.parent)).as_posix()


def _is_plotly_script(path: Path) -> bool:
    """Check whether a file is byte for byte Plotly's script, because any file can have its name."""
    own = _plotly_script()[1].encode()
    return path.is_file() and path.stat().st_size == len(own) and path.read_bytes() == own


@functools.cache
def _packed_script() -> str:
    """Return Plotly's script as compressed base64 text, which the page unpacks. The user's cache keeps it."""
    file: Path | None = None
    with contextlib.suppress(YidError):  # a page has its script without a cache, too
        file = private_cache_folder() / f"plotly-{metadata.version('plotly')}.base64"
    if file and file.is_file():
        return file.read_text(encoding="ascii")
    packed = base64.b64encode(gzip.compress(_plotly_script()[1].encode(), compresslevel=4, mtime=0)).decode("ascii")
    with contextlib.suppress(OutputError):
        if file:
            write_text(file, packed)
    return packed


def _column_classes(table: SummaryTable) -> list[str]:
    kinds: list[str] = []
    for _, *cells in zip(*table.rows, strict=True):
        wide = max(map(len, cells), default=0) > _WRAP_LENGTH
        shown = [cell.removesuffix(" (fixed)") for cell in cells if cell and cell not in _STATE_WORDS]
        kind = "number" if shown and all(map(_NUMBER.match, shown)) else "long" if wide else "text"
        kinds.append(kind if any(cells) else "")
    return kinds
