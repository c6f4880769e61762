"""Section: gap, locations, candidates and predictions of a diagnosis, as sentences and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from yid_ocp.diagnosis import DiagnosisResult
from yid_ocp.diagnosis.diagnosis_messages import overspeed_messages
from yid_ocp.diagnosis.localise import informed_z_scores, unknown_units
from yid_ocp.inference.null_test import residual_channels
from yid_ocp.inference.smoother import SmootherResult
from yid_ocp.problem.episodes import Episode, EpisodePrediction
from yid_ocp.report import categorical_charts, figures
from yid_ocp.report.categorical_charts import BeforeAfter, RankedCandidate, TimeMapRow
from yid_ocp.report.figures import TimePlot
from yid_ocp.report.sections.base import ReportData, register_section
from yid_ocp.report.tables import display_scale_and_unit, format_error_and_unit

Array = NDArray[np.float64]

_MAX_CANDIDATES = 15  # candidates; the rest is in result.json
_MAX_MAPS = 3  # recordings of which a map is drawn; trajectories.h5 has them all
_MAX_CHANNELS = 3  # held-out channels
_NOMINAL_LABEL, _EXTENDED_LABEL = "nominal model", "with the effects"
_MODEL_COLORS = {_NOMINAL_LABEL: figures.BEFORE_COLOR, _EXTENDED_LABEL: figures.AFTER_COLOR}
_HeldOutPrediction = tuple[Episode, EpisodePrediction, EpisodePrediction]


@dataclass(frozen=True)
class _Chapter:
    """A titled part of the section: sentences and figures."""

    title: str
    sentences: Sequence[str]
    pictures: Sequence[tuple[str, str]] = ()


@register_section("diagnosis", 5, "The gap and what makes it")
def diagnosis_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: chapters on gap, events, locations, candidates, curves and changed parameters."""
    result = findings.result
    if result.get("format") != "yid-diagnosis/2":
        return None
    finding: DiagnosisResult | None = findings.section_data.get("finding")
    chapters: dict[str, _Chapter | None] = {}
    if finding is not None:
        chapters = {
            "gap": _gap(finding),
            "events": _events(finding),
            "where": _where(finding),
            "which": _which(finding, result),
            "alike": _alike(finding, result),
            "curves": _curves(finding, findings.section_data["predictions"]),
            "absorbed": _absorbed(finding),
        }
    shown = [chapter for chapter in chapters.items() if chapter[1] is not None]
    return {"chapters": dict(shown)} if shown else None


# -- the gap ----------------------------------------------------------------------------------------------------------


def _gap(finding: DiagnosisResult) -> _Chapter:
    before, after = finding.nominal_model.held_out_loss.channel_rmse, finding.final_model.held_out_loss.channel_rmse
    floor = _floor(finding)
    by_unit: dict[str, dict[str, BeforeAfter]] = {}
    for channel, (error, unit) in before.items():
        later = after[channel][0] if finding.accepted_effects and channel in after else None
        by_unit.setdefault(unit, {})[channel] = BeforeAfter(error, later, reference=floor.get(channel))
    pictures = []
    for unit, rows in by_unit.items():
        factor, shown = display_scale_and_unit(unit)
        scaled = {
            name: BeforeAfter(
                factor * row.before,
                None if row.after is None else factor * row.after,
                reference=None if row.reference is None else factor * row.reference,
            )
            for name, row in rows.items()
        }
        words = (_NOMINAL_LABEL, _EXTENDED_LABEL, "noise alone")
        pictures.append(
            (
                "",
                figures.figure_html(
                    categorical_charts.before_after_figure(scaled, f"held-out error (rms) [{shown}]", words)
                ),
            )
        )
    first, last = finding.nominal_held_out_test.chi2_per_dof, finding.remaining_test.chi2_per_dof
    sentences = [
        "Errors on recordings that no fit has touched, channel by channel; the tick is what noise alone gives."
    ]
    if finding.accepted_effects:
        names = " and ".join(effect.label for effect in finding.accepted_effects)
        falls = {c: 1 - after[c][0] / e for c, (e, _) in before.items() if c in after and e > 0}
        sentences.append(
            f"With {names}, chi² per degree of freedom goes from {first:.3g} to {last:.3g} (one is noise alone)."
        )
        if falls:
            most, least = max(falls, key=lambda c: falls[c]), min(falls, key=lambda c: falls[c])
            said = f"The error of {most} changes most, from {_amount(*before[most])} to {_amount(*after[most])}"
            worse = f"; {least} gets worse by {-100 * falls[least]:.0f} %" if falls[least] < -0.02 else ""
            sentences.append(f"{said}{worse}.")
    else:
        sentences.append(
            f"No effect is named, so no error is shown after it; chi² per degree of freedom is {first:.3g} (one is "
            "noise alone)."
        )
    return _Chapter("How large the gap is", sentences, pictures)


