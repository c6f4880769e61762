"""Report sections: their input data, registration and rendering; each file of this folder registers some.

A section's function turns `ReportData` into what its template needs, or into None where it has nothing to say. A file
outside the package does as well, once it is imported; its template `NAME.html` stands beside it.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, Any, TypeVar

from yid_ocp.model.system import System
from yid_ocp.problem import EstimationProblem
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.registry import Registry
from yid_ocp.report.animation import Animation
from yid_ocp.solvers import Solution

if TYPE_CHECKING:
    import jinja2


@dataclass(frozen=True)
class ReportData:
    """Input data of a report: result, problem, solution and further objects of one run.

    Attributes
    ----------
    result : mapping
        Contents of result.json; `format` says of which command.
    animations : sequence of Animation
        What moves, where it does not follow from `problem`, `solution` and `held_out`.
    section_data : mapping
        Whatever else a command's own sections need.
    """

    name: str
    description: str
    result: Mapping[str, Any]
    problem: EstimationProblem | None = None
    solution: Solution | None = None
    held_out: Sequence[tuple[Episode, EpisodePrediction | str]] = ()
    animations: Sequence[Animation] = ()
    section_data: Mapping[str, Any] = field(default_factory=dict)

    @property
    def predicted_episodes(self) -> list[tuple[str, Episode, EpisodePrediction]]:
        """Tuples (role, episode, prediction) of all episodes with a prediction; role is estimate or held_out."""
        found: list[tuple[str, Episode, EpisodePrediction]] = []
        if self.problem is not None and self.solution is not None and self.solution.evaluation is not None:
            done = self.solution.episode_predictions
            pairs = zip(self.problem.episodes, done, strict=True)
            found += [("estimate", e, r) for e, r in pairs if not isinstance(r, str)]
        return found + [("held_out", e, r) for e, r in self.held_out if not isinstance(r, str)]


_Row = TypeVar("_Row")
_PrepareContext = Callable[[ReportData], Mapping[str, Any] | None]


@dataclass(frozen=True)
class _ReportSection:
    """One registered section: order, title and the function that prepares its template context."""

    order: int
    title: str
    prepare_context: _PrepareContext

    @property
    def template_folder(self) -> Path:
        """Folder of the function's file, in which a plug-in's template is looked up."""
        return Path(inspect.getfile(self.prepare_context)).parent


REPORT_SECTIONS: Registry[_ReportSection] = Registry("report section")


def register_report_section(name: str, order: int, title: str) -> Callable[[_PrepareContext], _PrepareContext]:
    """Decorator that registers a function as the section `name`, lower orders first.

    What it returns is rendered by `NAME.html`, or by `figures.html` (pairs of title and figure) where there is none.
    """

    def enter(prepare: _PrepareContext) -> _PrepareContext:
        REPORT_SECTIONS.register(name)(_ReportSection(order, title, prepare))
        return prepare

    return enter


_REVOLUTE_UNITS = {"position": "rad", "velocity": "rad/s", "effort": "N m", "position_command": "rad"}
_PRISMATIC_UNITS = {"position": "m", "velocity": "m/s", "effort": "N", "position_command": "m"}


def joint_channel_unit(system: System | None, names: Sequence[str], channel: str) -> str:
    """Unit of a joint channel; joints unknown to the system count as revolute."""
    kinds = {} if system is None else {joint.name: joint.kind for joint in system.mechanism.joints}
    sliding = [kinds.get(name) == "prismatic" for name in names]
    if any(sliding) and not all(sliding):
        return f"{_REVOLUTE_UNITS[channel]}, {_PRISMATIC_UNITS[channel]}"
    return _PRISMATIC_UNITS[channel] if names and all(sliding) else _REVOLUTE_UNITS[channel]


def figures_by_unit(
    rows: Iterable[tuple[str, str, _Row]], draw: Callable[[Mapping[str, _Row], str], Any], title: str = ""
) -> list[tuple[str, Any]]:
    """One titled figure for all rows (name, unit, row) of one unit."""
    grouped: dict[str, dict[str, _Row]] = {}
    for name, unit, row in rows:
        grouped.setdefault(unit, {})[name] = row
    return [(title, draw(own, unit)) for unit, own in grouped.items()]


def render_sections(findings: ReportData, environment: jinja2.Environment) -> list[dict[str, str]]:
    """Name, title and HTML of every section with content, in order."""
    result = []
    for name in sorted(REPORT_SECTIONS, key=lambda entry: REPORT_SECTIONS[entry].order):
        context = REPORT_SECTIONS[name].prepare_context(findings)
        if context is not None:
            html = environment.select_template([f"{name}.html", "figures.html"]).render(context)
            result.append({"name": name, "title": REPORT_SECTIONS[name].title, "html": html})
    return result


# every file of this folder registers its sections when it is imported
for _file in iter_modules(__path__):
    import_module(f"{__name__}.{_file.name}")
