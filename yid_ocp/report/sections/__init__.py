"""Report sections: each file registers one function; its template has the name of the section.

A file outside the package does as well, once it is imported; its template `NAME.html` stands beside it.
"""

from importlib import import_module
from pkgutil import iter_modules

from yid_ocp.report.sections.base import REPORT_SECTIONS as REPORT_SECTIONS
from yid_ocp.report.sections.base import ReportData as ReportData
from yid_ocp.report.sections.base import ReportSection as ReportSection
from yid_ocp.report.sections.base import register_section as register_section
from yid_ocp.report.sections.base import render_sections as render_sections

# every file of this folder registers its section when it is imported
for _file in iter_modules(__path__):
    import_module(f"{__name__}.{_file.name}")
