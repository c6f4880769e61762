"""The report section of a diagnosis: gap, events, locations, candidates, law and predictions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np

from yid_ocp.arrays import Array
from yid_ocp.display import effect_entry_label, grouped
from yid_ocp.effects.friction import SIGN_SMOOTHING_SPEED
from yid_ocp.effects.law import TORQUE_LAW_QUANTITY_UNITS, TorqueLawTable
from yid_ocp.inference.null_test import channels_with_residual_indices
from yid_ocp.inference.smoother import SmoothedUnknownsResult, smoothed_unknown_units, smoothed_unknown_z_scores
from yid_ocp.inference.uncertainty import value_and_uncertainty_text
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.problem.predictions import channel_predictions
from yid_ocp.report import figures
from yid_ocp.report.figures import TimeHeatMapRow, TimePlotData
from yid_ocp.report.sections import ReportData, draw_figure_per_unit, register_report_section
from yid_ocp.report.terminal import scale_and_unit_with_metres_as_mm

if TYPE_CHECKING:
    from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult

_MAX_CANDIDATES = 15  # largest number of shown candidates; result.json has all
_MAX_MAPS = 3  # largest number of recordings with a heat map; trajectories.h5 has all
_MAX_CHANNELS = 3  # largest number of held-out channels that are drawn
_NOMINAL_LABEL, _EXTENDED_LABEL = "nominal model", "with the effects"
_MODEL_COLORS = {_NOMINAL_LABEL: figures.BEFORE_COLOR, _EXTENDED_LABEL: figures.AFTER_COLOR}
_EVENT_COLORS = {"event": figures.AFTER_COLOR}
_EVENT_COLORS |= {f"{side} limit of the model error": figures.MEASURED_COLOR for side in ("upper", "lower")}
_TitledFigures = list[tuple[str, Any]]
_Chapter = tuple[str, Sequence[str], _TitledFigures]
"""Title, sentences (empty ones are not shown), and figures with their titles."""


@register_report_section("diagnosis", 5, "The gap and its causes")
def _diagnosis(findings: ReportData) -> Mapping[str, Any] | None:
    result = findings.result
    finding: DiagnosisResult | None = findings.section_data.get("finding")
    if result.get("format") != "yid-diagnosis/2" or finding is None:
        return None
    chapters = {
        "gap": _gap(finding),
        "events": _events(finding),
        "where": _where(finding),
        "which": _which(finding, result),
        "law": _law(finding),
        "alike": _alike(finding, result),
        "curves": _curves(finding, findings.section_data["predictions"]),
        "absorbed": _absorbed(finding),
    }
    return {"chapters": {name: chapter for name, chapter in chapters.items() if chapter is not None}}


def _gap(finding: DiagnosisResult) -> _Chapter:
    before, after = finding.nominal_model.held_out_loss.channel_rmse, finding.final_model.held_out_loss.channel_rmse
    changed = bool(finding.accepted_effects)
    floor, rows = finding.noise_floor, []
    for channel, (error, unit) in before.items():
        factor, shown = scale_and_unit_with_metres_as_mm(unit)
        extended = after[channel][0] if changed and channel in after else None
        errors = {_NOMINAL_LABEL: error, _EXTENDED_LABEL: extended, "sensor noise": floor.get(channel)}
        rows.append((channel, shown, {name: (factor * e, None) for name, e in errors.items() if e is not None}))
    sentences = ["The figure shows rms errors on held-out recordings, and the part of them from sensor noise."]
    return "How large the gap is", sentences, _figures_by_model(rows, "held-out error (rms)", _NOMINAL_LABEL)


def _figures_by_model(
    rows: Sequence[tuple[str, str, Mapping[str, tuple[float, float | None]]]], axis: str, nominal_label: str
) -> _TitledFigures:
    colors = {nominal_label: figures.BEFORE_COLOR, _EXTENDED_LABEL: figures.AFTER_COLOR}
    colors["sensor noise"] = figures.MEASURED_COLOR
    draw = figures.parameter_values_by_source_figure
    return draw_figure_per_unit(rows, lambda own, unit: draw(own, f"{axis} [{unit}]".removesuffix(" []"), colors))


def _where(finding: DiagnosisResult) -> _Chapter | None:
    from yid_ocp.diagnosis.sentences import MIN_GAP_SHARE

    smoothed = finding.smoother_result
    if smoothed is None:
        return None
    noticed = ", ".join(p.location for p in finding.gap_locations if p.is_observable and p.gap_share < MIN_GAP_SHARE)
    silent = ", ".join(place.location for place in finding.gap_locations if not place.is_observable)
    evidence = smoothed.log_evidence
    sentences = [
        f"Nothing is wrong at {noticed}: a gap would have been detected there." if noticed else "",
        f"These motions and sensors cannot show whether there is a gap at {silent}." if silent else "",
        "Method: unknown forces and offsets of grasps (mechanics) and biases of measured points (sensors), which may "
        "change over time, are added, as few as explain the residual. They explain "
        f"{100 * smoothed.explainable_gap_fraction:.0f} % of the gap on fitted recordings. The log evidence rises by "
        f"{evidence['plant']:.0f} with mechanics, {evidence['sensor']:.0f} with sensors, {evidence['both']:.0f} with "
        "both. An alternative that is lower by 5 has odds of 1 to 150.",
    ]
    maps = []
    for i, trace in enumerate(smoothed.smoothed_unknowns[:_MAX_MAPS]):
        kept = [k for k, source in enumerate(trace.unknown_groups) if smoothed.group_variance[source] > 0]
        if not kept:
            break
        figure, sentence = _time_map(finding, smoothed, i, kept)
        maps.append((f"Recording {trace.recording}, {_NOMINAL_LABEL}", figure))
        sentences += [sentence] if i == 0 else []
    drawn = "Each row of a map has one of these unknowns over time. Red is positive, blue is negative."
    sentences.append(drawn if maps else "None of these unknowns explains more than chance, so there is no map.")
    if len(smoothed.smoothed_unknowns) > _MAX_MAPS:
        sentences.append(f"The file trajectories.h5 has values for all {len(smoothed.smoothed_unknowns)} recordings.")
    return "Where and when the gap arises", sentences, maps


def _time_map(finding: DiagnosisResult, smoothed: SmoothedUnknownsResult, i: int, kept: list[int]) -> tuple[Any, str]:
    """Return the heat map of the unknowns `kept` over recording i, and a sentence on the most significant value."""
    trace = smoothed.smoothed_unknowns[i]
    groups, names, edges = trace.unknown_groups, trace.unknown_names, trace.interval_edges
    kept = sorted(kept, key=lambda k: (-smoothed.log_evidence_drop[groups[k]], groups[k].location, groups[k].kind))
    values = smoothed_unknown_z_scores(smoothed, trace)
    units = smoothed_unknown_units(finding.nominal_model.problem.system, trace)
    mean, std = trace.posterior_mean * trace.reference_std, trace.posterior_std * trace.reference_std
    axis = "value in its standard deviations"

    def said(j: int, k: int) -> str:
        factor, shown = scale_and_unit_with_metres_as_mm(units[k])
        return f"{value_and_uncertainty_text(factor * mean[j, k], factor * std[j, k], least_digits=3)} {shown}"

    if np.any(np.isfinite(values)):
        j, k = divmod(int(np.nanargmax(np.abs(values))), values.shape[1])
        span = f"{names[k]} from {edges[j]:.2f} to {edges[j + 1]:.2f} s of {trace.recording}, which is {said(j, k)}"
        sentence = f"Grey cells are not determined. The most significant value is that of {span}."
    else:
        prior = np.sqrt([smoothed.group_variance[source] for source in groups])
        values = trace.posterior_mean / np.where(prior > 0, prior, np.nan)
        axis = "value in standard deviations of its prior"
        sentence = "The recordings determine no single value. Colours show values in standard deviations of the prior. "
        sentence += "The map is only a hint."
    rows = []
    for k in kept:
        spans = [f"{edges[j]:.2f} to {edges[j + 1]:.2f} s" for j in range(len(mean))]
        texts = [f"{names[k]}, {span}: {said(j, k)}" for j, span in enumerate(spans)]
        kind = "torque" if groups[k].kind == "force" and units[k] == "N m" else groups[k].kind
        about = f"{groups[k].location} {kind} [{scale_and_unit_with_metres_as_mm(units[k])[1]}]"
        rows.append(TimeHeatMapRow(names[k], about, values[:, k], texts))
    return figures.time_heat_map_figure(edges, rows, axis), sentence


def _events(finding: DiagnosisResult) -> _Chapter | None:
    events = finding.events
    if not events.force_estimates:
        return None
    drawn = "Points show the force or torque that the model lacks. Points of a correct model lie between grey lines. "
    drawn += "Shaded windows are events, with their shape as a line. Where possible, the results below leave them out."
    by_recording: dict[str, list[TimePlotData]] = {}
    for force in events.force_estimates:
        found = [event for event in events.events_of_recording(force.recording) if event.channel == force.coordinate]
        pulses = [(e.detected_pulse, e.start_time, e.end_time) for e in found if e.detected_pulse is not None]
        shape = sum((pulse.filtered_force_at(force.t) for pulse, *_ in pulses), np.zeros(len(force.t)))
        courses = (shape, force.assumed_model_error, -force.assumed_model_error)
        lines = {name: (force.t, values) for name, values in zip(_EVENT_COLORS, courses, strict=True)}
        title, spans = f"{force.coordinate} [{force.unit}]", [(begin, end) for _, begin, end in pulses]
        plot = TimePlotData(title, lines, force.t, force.most_likely_force_signal, None, spans, dots_name="estimated")
        by_recording.setdefault(force.recording, []).append(plot)
    return "Brief disturbances", [drawn], _recording_figures(by_recording, "", figures.BEFORE_COLOR, _EVENT_COLORS)


def _recording_figures(
    plots: Mapping[str, Sequence[TimePlotData]], words: str, dots: str, lines: Mapping[str, str]
) -> _TitledFigures:
    return [(f"Recording {name}{words}", figures.time_plots_figure(own, dots, lines)) for name, own in plots.items()]


def _which(finding: DiagnosisResult, result: Mapping[str, Any]) -> _Chapter | None:
    # predicted decrease of r'r in per cent of its excess over noise, or absolute if there is little excess
    fit = finding.nominal_model
    rows = np.concatenate([series.residual_indices for series in channels_with_residual_indices(fit.problem)])
    excess = float(np.sum(fit.evaluation.residual[rows] ** 2)) - (len(rows) - len(fit.values))
    percent = finding.verdict != "no_gap" and excess > 0
    factor = 100 / excess if percent else 1.0
    promised = {own.effect.label: factor * own.predicted_chi2_decrease for own in finding.screening.candidate_scores}
    entries: dict[str, tuple[tuple[float, float, float] | None, float]] = {}
    for entry in result["which"][:_MAX_CANDIDATES]:
        name, closed = effect_entry_label(entry), None
        if entry["closure"] is not None and None not in entry["closure_ci"]:
            low, high = entry["closure_ci"]
            closed = (100 * entry["closure"], 100 * low, 100 * high)
        entries[name] = (closed, promised.get(name, 0.0))
    if not entries:
        return None
    absolute = "as a decrease of chi²; chance alone exceeds 7 in 1 % of cases"
    unit = "as a fraction of the error beyond noise" if percent else absolute
    promise = f"the decrease of the misfit on fitted motions that a linear model promises for each effect, {unit}."
    refitted = ", ".join(own.effects[0].label for own in finding.single_effect_models)
    why = ", because they show no error beyond noise" if fit.held_out_loss.excess_chi2_per_sample <= 0 else ""
    unmeasured = f"Refitted: {refitted}. Held-out motions cannot show how much of the gap these effects close{why}."
    sentences = [f"Bars show {promise}", unmeasured if refitted else "No effect promises enough for a refit."]
    if any(closed is not None for closed, _ in entries.values()):
        sentences = [
            "The left part shows how much of the held-out gap each effect alone closes, refitted with the parameters, "
            "with 95 % intervals. At 100 % no gap is left. Below 0 % predictions get worse.",
            f"The right part shows {promise}",
        ]
    # room for one word on a narrow screen
    axes = ("closed [%]", "promised [%]" if percent else "promised")
    title = "What each effect could explain" if finding.verdict == "no_gap" else "Which effect causes the gap"
    return title, sentences, [("", figures.gap_closure_and_screening_figure(entries, *axes))]


def _law(finding: DiagnosisResult) -> _Chapter | None:
    law = finding.law
    if law is None:
        return None
    shown: _TitledFigures = []
    for table in law.tables:
        low, high = table.knots[0], table.knots[-1]
        at = np.linspace(low, high, 200)
        torque, std = table.interpolated_torque(at), np.interp(at, table.knots, table.torque_std)
        nearest = _library_curves(table, at)
        words = (f"{table.quantity} [{TORQUE_LAW_QUANTITY_UNITS[table.quantity]}]", "torque [N m]")
        visited = law.visited_range[table.quantity]
        shown.append((law.location, figures.estimated_curve_figure((at, torque, std), nearest, visited, *words)))
    rival, is_simple = law.runner_up, bool({"angle", "speed"} & {*law.visited_range})
    use = f"{{kind: law, location: {law.location}, depends_on: {law.depends_on}, law_csv: law.csv}}"
    sentences = [
        "The band is two standard deviations. Dotted lines bound the recorded range. Beyond it the law is constant.",
        "The dashed line is the nearest spring or friction law." * is_simple,
        f"The next best law, of {rival[1]} at {rival[0]}, would remove {100 * rival[2]:.3g} %." if rival else "",
        f"To use the law (file law.csv) in a model, add this under model.effects: {use}.",
    ]
    return "A torque law for the gap", sentences, shown


def _library_curves(table: TorqueLawTable, at: Array) -> dict[str, Array]:
    """Return the curve of the library's law that fits a table best, by weighted least squares of its amplitudes."""
    shapes: dict[str, Callable[[Array], Sequence[Array]]] = {}
    if table.quantity == "speed":
        shapes = {"viscous": lambda v: [v], "viscous and Coulomb": lambda v: [v, np.tanh(v / SIGN_SMOOTHING_SPEED)]}
    elif table.quantity == "angle":
        shapes = {"spring": lambda q: [np.ones_like(q), q], "cubic spring": lambda q: [np.ones_like(q), q, q**3]}
    weight = 1 / np.where(table.torque_std > 0, table.torque_std, np.inf)
    best: tuple[float, dict[str, Array]] = (np.inf, {})
    for name, shape in shapes.items():
        columns = np.column_stack(shape(table.knots)) * weight[:, None]
        amplitudes = np.linalg.lstsq(columns, table.torque * weight, rcond=None)[0]
        square = float(np.sum((columns @ amplitudes - table.torque * weight) ** 2))
        error = square / max(len(weight) - len(amplitudes), 1)
        if error < best[0]:
            best = error, {f"nearest of the library: {name}": np.column_stack(shape(at)) @ amplitudes}
    return best[1]


