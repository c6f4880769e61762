"""The blocks of a result's summary (statements, tables, code), shared texts, and their form on a terminal."""

from __future__ import annotations

import math
import re
import shlex
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from yid_ocp.data import JOINT_CHANNEL_UNITS, JointGroup, PointGroup, Recording, SensorChannelGroup
from yid_ocp.data.channel_checks import ISSUE_CAUSE_DESCRIPTIONS, mean_sample_rate
from yid_ocp.display import abbreviated_names_text, count_with_noun, grouped
from yid_ocp.inference import uncertainty
from yid_ocp.registry import Registry
from yid_ocp.sensors.base import channel_specs_for_group_name

if TYPE_CHECKING:
    from yid_ocp.data.readers import FilePreview

TableRows = list[Sequence[str]]
_MIN_TABLE_ISSUES = 4  # number of issues from which on a table gives an overview
_MAX_CHANGE_FROM_START = 0.05  # relative change of a parameter up to which a fit has left it near its start
MAX_NOISE_RATIO = 2.0  # largest ratio of an error to noise, or to the fit's error, that needs no sentence
MAX_CHANNELS_SHOWN_SINGLY = 4  # larger groups of points are shown as a whole; result.json has every point
_PROSE_WIDTH = 100  # width to which sentences are wrapped


@dataclass(frozen=True)
class SummaryStatement:
    """A sentence of a summary, with its importance.

    The kind is `verdict` (answers the question of the command), `conclusion` (summarises several verdicts) or `note`
    (further information). A report shows conclusions first, then verdicts.
    """

    text: str
    kind: Literal["note", "verdict", "conclusion"] = "note"


@dataclass(frozen=True)
class SummaryTable:
    """A table of text cells with a header in the first row. Empty columns are not shown."""

    rows: TableRows
    title: str = ""
    is_key_table: bool = False  # whether a page shows it next to the verdict
    is_page_only: bool = False  # whether a terminal omits it
    is_list: bool = False  # whether a terminal shows the second of two columns below the first
    links: Mapping[str, str] = field(default_factory=dict)  # linked page by the text of a cell in the first column


@dataclass(frozen=True)
class CodeBlock:
    """A block of preformatted lines, such as a shell command to copy."""

    text: str


StatementTableOrCode = SummaryStatement | SummaryTable | CodeBlock
SummaryBlockOrTextIterator = Iterator[StatementTableOrCode | str]
"""Blocks of a summary in their order. A string is a note; an empty string is omitted."""
SUMMARIES: Registry[Callable[[Mapping[str, Any]], SummaryBlockOrTextIterator]] = Registry("result format")
"""Generators of the summary of a result, by its format such as `yid-solve/1`."""


def summary_blocks(result: Mapping[str, Any]) -> list[StatementTableOrCode]:
    """Return the summary of a result without empty texts and tables that have only a header. Empty without summary."""
    form = str(result.get("format"))
    parts = SUMMARIES[form](result) if form in SUMMARIES else ()
    blocks = (SummaryStatement(part) if isinstance(part, str) else part for part in parts)
    return [own for own in blocks if (len(own.rows) > 1 if isinstance(own, SummaryTable) else own.text)]


def scale_and_unit_with_metres_as_mm(unit: str) -> tuple[float, str]:
    """Return factor and unit for the display of a quantity: metres become millimetres, other units stay."""
    return (1e3, "mm") if unit == "m" else (1.0, unit)


def shown_unit(unit: str) -> str:
    """Return a unit for a table cell: a dash for numbers without unit."""
    return "–" if unit == "1" else unit


def value_text_and_display_unit(value: float | None, unit: str) -> tuple[str, str]:
    """Return the value of an error as text (a dash for None), and the unit in which it is displayed."""
    factor, shown = scale_and_unit_with_metres_as_mm(unit)
    return ("–" if value is None else f"{factor * value:.3g}"), shown


def issue_descriptions(result: Mapping[str, Any], *, severe: bool) -> str:
    """Return the descriptions of the issues in a result that make its values unusable, or else of other errors."""
    shown = (own for own in result.get("issues") or () if (own["severity"] != "warning") == severe and is_error(own))
    return "; ".join(dict.fromkeys(ISSUE_CAUSE_DESCRIPTIONS[own["cause"]] for own in shown))


