"""Section: animation of arm and object, measured and predicted."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from yid_ocp.report.scene import Scene, Told, scene
from yid_ocp.report.sections.base import Findings, section

MOST = 4  # recordings; a page with more is slow to open
ROLES = {"estimate": "estimated on", "held_out": "held out"}


@section("scene", 3, "In motion")
def prepare(findings: Findings) -> Mapping[str, Any] | None:
    """Template context: the command's animations, else the predicted motion of each recording, held-out first."""
    scenes = [entry for entry in findings.scenes or _predicted(findings) if len(entry.t) > 1]
    told = json.dumps([entry.to_dict() for entry in scenes[:MOST]], separators=(",", ":")).replace("<", "\\u003c")
    both = any(
        len({motion.name for motion in entry.motions} - {"measured"}) < len(entry.motions) > 1 for entry in scenes
    )
    return {"scenes": told, "both": both} if scenes else None


def _predicted(findings: Findings) -> Sequence[Scene]:
    problem, solution = findings.problem, findings.solution
    if problem is None or solution is None:
        return []
    result = []
    for role, episode, outcome in sorted(findings.episodes, key=lambda entry: entry[0] != "held_out")[:MOST]:
        theta, _ = problem.split(solution.x, problem.episodes.index(episode) if role == "estimate" else 0)
        own = problem.predictor.own_theta(episode, theta)
        q = outcome.rollout.state[:, : problem.system.size]
        told = Told("predicted", problem.system, own, episode.grid.times, q)
        result.append(scene(f"{episode.name} ({ROLES[role]})", [told], episode.recording))
    return result