def _floor(finding: DiagnosisResult) -> dict[str, float]:
    """Error of every channel that noise alone gives; for points that of a distance."""
    width = {
        channel: samples.sensor.outputs_per_channel
        for episode in finding.nominal_model.problem.held_out
        for samples in episode.measurements
        for channel in samples.sensor.channel_names
    }
    return {entry.channel: math.sqrt(width.get(entry.channel, 1)) * entry.noise_std for entry in finding.noise_floor}


def _amount(value: float, unit: str) -> str:
    return " ".join(format_error_and_unit(value, unit))


# -- where ------------------------------------------------------------------------------------------------------------


def _where(finding: DiagnosisResult) -> _Chapter | None:
    smoothed = finding.smoother_result
    if smoothed is None:
        return None
    noticed = [place.location for place in finding.gap_locations if place.is_observable]
    silent = [place.location for place in finding.gap_locations if not place.is_observable]
    sentences = [
        "Every coordinate was given an unknown force, every grasp an unknown offset and every measured point an "
        "unknown bias, free to change in time; the fewest groups of them that explain the residual were kept.",
        _side(smoothed),
        f"A gap would have shown at {', '.join(noticed)}." if noticed else "",
        f"It would not have shown at {', '.join(silent)}: these motions and sensors cannot tell." if silent else "",
    ]
    left = [f"{p.location} ({100 * p.gap_share:.0f} %)" for p in finding.remaining_gap_locations if p.gap_share > 0.1]
    if finding.accepted_effects and left:
        sentences.append(f"What the effects leave lies in {', '.join(left)}.")
    pictures = []
    for i, trace in enumerate(smoothed.smoothed_unknowns[:_MAX_MAPS]):
        kept = [k for k, source in enumerate(trace.unknown_groups) if smoothed.group_variance[source] > 0]
        kept.sort(
            key=lambda k: (
                -smoothed.log_evidence_drop[trace.unknown_groups[k]],
                trace.unknown_groups[k].location,
                trace.unknown_groups[k].kind,
            )
        )
        if not kept:
            break
        _, _, values = informed_z_scores(smoothed, i, finding.thresholds.informed_fraction)
        shown = unknown_units(finding.nominal_model.problem.system, trace)
        axis = "value in its standard deviations"
        blank = not np.any(np.isfinite(values))
        if blank:
            prior = np.sqrt([smoothed.group_variance[source] for source in trace.unknown_groups])
            values = trace.posterior_mean / np.where(prior > 0, prior, np.nan)
            axis = "value in standard deviations expected beforehand"
        rows = []
        for k in kept:
            size, unit = trace.reference_std[k], shown[k]
            texts = [
                f"{trace.unknown_names[k]}, {trace.interval_edges[j]:.2f} to {trace.interval_edges[j + 1]:.2f} s: "
                f"{trace.posterior_mean[j, k] * size:.3g} ± {trace.posterior_std[j, k] * size:.2g} {unit}"
                for j in range(len(trace.posterior_mean))
            ]
            source = trace.unknown_groups[k]
            group = f"{source.location} {source.kind} [{unit}]"
            rows.append(TimeMapRow(trace.unknown_names[k], group, values[:, k], texts))
        pictures.append(
            (
                f"Recording {trace.recording}",
                figures.figure_html(categorical_charts.time_map_figure(trace.interval_edges, rows, axis)),
            )
        )
        if i == 0:
            sentences.append(_surest(smoothed, shown, None if blank else values))
    if pictures:
        sentences.append("Red is a force, offset or bias in the positive direction, blue in the negative one.")
    else:
        sentences.append("No group of unknowns explains the residual better than chance, so there is no map.")
    if len(smoothed.smoothed_unknowns) > _MAX_MAPS:
        sentences.append(f"{len(smoothed.smoothed_unknowns) - _MAX_MAPS} more recordings are in trajectories.h5.")
    return _Chapter("Where it is, and when", [text for text in sentences if text], pictures)


