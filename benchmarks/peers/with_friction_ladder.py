"""The friction ladder of the published servo models (arXiv:2410.08650).

An implementation of the published equations, rungs M1 to M5. Friction resists with what would stop the joint, up to

    constant + viscous |w| + load |tau_m - tau_e| + s (stribeck + load_at_rest |tau_m - tau_e|)

where s = exp(-|w / w_s|^a), w is the speed, tau_m the motor's torque and tau_e that of gravity; M5 weighs tau_m and
tau_e apart. All recordings and all steps of a finite difference march together.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from answer import Answer
from cases import Trial
from scipy.optimize import least_squares

from yid_ocp.data.recording import Recording

STEP = 0.005  # [s]
MASS, LENGTH, GRAVITY = 0.49, 0.1, 9.81  # of the pendulum on the bench
# name: start, lower, upper; the figures published for the motor
MOTOR = {
    "gain": (0.002, 0.0002, 0.01), "counter_voltage": (0.037, 0.001, 0.3), "torque_limit": (0.71, 0.1, 3.0),
    "armature": (0.0018, 1e-4, 0.01), "offset": (-0.03, -0.1, 0.1), "delay": (0.005, 0.0, 0.05),
    "viscous": (0.0037, 0.0, 0.1), "constant": (0.0128, 0.0, 0.2),
}  # fmt: skip
STRIBECK = {"stribeck": (0.01, 0.0, 0.2), "speed": (2.56, 0.1, 10.0), "power": (0.76, 0.3, 4.0)}
LOAD = {"load": (0.068, 0.0, 0.5)}
LOAD_AT_REST = {"load_at_rest": (0.0738, 0.0, 1.0)}
DIRECTIONAL = {"outside": (1.0, 0.0, 3.0), "outside_at_rest": (1.0, 0.0, 3.0)}  # weight of tau_e beside tau_m's
RUNGS = {
    "M1": MOTOR,
    "M2": MOTOR | STRIBECK,
    "M3": MOTOR | LOAD,
    "M4": MOTOR | STRIBECK | LOAD | LOAD_AT_REST,
    "M5": MOTOR | STRIBECK | LOAD | LOAD_AT_REST | DIRECTIONAL,
}


def most_friction(p: dict[str, Any], speed: Any, motor: Any, outside: Any) -> Any:
    """The most that friction can resist, without its viscous part [N m]."""
    rest = np.exp(-(np.abs(speed / p["speed"]) ** p["power"])) if "speed" in p else 0.0
    most = p["constant"] + rest * p.get("stribeck", 0.0)
    if "load" in p:
        most = most + p["load"] * np.abs(motor - p.get("outside", 1.0) * outside)
    if "load_at_rest" in p:
        most = most + rest * p["load_at_rest"] * np.abs(motor - p.get("outside_at_rest", 1.0) * outside)
    return most


def angles(p: dict[str, Any], recordings: tuple[Recording, ...]) -> list[Any]:
    """Angles at the samples of every recording; parameters of shape (P, 1) or numbers, angles (P, N)."""
    groups = [recording.joints for recording in recordings]
    times = [joints.t - joints.t[0] for joints in groups]
    commands = [j.position if j.position_command is None else j.position_command for j in groups]
    on = np.array([joints.effort is None or bool(np.any(joints.effort)) for joints in groups])
    factor = on * np.array([float(np.ravel(joints.proportional_gain)[0]) for joints in groups])
    steps = int(max(t[-1] for t in times) / STEP) + 2
    late = np.broadcast_to(p["delay"], (np.size(p["delay"]), 1))
    grid = np.arange(steps) * STEP - late  # (P, K)
    given = np.stack(
        [c[np.searchsorted(t, grid, "right").clip(1) - 1, 0] for c, t in zip(commands, times, strict=True)], axis=-1
    )
    q = np.repeat([[float(joints.position[0, 0]) for joints in groups]], len(late), axis=0)
    inertia, w, path = MASS * LENGTH**2 + p["armature"], np.zeros_like(q), np.empty((steps, *q.shape))
    for k in range(steps):
        path[k] = q
        duty = np.clip(p["gain"] * factor * (given[:, k] - q), -p["torque_limit"], p["torque_limit"])
        motor = duty - p["counter_voltage"] * on * w
        outside = -MASS * GRAVITY * LENGTH * np.sin(q - p["offset"])
        stop = inertia / STEP * w + motor + outside
        most = most_friction(p, w, motor, outside) + p["viscous"] * np.abs(w)
        w = w + STEP / inertia * (motor + outside - np.sign(stop) * np.minimum(np.abs(stop), most))
        q = q + STEP * w
    grid = np.arange(steps) * STEP
    return [np.array([np.interp(t, grid, path[:, i, r]) for i in range(q.shape[0])]) for r, t in enumerate(times)]


def fit_rung(trial: Trial, rung: str, start: dict[str, float]) -> dict[str, float]:
    known = RUNGS[rung]
    names, lower, upper = list(known), *(np.array([known[n][k] for n in known]) for k in (1, 2))
    measured = np.concatenate([recording.joints.position[:, 0] for recording in trial.estimate])

    def predicted(points: Any) -> Any:
        values = {name: column[:, None] for name, column in zip(names, np.atleast_2d(points).T, strict=True)}
        return np.hstack(angles(values, trial.estimate))

    def jacobian(x: Any) -> Any:
        step = 1e-4 * (upper - lower) * np.where(x + 1e-4 * (upper - lower) > upper, -1, 1)
        moved = predicted(np.vstack([x, x + np.diag(step)]))
        return ((moved[1:] - moved[0]) / step[:, None]).T

    x0 = np.clip([start.get(name, known[name][0]) for name in names], lower + 1e-6, upper - 1e-6)
    found = least_squares(
        lambda x: predicted(x)[0] - measured, x0, jacobian, (lower, upper), x_scale=upper - lower, max_nfev=40
    )
    return dict(zip(names, map(float, found.x), strict=True))


def servo(trial: Trial) -> dict[str, Answer]:
    """The answer of every rung; each begins where the one before it ended."""
    found: dict[str, float] = {}
    answers = {}
    for rung in RUNGS:
        found = fit_rung(trial, rung, found)
        values = {name: np.array([[value]]) for name, value in found.items()}
        left = [
            path[0] - recording.joints.position[:, 0]
            for path, recording in zip(angles(values, trial.held_out), trial.held_out, strict=True)
        ]
        answers[rung] = Answer(found, held_out=tuple(float(np.sqrt(np.mean(each**2))) for each in left))
    return answers


BY_CASE = {"servo": servo}
