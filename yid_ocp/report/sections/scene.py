"""Section: animation of arm and object, measured and predicted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from yid_ocp.report.animation import Animation, ModelTrajectory, make_animation
from yid_ocp.report.sections.base import ReportData, register_section

_MAX_RECORDINGS = 4  # recordings; a page with more is slow to open
_ROLE_LABELS = {"estimate": "estimated on", "held_out": "held out"}


@register_section("scene", 3, "In motion")
def animation_context(findings: ReportData) -> Mapping[str, Any] | None:
    """Template context: the command's animations, else the predicted motion of each recording, held-out first."""
    scenes = [entry for entry in findings.animations or _predicted(findings) if len(entry.t) > 1]
    told = json.dumps([entry.to_dict() for entry in scenes[:_MAX_RECORDINGS]], separators=(",", ":")).replace(
        "<", "\\u003c"
    )
    both = any(
        len({motion.name for motion in entry.motions} - {"measured"}) < len(entry.motions) > 1 for entry in scenes
    )
    return {"scenes": told, "both": both} if scenes else None


def _predicted(findings: ReportData) -> Sequence[Animation]:
    problem, solution = findings.problem, findings.solution
    if problem is None or solution is None:
        return []
    result = []
    for role, episode, outcome in sorted(findings.predicted_episodes, key=lambda entry: entry[0] != "held_out")[
        :_MAX_RECORDINGS
    ]:
        theta, _ = problem.split(solution.x, problem.episodes.index(episode) if role == "estimate" else 0)
        own = problem.predictor.episode_theta(episode, theta)
        q = outcome.rollout.state[:, : problem.system.n_coordinates]
        told = ModelTrajectory("predicted", problem.system, own, episode.grid.node_times, q)
        result.append(make_animation(f"{episode.name} ({_ROLE_LABELS[role]})", [told], episode.recording))
    return result