def _side(smoothed: SmootherResult) -> str:
    """Plant or sensor, with what speaks for it."""
    verdicts = {
        "plant": "the mechanics, not what sensors read",
        "sensor": "what sensors read, not the mechanics",
        "both": "both the mechanics and what sensors read",
        "either": "the mechanics or what the effort sensors read, which efforts alone do not tell apart",
        "none": "neither the mechanics nor the sensors' biases, as far as these unknowns can tell",
    }
    evidence = smoothed.log_evidence
    return (
        f"By evidence the gap lies in {verdicts[smoothed.gap_origin]}: the log evidence rises by "
        f"{evidence['plant']:.4g} with unknown forces and offsets alone, by {evidence['sensor']:.4g} with biases "
        f"alone, by {evidence['both']:.4g} with both (5 is odds of 150 to 1). They explain "
        f"{100 * smoothed.explainable_fraction:.0f} % of the gap where it was fitted."
    )


def _surest(smoothed: SmootherResult, shown: Sequence[str], ratio: Array | None) -> str:
    """The value farthest from zero in its standard deviations, `ratio` (J, nd); None where the data inform none."""
    trace = smoothed.smoothed_unknowns[0]
    if ratio is None:
        return (
            "Nowhere do the data say more than half of what can be said of a single value, so that values are shown in "
            "units of the standard deviation expected beforehand: take the picture for a hint only."
        )
    j, k = divmod(int(np.nanargmax(np.abs(ratio))), ratio.shape[1])
    value, std = (array[j, k] * trace.reference_std[k] for array in (trace.posterior_mean, trace.posterior_std))
    return (
        f"Grey is where the data do not say; the surest value is that of {trace.unknown_names[k]} between "
        f"{trace.interval_edges[j]:.2f} and {trace.interval_edges[j + 1]:.2f} s, {value:.3g} ± {std:.2g} {shown[k]}."
    )


# -- events -----------------------------------------------------------------------------------------------------------


def _events(finding: DiagnosisResult) -> _Chapter | None:
    events = finding.events
    if not events:
        return None
    sentences = [
        "The force beside what the model and the recording have, point by point. Between the grey lines is what a good "
        "model may be wrong by; windows of events are shaded, and the line is their shape. They are taken out of what "
        "is judged below, as far as that can be done."
        if events.force_series
        else "",
        *overspeed_messages(events),
    ]
    pictures = []
    for name in dict.fromkeys(force.recording for force in events.force_series):
        curves = []
        for force in (f for f in events.force_series if f.recording == name):
            own = [e for e in events.for_recording(name) if e.channel == force.channel and e.detected_pulse is not None]
            shape = sum(
                (e.detected_pulse.evaluate_at(force.t) for e in own if e.detected_pulse is not None),
                np.zeros(len(force.t)),
            )
            lines = {
                "event": (force.t, shape),
                "allowed": (force.t, force.allowed_model_error),
                "allowed, other side": (force.t, -force.allowed_model_error),
            }
            spans = [(event.start_time, event.end_time) for event in own]
            curves.append(
                TimePlot(f"{force.channel} [{force.unit}]", force.t, force.force, lines, marked_intervals=spans)
            )
        colors = {
            "event": figures.AFTER_COLOR,
            "allowed": figures.MEASURED_COLOR,
            "allowed, other side": figures.MEASURED_COLOR,
        }
        pictures.append(
            (f"Recording {name}", figures.figure_html(figures.time_plots_figure(curves, figures.BEFORE_COLOR, colors)))
        )
    return _Chapter("What happened beside it", [text for text in sentences if text], pictures)