def _alike(finding: DiagnosisResult, result: Mapping[str, Any]) -> _Chapter | None:
    labels = finding.screening.labels
    names = [effect_entry_label(entry) for entry in result["which"][:_MAX_CANDIDATES]]
    names = [name for name in names if name in labels]
    if len(names) < 2:
        return None
    at = [labels.index(name) for name in names]
    values = finding.screening.overlap_fractions[np.ix_(at, at)]
    pairs = ((min(values[i, j], values[j, i]), names[i], names[j]) for i, j in combinations(range(len(names)), 2))
    said = [(v, f"{a} and {b} ({100 * v:.0f} %)") for v, a, b in sorted(pairs, reverse=True)]
    close = [text for v, text in said if v >= finding.thresholds.signature_overlap]
    listed = ", ".join(close[:5]) + (f" and {len(close) - 5} more" if len(close) > 5 else "")
    none = f"No two signatures are similar in both directions; by the smaller percentage the closest are {said[0][1]}."
    sentences = [
        "A cell has the percentage of the row's signature (its influence on all predictions) that the column's effect "
        "and changed parameters can reproduce. At 100 %, these recordings cannot distinguish the two effects.",
        f"These pairs are similar in both directions, with the smaller percentage: {listed}." if close else none,
    ]
    return "Which effects are confusable", sentences, [("", figures.confusability_matrix_figure(names, values))]


