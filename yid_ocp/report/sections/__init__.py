"""Input data, registration and rendering of report sections. Each file of this folder registers some sections.

A plug-in can register sections, too. It keeps the template `NAME.html` of a section next to its own file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, TypeVar

from yid_ocp.display import grouped
from yid_ocp.problem import EstimationProblem
from yid_ocp.registry import Registry
from yid_ocp.report.animation import AnimationData
from yid_ocp.solvers import Solution

if TYPE_CHECKING:
    import jinja2


@dataclass(frozen=True)
class ReportData:
    """The input data of a report: `result` (content of result.json) and, if available, problem, solution and more.

    `animations` replaces the animations made from `problem` and `solution`. `section_data` holds other data for the
    sections of a command. `robot` is the URDF file from which the arms' meshes are drawn.
    """

    name: str
    description: str
    result: Mapping[str, Any]
    problem: EstimationProblem | None = None
    solution: Solution | None = None
    animations: Sequence[AnimationData] = ()
    robot: str | None = None
    section_data: Mapping[str, Any] = field(default_factory=dict)


_Row = TypeVar("_Row")
_PrepareContext = Callable[[ReportData], Mapping[str, Any] | Iterable[tuple[str, Any]] | None]


@dataclass(frozen=True)
class _ReportSection:
    order: int
    title: str
    prepare_context: _PrepareContext


REPORT_SECTIONS: Registry[_ReportSection] = Registry("report section")


def register_report_section(name: str, order: int, title: str) -> Callable[[_PrepareContext], _PrepareContext]:
    """Return a decorator that registers a function as the report section `name`. Lower values of `order` come first.

    The function returns the context of the template `NAME.html` or, for a section without a template, pairs (title,
    figure). It returns None or no pair if the section has no content.
    """

    def enter(prepare: _PrepareContext) -> _PrepareContext:
        REPORT_SECTIONS.register(name)(_ReportSection(order, title, prepare))
        return prepare

    return enter


def draw_figure_per_unit(
    rows: Iterable[tuple[str, str, _Row]], draw: Callable[[Mapping[str, _Row], str], Any]
) -> list[tuple[str, Any]]:
    """Draw one figure for all `rows` (name, unit, data) of the same unit. Returns pairs (empty title, figure)."""
    by_unit = grouped((unit, (name, row)) for name, unit, row in rows)
    return [("", draw(dict(own), "" if unit == "1" else unit)) for unit, own in by_unit.items()]


def rendered_section_dicts(findings: ReportData, environment: jinja2.Environment) -> list[dict[str, str]]:
    """Return all sections that have content, in order, each with the keys `name`, `title` and `html`."""
    result = []
    for name, section in sorted(REPORT_SECTIONS.items(), key=lambda entry: entry[1].order):
        context = section.prepare_context(findings)
        if not isinstance(context, Mapping):
            figures = [*(context or ())]
            context = {"figures": figures} if figures else None
        if context is not None:
            html = environment.select_template([f"{name}.html", "figures.html"]).render(context)
            result.append({"name": name, "title": section.title, "html": html})
    return result


# every file of this folder registers its sections when it is imported
for _file in iter_modules(__path__):
    import_module(f"{__name__}.{_file.name}")