# -- which ------------------------------------------------------------------------------------------------------------


def _which(finding: DiagnosisResult, result: Mapping[str, Any]) -> _Chapter | None:
    promised, percent = _promised(finding)
    entries = []
    for entry in result["which"][:_MAX_CANDIDATES]:
        name = f"{entry['kind']}@{entry['location']}"
        closed = None
        if entry["closure"] is not None and None not in entry["closure_ci"]:
            closed = (100 * entry["closure"], 100 * entry["closure_ci"][0], 100 * entry["closure_ci"][1])
        entries.append(RankedCandidate(name, closed, promised.get(name, 0.0)))
    if not entries:
        return None
    done = sorted(
        (e for e in entries if e.closure_interval_percent is not None),
        key=lambda e: -(e.closure_interval_percent or (0.0,))[0],
    )
    unit = "as a part of the excess over noise" if percent else "as a fall of the sum of squares; 7 is chance at 1 %"
    promise = f"hat each promises to first order where the model was fitted, {unit}."
    if done:
        said = [
            "{} {:.3g} % ({:.3g} to {:.3g} %)".format(e.name, *e.closure_interval_percent)
            for e in done[:3]
            if e.closure_interval_percent
        ]
        sentences = [
            "Left: refitted together with the stiffnesses, each alone, and judged on held-out motions, with the 95 % "
            f"interval; 100 % closes the gap, less than zero predicts worse. Closed by {', '.join(said)}.",
            f"Right: w{promise}",
        ]
    else:
        sentences = [f"W{promise}", "No candidate promised enough to be refitted."]
    # beside each other on a phone there is room for a word
    picture = figures.figure_html(
        categorical_charts.candidate_ranking_figure(
            entries, "closed [%]", "promised [%]" if percent else "promised [1]"
        )
    )
    title = "What each effect could explain" if finding.verdict == "no_gap" else "Which effect makes it"
    return _Chapter(title, sentences, [("", picture)])


def _promised(finding: DiagnosisResult) -> tuple[dict[str, float], bool]:
    """Promised decrease of r'r: in per cent of its excess over noise, or as it is where there is hardly an excess."""
    fit = finding.nominal_model
    rows = np.concatenate([series.residual_indices for series in residual_channels(fit.problem)])
    excess = float(np.sum(fit.evaluation.residual[rows] ** 2)) - (len(rows) - len(fit.values))
    percent = finding.verdict != "no_gap" and excess > 0
    factor = 100 / excess if percent else 1.0
    return {score.effect.label: factor * score.predicted_chi2_decrease for score in finding.candidate_scores}, percent


def _alike(finding: DiagnosisResult, result: Mapping[str, Any]) -> _Chapter | None:
    labels = finding.confusability.labels
    names = [f"{entry['kind']}@{entry['location']}" for entry in result["which"][:_MAX_CANDIDATES]]
    names = [name for name in names if name in labels]
    if len(names) < 2:
        return None
    at = [labels.index(name) for name in names]
    values = finding.confusability.overlap_fractions[np.ix_(at, at)]
    pairs = [
        (min(values[i, j], values[j, i]), names[i], names[j])
        for i in range(len(names))
        for j in range(i + 1, len(names))
    ]
    close = [
        f"{a} and {b} ({100 * v:.0f} %)"
        for v, a, b in sorted(pairs, reverse=True)
        if v >= finding.thresholds.signature_overlap
    ]
    listed = f"{', '.join(close[:5])}{f' and {len(close) - 5} more' if len(close) > 5 else ''}"
    v, a, b = max(pairs)
    sentences = [
        "Per cent of the row's trace in the recordings that the column could make as well, beyond what the stiffnesses "
        "can; 100 % cannot be told apart by these motions and sensors, whatever the residual is.",
        f"Alike: {listed}." if close else f"No two of them are alike; the closest are {a} and {b} ({100 * v:.0f} %).",
    ]
    picture = categorical_charts.matrix_figure(names, values, "trace of", "explained by [%]")
    return _Chapter("What could be mistaken for what", sentences, [("", figures.figure_html(picture))])