def is_error(issue: Mapping[str, Any]) -> bool:
    """Check whether an issue in a result exceeds its limit; if not, the fit has corrected it."""
    return bool(issue["evidence"] > 1)


def advised_options(issues: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """Return the options of the advice on issues by name of the setting. The first issue, the strongest, counts."""
    options = dict[str, str]()
    for part in (part for own in issues if own["setting"] for part in own["setting"].split("; ")):
        options.setdefault(part.partition(": ")[0], setting_option(part))
    return options


def advised_step(purpose: str, command: str, result: Mapping[str, Any], other_advice: bool = False) -> dict[str, str]:
    """Return a next step with the options that the issues of a result advise."""
    issues = result.get("issues") or ()
    options = advised_options(issues)
    effects = options.pop("model.effects", None)  # which would replace those of the configuration
    is_left = other_advice or bool(effects) or not all(own["setting"] for own in issues)
    words = " with the advised options" * bool(options) + ", after the advice above is followed" * is_left
    return {purpose + words: " ".join([command, *options.values()])}


def setting_option(setting: str) -> str:
    """Return a setting, given as a line of YAML, as an option of a command."""
    return f"--set {shlex.quote(setting.replace(': ', '=', 1))}"


def issue_summary_blocks(result: Mapping[str, Any], *, with_verdict: bool = True) -> SummaryBlockOrTextIterator:
    """Yield the issues in a result with numbers, advice and settings for each cause, and a table if there are many."""
    issues = result.get("issues", ())
    rows: TableRows = [("issue", "where", "is it an error?")]
    advice: list[StatementTableOrCode | str] = []
    kinds = grouped(((own["cause"], "" if own["setting"] else own["advice"]), own) for own in issues)
    for (cause, _), (first, *others) in kinds.items():
        where = abbreviated_names_text(list(dict.fromkeys(own["where"] for own in (first, *others))))
        rows.append((ISSUE_CAUSE_DESCRIPTIONS[cause], where, first["certainty"]))
        options = [*advised_options((first, *others)).values()]
        do = first["advice"] + (f" by {'these options' if len(options) > 1 else 'this option'}:" if options else ".")
        example = f" at {first['where']}," * any(own["what"] != first["what"] for own in others)
        text = f"{where} ({first['certainty']}):{example} {first['what']}. {do[0].upper()}{do[1:]}"
        advice += [text, CodeBlock("\n".join(options))]
    if (severe := issue_descriptions(result, severe=True)) and with_verdict:
        yield SummaryStatement(f"Do not use estimates yet, because {severe}.", "verdict")
    if (mild := issue_descriptions(result, severe=False)) and with_verdict:
        do = "Also" if result.get("verdict") == "unknown" else "Before you use values, also"
        yield f"{do} read the advice below on these issues: {mild}."
    yield SummaryTable(rows if len(issues) >= _MIN_TABLE_ISSUES else rows[:1], "Issues")
    yield from advice


def next_steps_table(result: Mapping[str, Any], steps: Mapping[str, str]) -> SummaryTable:
    """Return a table of command lines for the configuration of a result, from commands and options by purpose."""
    words = shlex.split(result.get("command", "yid-ocp solve CONFIG"))[2:3]
    config = shlex.join(word for word in words if not word.startswith("--"))
    rows: TableRows = [("purpose", "command")]
    for purpose, text in steps.items():
        command, _, options = text.partition(" ")
        rows.append((purpose, " ".join(filter(None, ("yid-ocp", command, config, options)))))
    return SummaryTable(rows, "Next steps", is_list=True)


def unused_efforts_sentence(result: Mapping[str, Any]) -> str:
    """Return a sentence on the use of recorded torques, if a result does not use them. Empty otherwise."""
    use = "Recorded torques are not used. For friction, set sensors.joints.effort.use: true and run `yid-ocp friction`."
    return use if result.get("unused_efforts") else ""


def copyable_estimates_blocks(result: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    """Yield the found values of a result to copy, as text, YAML, MJCF and LaTeX."""
    if use := result.get("to_use"):
        yield SummaryTable([("value (± is one standard deviation)",), *zip(use["values"])], "To use these numbers")
        ignored, lost = " and ".join(use["uncounted_errors"]), abbreviated_names_text(use.get("left_out", ()))
        yield f"The ± leaves out the error {ignored}." if ignored else ""
        yield f"Not listed, because they are not known well enough: {lost}." if lost else ""
        zero = abbreviated_names_text(use.get("near_zero", ()))
        yield f"Not listed, because they do not differ from zero by more than two ±: {zero}." if zero else ""
        mujoco = "MuJoCo (MJCF; only what changes joints, all with export)"
        kinds = {"a configuration of yid-ocp": use["yaml"], mujoco: use["mjcf"], "LaTeX": use["latex"]}
        model = "a model file" if "yid-ocp export" in use["export"] else "a run with this law"
        for words, lines in (kinds | {model: [use["export"]], "a citation": [use["cite"]]}).items():
            yield f"For {words}:" if lines else ""
            yield CodeBlock("\n".join(lines))


def misfit_summary_blocks(result: Mapping[str, Any], parameters: Mapping[str, Any]) -> SummaryBlockOrTextIterator:
    """Yield statements on a poor fit: start values to check, except of joints that hardly move, and rough values.

    A value is rough but meaningful if its standard deviation, misfit included, is at most 10 % of it.
    """
    fit = result["fit"]
    if fit["explains"]:
        return
    still = " ".join(i["setting"] or "" for i in result.get("issues") or () if i["cause"] == "weak_excitation")
    moving = {key: own for key, own in parameters.items() if f"parameters.{key}.free" not in still}
    lost = {key: own for key, own in moving.items() if own["verdict"] == "not_identifiable" and own.get("initial")}
    near = {n: e for n, e in lost.items() if math.isclose(e["value"], e["initial"], rel_tol=_MAX_CHANGE_FROM_START)}
    names = abbreviated_names_text([f"{name} ({own['initial']:.4g} {own['unit']})" for name, own in near.items()])
    shifts, notes = result.get("discretisation", {}).values(), result.get("refinement_notes", {})
    is_coarse = any(own.get(kind) is not None for own in shifts for kind in notes)  # not only an unknown shift
    said = uncertainty.goodness_of_fit_message(fit, with_advice=fit["data_trusted"] and not is_coarse)
    if is_coarse:
        said += " First make the model finer, as follows."
    elif not fit["data_trusted"]:
        said = "The model does not explain the recordings: chi2 per degree of freedom is "
        said += f"{fit['chi2_per_dof']:.3g}; noise alone gives 1. First follow the advice above."
    elif near:
        said += f" Also check size and unit of the start values of {names}: near them the recordings hardly depend on "
        said += "them, so the fit could not correct a wrong one."
    yield SummaryStatement(said, "conclusion")
    if fit["data_trusted"] and not is_coarse:
        stds = {name: own.get("std_relative", own.get("std")) for name, own in parameters.items()}
        values = {name: 1.0 if "std_relative" in own else abs(own["value"]) for name, own in parameters.items()}
        limit = uncertainty.MAX_IDENTIFIABLE_RELATIVE_STD
        free = {name: std for name, std in stds.items() if std is not None and not is_at_bound(parameters[name])}
        rough = abbreviated_names_text([name for name, std in free.items() if std <= limit * values[name]])
        said = f"The ± of {rough} takes the model's error as random. Until its cause is known, the values may be wrong."
        yield SummaryStatement(said if rough else "", "conclusion")


def discretisation_shift_sentences(result: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Return sentences on which finer discretisations of a fit shift estimates beyond noise, and their settings."""
    said, cures, settings = [], list[str](), result.get("finer_settings", {})
    units = {name: f" {own['unit']}".removesuffix(" 1") for name, own in result["parameters"].items()}
    kinds = {"links": "twice the links", "time_step": "half the time step"}
    kinds["encoder_noise"] = "additional noise of the joint angles (sensors.joints.position.std)"
    quiet, has_ended = list[str](), result.get("status") not in ("stalled", "iteration_limit", "stopped")
    found = result.get("discretisation", {}) if has_ended else {}
    for key, words in kinds.items():
        tried = {name: own for name, own in found.items() if own.get(key) is not None and own["std"] is not None}
        moved = {name: abs(own[key]) / own["std"] for name, own in tried.items() if abs(own[key]) > own["std"]}
        if moved:
            worst = max(moved, key=moved.__getitem__)
            change = f"most of all {worst} (by {tried[worst][key]:+.2g}{units.get(worst, '')}). The ± includes this."
            cures += settings.get(key, ())
            many = count_with_noun(len(moved), "estimate")
            said.append(f"{words.capitalize()} would change {many} by more than noise, {change}")
        elif tried:
            quiet.append(words)
    if quiet and result["fit"]["explains"]:
        said.append(f"Checked: {' or '.join(quiet)} would change no estimate by more than its ±.")
    if cures and result["fit"]["data_trusted"] and result["fit"]["explains"]:
        said.append(f"For a smaller ±, set {abbreviated_names_text(cures)}, and solve again.")
    return said, cures


def large_torque_offsets_sentence(result: Mapping[str, Any]) -> str:
    """Return a sentence on torque offsets that are larger than expected. Empty without such offsets."""
    offsets = result.get("torque_offsets", {}).values()
    large = dict.fromkeys(j for own in offsets for j, e in own.items() if abs(e["value"]) > 2 * e["prior_std"])
    said = f"The torque offset of {', '.join(large)} is over twice the expected size. The estimates take the offsets "
    return said + "into account. Check the calibration of the torque sensor." if large else ""


def torque_offset_table(result: Mapping[str, Any]) -> SummaryTable:
    """Return a table of a result's torque offsets, with a row for each joint. Only the HTML report shows it."""
    shown: Mapping[str, Mapping[str, Any]] = result.get("torque_offsets", {})
    rows: TableRows = [("joint", *shown, "expected size")]
    for joint in dict.fromkeys(joint for entry in shown.values() for joint in entry):
        own = [entry.get(joint) for entry in shown.values()]
        cells = ["" if known is None else f"{known['value']:.2f} ± {known['std']:.2f}" for known in own]
        priors = dict.fromkeys(f"± {known['prior_std']:.2g}" for known in own if known is not None)
        rows.append((joint, *cells, ", ".join(priors)))
    return SummaryTable(rows, "Estimated constant errors of the torques [N m]", is_page_only=True)


def is_at_bound(entry: Mapping[str, Any], sides: Sequence[str] = ("lower", "upper")) -> bool:
    """Check whether an estimate lies at one of its bounds, of those on `sides`."""
    bounds = [entry[side] for side in sides if entry.get(side) is not None]
    return any(math.isclose(entry["value"], bound, rel_tol=1e-9, abs_tol=1e-12) for bound in bounds)


def bound_range_text(entry: Mapping[str, Any], digits: int) -> str:
    """Format the range between the bounds of a parameter, such as "0 to 5", "≥ 0", "≤ 5" or "none"."""
    lower, upper = ("" if entry[key] is None else f"{entry[key]:.{digits}g}" for key in ("lower", "upper"))
    one_sided = f"≥ {lower}" if lower else f"≤ {upper}" if upper else "none"
    return f"{lower} to {upper}" if lower and upper else one_sided


def summary_terminal_lines(blocks: Sequence[StatementTableOrCode]) -> list[str]:
    """Format the blocks of a summary as lines of text, with aligned tables and wrapped sentences and notes."""
    result: list[str] = []
    for block in blocks:
        if isinstance(block, SummaryTable):
            above = [""] * bool(result and result[-1]) + [f"{block.title}:"] * bool(block.title)
            listed = (line for first, second in block.rows[1:] for line in (f"{first}:", f"  {second}"))
            lines = listed if block.is_list else aligned_table_lines(block.rows)
            result += [] if block.is_page_only else [*above, *lines, ""]
        elif isinstance(block, CodeBlock):
            result += [f"  {line}" for line in block.text.splitlines()]
        else:
            result += textwrap.wrap(block.text, _PROSE_WIDTH, break_on_hyphens=False)
    return result[:-1] if result and not result[-1] else result


def absent_parameters_sentence(free: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a sentence on estimates that ended at 0, the smallest possible value. Empty if there are none."""
    told = [n for n, e in free.items() if is_at_bound(e, ("lower",)) and e["verdict"] != "not_identifiable"]
    names = abbreviated_names_text([name for name in told if free[name]["lower"] == 0])
    do = "Fix it there (parameters.NAME.free: false) if it is absent, else run `yid-ocp diagnose`."
    return f"The recordings show nothing of what ended at 0, its smallest value: {names}. {do}" if names else ""


def recording_summary_lines(recording: Recording) -> list[str]:
    """Return lines of text that describe a recording: a table of its groups, and notes."""
    rows: TableRows = [("group", "samples", "mean rate [Hz]", "longest gap [s]", "length [s]", "channels", "names")]
    for group in recording.all_groups:
        rate, gap, span = mean_sample_rate(group.t), np.diff(group.t).max(initial=0.0), group.t[-1] - group.t[0]
        sampled = str(len(group.t)), f"{rate:.4g}" if math.isfinite(rate) else "", f"{gap:.3g}", f"{span:.4g}"
        names = abbreviated_names_text(group.names, math.inf)
        rows.append((group.name, *sampled, ", ".join(_channels_with_units(group)), names))
    missing = ((group.name, np.isnan(group.position).any(axis=2)) for group in recording.points)
    said = (f"{lost.sum()} of {lost.size} readings of {name} are missing" for name, lost in missing if lost.any())
    return [*aligned_table_lines(rows), *_note_lines([*recording.notes, *said])]


def _channels_with_units(group: JointGroup | PointGroup | SensorChannelGroup) -> list[str]:
    if isinstance(group, JointGroup):
        return [f"{name} [{JOINT_CHANNEL_UNITS[name]}]" for name in group.values_by_channel]
    if isinstance(group, PointGroup):
        return ["position [m]"]
    kinds = {kind.quantity: kind.unit for kind in channel_specs_for_group_name(group.name)}
    return [f"{name} [{kinds[name]}]" for name in group.values_by_quantity]


def importable_file_contents_lines(contents: FilePreview) -> list[str]:
    """Return lines of text that describe a file of another tool: a table of what `import` finds, and notes."""
    rows: TableRows = [("source", "type", "samples", "rate [Hz]", "imported as", "note")]
    for own in contents.sources:
        rate = f"{own.mean_rate:.4g}" if math.isfinite(own.mean_rate) else ""
        kind, _, of = own.imported_as.partition(" ")
        becomes = f"{kind}: {abbreviated_names_text(of.split(', '), math.inf)}" if of else kind or "not imported"
        rows.append((own.name, own.kind, str(own.n_samples), rate, becomes, own.note))
    # rows that only differ in a number
    for group in grouped((tuple(re.sub(r"(?<=\D)\d+", "#", cell) for cell in row), row) for row in rows[1:]).values():
        first, *others = group
        names = [abbreviated_names_text(list(dict.fromkeys(cells)), math.inf) for cells in zip(*group, strict=True)]
        if others and not any(", " in name and name != cell for name, cell in zip(names, first, strict=True)):
            rows = [names if row is first else row for row in rows if row not in others]
    return [*aligned_table_lines(rows), *_note_lines(contents.notes)]


def _note_lines(notes: Sequence[str]) -> list[str]:
    return ["", *(f"note: {note}" for note in notes)] if notes else []


def aligned_table_lines(rows: TableRows) -> list[str]:
    """Return a table as lines with aligned columns. The first row is the header. Empty columns are omitted."""
    columns = [column for column in zip(*rows, strict=True) if any(column[1:])]
    widths = [max(map(len, column)) for column in columns]
    lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in zip(*columns, strict=True)]
    return [lines[0], "  ".join("-" * width for width in widths), *lines[1:]]
