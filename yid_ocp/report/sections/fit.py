"""How well the model predicts what was measured, channel by channel, held-out recordings included."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from yid_ocp.problem.episodes import Episode
from yid_ocp.problem.prediction import EpisodeResult
from yid_ocp.report import figures
from yid_ocp.report.sections.base import Findings, section
from yid_ocp.report.tables import held_out_rows, medians
from yid_ocp.sensors import Sensor
from yid_ocp.solvers.words import fit_words

MOST_PICTURES = 24  # a page with more is too heavy to open; result.json and trajectories.h5 have them all
WORDS = {
    "stays": "points stay where they were first seen",
    "zero": "an effort of zero",
    "moves_with_clamps": "points move with the mean of the clamps",
    "linear_carry": "the clamps' motion carried along the cable",
}


@section("fit", 20, "How well it fits")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Errors per channel, curves and the histogram of whitened residuals."""
    if findings.problem is None or not findings.episodes:
        return None
    result = findings.result
    pictures: list[tuple[str, str]] = []
    left = 0
    for role, episode, outcome in findings.episodes:
        for title, picture in _pictures(findings, role, episode, outcome):
            if len(pictures) < MOST_PICTURES:
                role_words = "held out" if role == "held_out" else "estimated on"
                pictures.append((f"{title} in {episode.name} ({role_words})", figures.html(picture)))
            else:
                left += 1
    residuals = _whitened(findings)
    rows = held_out_rows(result)
    return {
        "residuals": result.get("residuals", {}),
        "held_out": rows,
        "medians": medians(rows),
        "unpredicted": [entry for entry in result.get("held_out", []) if "message" in entry],
        "words": WORDS,
        "pictures": pictures,
        "left": left,
        "histogram": figures.html(figures.residual_histogram(residuals)) if residuals else None,
        "fit": None if "fit" not in result else fit_words(result["fit"]["chi2_per_dof"], result["fit"]["explains"]),
    }


def _pictures(findings: Findings, role: str, episode: Episode, outcome: EpisodeResult) -> list[tuple[str, Any]]:
    assert findings.problem is not None
    step = findings.problem.step.time_step
    found = []
    for samples, predicted in zip(episode.samples, outcome.predicted, strict=True):
        t = episode.grid.start + step * (samples.node + samples.fraction)
        sensor = samples.sensor
        if sensor.width == 1:
            names = [channel.rsplit(".", 1)[1] for channel in sensor.channels]
            curves = {name: (t, samples.value[:, i], t, predicted[:, i]) for i, name in enumerate(names)}
            found.append((sensor.group, figures.measured_and_predicted(curves, sensor.unit)))
            continue
        t_model, course = t, predicted
        if len(t) < episode.grid.steps / 2:
            t_model, course = episode.grid.times, _course(findings, role, episode, outcome, sensor)
        for c, channel in enumerate(sensor.channels):
            at = 3 * c
            curves = {axis: (t, samples.value[:, at + i], t_model, course[:, at + i]) for i, axis in enumerate("xyz")}
            found.append((channel, figures.measured_and_predicted(curves, sensor.unit)))
    return found


def _course(findings: Findings, role: str, episode: Episode, outcome: EpisodeResult, sensor: Sensor) -> np.ndarray:
    """What a sensor of points would have seen at every node, for one that looks seldom, shape (N + 1, k)."""
    problem, solution = findings.problem, findings.solution
    assert problem is not None
    assert solution is not None
    theta, _ = problem.split(solution.x, problem.episodes.index(episode) if role == "estimate" else 0)
    n, state = problem.system.size, outcome.rollout.state
    efforts = np.zeros((len(state), n))
    own = problem.predictor.own_theta(episode, theta)
    seen = problem.functions.sensor(sensor, ())(state[:, :n], state[:, 2 * n :], efforts, own)
    return np.asarray(seen[0][:, :, 0])


def _whitened(findings: Findings) -> dict[str, np.ndarray]:
    found: dict[str, list[np.ndarray]] = {}
    for role, episode, outcome in findings.episodes:
        if role != "estimate":
            continue
        for samples, predicted in zip(episode.samples, outcome.predicted, strict=True):
            ratio = (predicted - samples.value) / samples.std
            found.setdefault(samples.sensor.group, []).append(ratio[np.isfinite(ratio)])
    return {group: np.concatenate(parts) for group, parts in found.items() if sum(map(len, parts))}