# -- curves and parameters --------------------------------------------------------------------------------------------


def _curves(finding: DiagnosisResult, predicted: Sequence[_HeldOutPrediction]) -> _Chapter | None:
    changed = bool(finding.accepted_effects)
    found: list[tuple[float, str, TimePlot, TimePlot]] = []
    for episode, before, after in predicted:
        for k, samples in enumerate(episode.measurements):
            sensor = samples.sensor
            t = episode.grid.start_time + episode.grid.time_step * (samples.node + samples.fraction)
            for column, channel in enumerate(samples.channel_of_column):
                y, std = samples.value[:, column], samples.std[:, column]
                lines = {_NOMINAL_LABEL: before.predicted_outputs[k][:, column]}
                if changed:
                    lines[_EXTENDED_LABEL] = after.predicted_outputs[k][:, column]
                seen = np.isfinite(y) & np.isfinite(std)
                if not seen.any():
                    continue
                squares = [float(np.sum(((line - y)[seen] / std[seen]) ** 2)) for line in lines.values()]
                name = channel if sensor.outputs_per_channel == 1 else f"{channel}, {'xyz'[column % 3]}"
                pair = figures.prediction_and_residual_plots(name, sensor.unit, t, y, std, lines)
                found.append((squares[0] - (squares[1] if changed else 0.0), episode.name, *pair))
    if not found:
        return None
    found.sort(key=lambda entry: -entry[0])
    # the same joint in every recording would say the same thing again
    best: dict[str, tuple[float, str, TimePlot, TimePlot]] = {}
    for entry in found:
        best.setdefault(entry[2].axis_title, entry)
    chosen = list(best.values())[:_MAX_CHANNELS]
    pictures = []
    for recording in dict.fromkeys(entry[1] for entry in chosen):
        curves = [curve for _, name, *pair in chosen if name == recording for curve in pair]
        pictures.append(
            (
                f"Recording {recording}, held out",
                figures.figure_html(figures.time_plots_figure(curves, figures.MEASURED_COLOR, _MODEL_COLORS)),
            )
        )
    what = "change most with the effects" if changed else "the nominal model misses most"
    sentences = [
        f"The {len(chosen)} held-out coordinates or joints that {what}, measured and predicted; below each "
        "the error, with two standard deviations of the noise shaded: what is right stays within."
    ]
    return _Chapter("Measured and predicted", sentences, pictures)


def _absorbed(finding: DiagnosisResult) -> _Chapter | None:
    if not finding.accepted_effects or not finding.nominal_changes:
        return None
    by_unit: dict[str, dict[str, BeforeAfter]] = {}
    for entry in finding.nominal_changes:
        std = finding.nominal_model.std.get(entry.name, 0.0)
        by_unit.setdefault(entry.unit, {})[entry.name] = BeforeAfter(
            entry.value_before, entry.value_after, std, entry.std_after
        )
    words = ("fitted without the effects", _EXTENDED_LABEL, "")
    pictures = [
        ("", figures.figure_html(categorical_charts.before_after_figure(rows, f"value [{unit}]", words)))
        for unit, rows in by_unit.items()
    ]
    moved = [
        e for e in finding.nominal_changes if abs(e.value_after - e.value_before) > 0.1 * max(abs(e.value_before), 1e-9)
    ]
    moved.sort(key=lambda e: -abs(e.value_after - e.value_before) / max(abs(e.value_before), 1e-9))
    said = ", ".join(f"{e.name} goes from {e.value_before:.3g} to {e.value_after:.3g} {e.unit}" for e in moved[:4])
    sentences = [
        "A missing effect hides in the parameters that are free: this is how they move when it is added. Bars are two "
        "standard deviations, cut where they leave the picture.",
        f"{said}." if said else "None of them moves by more than a tenth.",
    ]
    return _Chapter("What the stiffnesses had absorbed", sentences, pictures)
