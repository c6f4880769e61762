"""Scores of answers: errors, intervals, held-out errors by a common referee, lines that a user writes."""

from __future__ import annotations

import ast
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from answer import Answer
from cases import Trial
from mujoco import rollout
from mujoco_models import AT_ENDS, SETTERS, at_samples, follow, settled_state

from yid_ocp.data.recording import Recording

HERE = Path(__file__).resolve().parent
Pairs = tuple[tuple[str, float], ...]


def score(trial: Trial, answer: Answer) -> dict[str, Any]:
    """Figures of one answer; those that need the true values are absent where nobody knows them.

    A parameter is called known where the tool itself does not doubt it and its interval is no wider than its value to
    either side; without intervals all are.
    """
    found: dict[str, Any] = {"estimates": dict(answer.estimates), "messages": list(answer.messages)}
    ends = answer.intervals
    if ends is not None:
        found["intervals"] = {name: [_finite(x) for x in pair] for name, pair in ends.items()}
    if not trial.truth:
        return found | {"held_out": float(np.sqrt(np.mean(np.square(answer.held_out))))}
    known = [name for name in trial.truth if _is_known(name, answer)]
    errors = {name: abs(answer.estimates[name] / value - 1) for name, value in trial.truth.items()}
    wrong = None
    if ends is not None:
        outside = [name for name, value in trial.truth.items() if not ends[name][0] <= value <= ends[name][1]]
        stated = [name for name in trial.truth if all(map(math.isfinite, ends[name]))]
        wrong = [name for name in outside if name in known]
        found |= {"holding": len(set(stated) - set(outside)), "stated": len(stated)}
    return found | {
        "known": known,
        "errors": errors,
        "known_but_outside": wrong,
        "held_out": held_out_error(trial, answer.estimates),
    }


def _finite(x: float) -> float | None:
    return float(x) if math.isfinite(x) else None


def _is_known(name: str, answer: Answer) -> bool:
    if name in answer.doubted:
        return False
    if answer.intervals is None:
        return True
    value, (lower, upper) = answer.estimates[name], answer.intervals[name]
    return max(value - lower, upper - value) <= abs(value)


def held_out_error(trial: Trial, estimates: Mapping[str, float]) -> float:
    """Rms difference between the held-out recording with these values and without any noise, in MuJoCo.

    Torques that the arm needs [N m], with what the recording makes of them, or of springs the places of the end [m].
    """
    scale, recording, shape = trial.recorded_over_true_torque, trial.held_out[0], tuple(trial.true_shape.items())
    own, true = (_played(trial.case, trial.mjcf, recording, tuple(x.items()), shape) for x in (estimates, trial.truth))
    return float(np.sqrt(np.mean((own - scale * true) ** 2)))


@functools.lru_cache(maxsize=4)
def _played(case: str, mjcf: str, recording: Recording, values: Pairs, shape: Pairs) -> Any:
    spec, joints = mujoco.MjSpec.from_string(mjcf), recording.joints
    assert joints is not None
    for name, value in values:
        SETTERS[case](spec, name, value)
    posture = joints.position[:5].mean(axis=0)
    following = follow(spec, joints.names, posture)
    if case == "springs":
        end = {"objtype": mujoco.mjtObj.mjOBJ_XBODY, "objname": "spring_2_body"}
        spec.add_sensor(name="end", type=mujoco.mjtSensor.mjSENS_FRAMEPOS, **end)
    model = spec.compile()
    start = settled_state(model, following.columns, posture, dict(shape))
    times, controls = following.controls(joints, joints.names, model.opt.timestep)
    states, readings = rollout.rollout(model, mujoco.MjData(model), start, controls)
    if case == "springs":
        return np.array(readings[0][times >= 0])
    torques = at_samples(times, following.torques(controls, states[0], model.nq), joints)
    inside = slice(*(round(x / float(np.median(np.diff(joints.t)))) for x in (AT_ENDS, joints.t[-1] - AT_ENDS)))
    return torques[inside]


def user_lines(module: str, function: str) -> int:
    """Lines of code that a user of a tool writes for one case: a function and all that it uses from these scripts.

    Without blank lines, comments, docstrings and imports; what defines the cases and the answer is not counted.
    """
    pieces = {(own, name): node for own in TOOL_MODULES for name, node in _definitions(own).items()}
    wanted, seen = [(module, function)], set()
    while wanted:
        piece = wanted.pop()
        if piece in seen or piece not in pieces:
            continue
        seen.add(piece)
        names = {node.id for node in ast.walk(pieces[piece]) if isinstance(node, ast.Name)}
        wanted += [(own, name) for own, name in pieces if name in names and own in (piece[0], "mujoco_models")]
    return sum(_code_lines(own, pieces[own, name]) for own, name in seen)


TOOL_MODULES = (
    "mujoco_models", "with_friction_ladder", "with_least_squares", "with_opty", "with_sysid", "with_yid_ocp",
)  # fmt: skip
# of all cases; each counts the setter that it needs
_TABLES = ("BY_CASE", "SETTERS")


@functools.cache
def _definitions(module: str) -> dict[str, ast.stmt]:
    tree = ast.parse((HERE / f"{module}.py").read_text(encoding="utf-8"))
    found: dict[str, ast.stmt] = {}
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            found[node.targets[0].id] = node
    return {name: node for name, node in found.items() if name not in _TABLES}


def _code_lines(module: str, node: ast.stmt) -> int:
    lines = (HERE / f"{module}.py").read_text(encoding="utf-8").splitlines()
    left_out: set[int] = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant) and isinstance(part.value.value, str):
            left_out |= set(range(part.lineno, (part.end_lineno or part.lineno) + 1))
        if isinstance(part, ast.Import | ast.ImportFrom):
            left_out.add(part.lineno)
    numbers = range(node.lineno, (node.end_lineno or node.lineno) + 1)
    return sum(bool(lines[k - 1].strip()) and not lines[k - 1].strip().startswith("#") for k in set(numbers) - left_out)


def yaml_lines(path: Path) -> int:
    """Lines of a configuration file that are neither blank nor comments."""
    texts = (line.strip() for line in path.read_text(encoding="utf-8").splitlines())
    return sum(bool(text) and not text.startswith("#") for text in texts)