def _curves(
    finding: DiagnosisResult, predicted: Sequence[tuple[Episode, EpisodePrediction, EpisodePrediction]]
) -> _Chapter | None:
    changed = bool(finding.accepted_effects)
    labels = (_NOMINAL_LABEL, _EXTENDED_LABEL) if changed else (_NOMINAL_LABEL,)
    found: list[tuple[float, str, tuple[TimePlotData, TimePlotData]]] = []
    for episode, *outcomes in predicted:
        for parts in zip(*(channel_predictions(episode, outcome) for outcome in outcomes), strict=True):
            own = parts[0]
            for i, axis in enumerate(("x", "y", "z") if own.measured.shape[1] == 3 else ("",)):
                y, std = own.measured[:, i], own.noise_std[:, i]
                lines = {label: part.predicted[:, i] for label, part in zip(labels, parts, strict=False)}
                seen = np.isfinite(y) & np.isfinite(std)
                if seen.any():
                    squares = [float(np.sum(((line - y)[seen] / std[seen]) ** 2)) for line in lines.values()]
                    name = f"{own.channel}, {axis}" if axis else own.channel
                    pair = figures.channel_prediction_and_residual_plot_data(name, own.unit, own.t, y, std, lines)
                    found.append((squares[0] - (squares[1] if changed else 0.0), episode.name, pair))
    if not found:
        return None
    # the same joint in every recording would repeat the information
    best: dict[str, tuple[str, tuple[TimePlotData, TimePlotData]]] = {}
    for _, recording, pair in sorted(found, key=lambda entry: -entry[0]):
        best.setdefault(pair[0].axis_title, (recording, pair))
    by_recording = grouped((recording, plot) for recording, pair in [*best.values()][:_MAX_CHANNELS] for plot in pair)
    shown = _recording_figures(by_recording, ", held out", figures.MEASURED_COLOR, _MODEL_COLORS)
    what, count = "change most with the effects" if changed else "the nominal model predicts worst", len(best)
    drawn = f"Of {count} held-out coordinates or joints, the figures show the {min(count, _MAX_CHANNELS)} that {what}. "
    drawn += "Below each is the error, with two standard deviations of the sensor noise shaded. The error of a correct "
    drawn += "model is inside for 95 % of the time, unless errors of the torques also move the arm."
    return "Measured and predicted", [drawn], shown


def _absorbed(finding: DiagnosisResult) -> _Chapter | None:
    if not finding.accepted_effects or not finding.nominal_parameters_before_and_after:
        return None
    rows = []
    for name, entry in finding.nominal_parameters_before_and_after.items():
        fitted_without = entry["before"], finding.nominal_model.std.get(name, 0.0)
        values = {"fitted without the effects": fitted_without, _EXTENDED_LABEL: (entry["after"], entry["std"])}
        rows.append((name, entry["unit"], values))
    shown = _figures_by_model(rows, "value", "fitted without the effects")
    drawn = "A fit without the effects changes free parameters to imitate them. Bars are two standard deviations."
    return "Parameters that imitated the effects", [drawn], shown
