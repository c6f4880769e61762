"""Checks of recorded efforts against inverse dynamics: sign, gain, zero and lag of each joint.

With measured effort e_j of joint j and the effort w_j that bodies and gravity need (Newton and Euler),

    e_j / g_j = w_j + c_j + d_j v_j + s_j sign(v_j) + k_j q_j + (J' f)_j,

linear in 1/g_j, offset, friction, springs and in the force f = f_0 + K (x - mean x) + D dx/dt + (quadratic in x) with
which each grasp loads the arm, whatever it holds. All have priors of the size that robots have, so that a joint about
which the recording says nothing keeps g = 1. Nothing is said of a joint whose effort is not explained: a counterbalance
that the URDF does not have is no wrong sign.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from yid_ocp.analysis.plausibility.arm import Arm, Motion, effect_line, recorded_motion
from yid_ocp.data.doubt import Doubt
from yid_ocp.data.recording import Recording
from yid_ocp.effects.base import arms

Array = NDArray[np.float64]

ERROR, ERROR_OF_MOTION = 0.02, 0.1
"""What a robot's model is off by: part of the joint's largest effort, part of the spread of what it needs."""
OFFSET, VISCOUS, COULOMB, SPRING = 0.05, 0.04, 0.02, 0.02
"""Usual sizes beside a joint's largest effort: of a zero's error, of friction [per rad/s, 1], of a spring [per rad]."""
FORCE, STIFFNESS, BENDING, DAMPER = 30.0, 150.0, 1500.0, 30.0
"""Usual sizes of the force on a grasp [N], and by which it changes [N/m, N/m^2, N s/m]."""
GAIN = 3.0
"""Usual size of 1/g, and the factor from which a gain counts as wrong."""
EXPLAINED = 1.5
"""Root mean square of what is left, in sizes of the model's error, up to which a joint's effort is explained."""
WELL = 0.5
"""The same up to which nothing is left to be explained by a lag."""
UNLIKE = 3.0
"""The same from which on it is not this robot's."""
TINY, ABSURD = 1e-12, 1e12  # where numbers end that a fit can be made of
SURE = 5.0
"""Standard deviations from which on a number counts."""
SLOW = 1.0
"""Samples further apart than half of its inverse count as independent [Hz]."""
NOTHING = 1e-3
"""Efforts below this tell nothing [N m]."""
LAG = 0.1
"""Steps in which a lag of efforts behind the motion is looked for; a shorter one is no gross error [s]."""
COMMANDED = 0.2
"""Part of the largest effort that a joint of which nothing is asked may seem to need: it swings, and has friction."""
ABOVE_LIMIT = 1.3
"""Factor by which an effort may exceed the URDF's limit, which some makers state for continuous use."""


@dataclass(frozen=True)
class _Fit:
    """`inverse` 1/g and its `std`, `offset` [N m], what is `left` in sizes of the model's error, each (k,); `cost`.

    `direct` is the gain by which an effort's variation follows what is needed, `shift` by how much it is off in the
    mean [N m]: without the prior, and not made smaller by noise of what was measured.
    """

    inverse: Array
    std: Array
    offset: Array
    offset_std: Array
    left: Array
    direct: Array
    shift: Array
    cost: float


def check_efforts(arm: Arm, recording: Recording) -> list[Doubt]:
    """Issues of recorded efforts that disagree with the inverse dynamics of the recorded motion.

    Parameters
    ----------
    arm : Arm
    recording : Recording
    """
    joints = recording.joints
    motion = None if joints is None else recorded_motion(joints, arm.names)
    if joints is None or motion is None or motion.effort is None or len(motion.t) < 10:
        return []
    needed = arm.inverse_dynamics(motion.q, motion.v, motion.a)
    largest = np.array([joint.effort_limit for joint in arm.joints])
    size = np.where(np.isfinite(largest), largest, np.maximum(np.max(np.abs(needed), axis=0), 1e-9))
    found = list(_limits(arm, motion, largest))
    most = [float(np.max(np.abs(values), initial=0.0)) for values in (needed, motion.effort)]
    if not most[0] > NOTHING or not max(most) < ABSURD:
        return [replace(doubt, recording=recording.name, group="joints") for doubt in found]
    dead = _dead(motion.effort, needed, COMMANDED * size if joints.effort_taken_as == "command" else 2 * ERROR * size)
    if dead.any():
        found.append(_zero(arm, dead))
    else:
        # motion to and fro that is late looks turned round, so that comes first
        found += list(_late(arm, motion, needed, size)) or list(_by_joint(arm, motion, needed, size))
    return [replace(doubt, recording=recording.name, group="joints") for doubt in found]


def _limits(arm: Arm, motion: Motion, largest: Array) -> Iterator[Doubt]:
    assert motion.effort is not None
    ratio = np.percentile(np.abs(motion.effort), 99, axis=0) / largest
    if np.any(ratio > ABOVE_LIMIT):
        j = int(np.argmax(ratio))
        yield Doubt(
            "effort_limits",
            f"the effort of {arm.names[j]} is {ratio[j]:.3g} times what it can bear ({largest[j]:.3g} N m)",
            "not_trusted",
            float(ratio[j]) / ABOVE_LIMIT,
            "check the unit of efforts (N m) and the robot's description",
            "",
            "joints",
            f"effort.{arm.names[j]}",
        )


def _dead(effort: Array, needed: Array, least: Array) -> NDArray[np.bool_]:
    """Joints whose effort is zero throughout although gravity and motion need more than the least that counts."""
    wanted = np.sqrt(np.mean(needed**2, axis=0))
    silent = np.max(np.abs(effort), axis=0) < 1e-3 * wanted
    return np.asarray(silent & (wanted > least))


def _zero(arm: Arm, dead: NDArray[np.bool_]) -> Doubt:
    names = [name for name, off in zip(arm.names, dead, strict=True) if off]
    which = "all joints" if dead.all() else ", ".join(names)
    return Doubt(
        "effort_zero",
        f"the effort of {which} is zero throughout, while gravity and motion need more",
        "not_trusted",
        1e3,
        "record efforts; to leave these out, move the arms as measured and switch their efforts off",
        "",
        "joints",
        "effort",
        setting="model.arms.mode: prescribed, sensors.joints.effort.use: false",
    )


def _by_joint(arm: Arm, motion: Motion, needed: Array, size: Array) -> Iterator[Doubt]:
    assert motion.effort is not None
    loaded = _loaded(arm, motion, size)
    # What is held can add to efforts, but not several times what the arm itself weighs, nor carry nearly all of that.
    # A prior about one holds a gain that is a power of ten away, so efforts are scaled first.
    ratio = float(np.linalg.norm(needed)) / max(float(np.linalg.norm(motion.effort)), 1e-300)
    common = 10.0 ** round(math.log10(ratio)) if not 1 / GAIN < ratio < GAIN else 1.0
    fit = _fitted(arm, motion, common * motion.effort, needed, size)
    told = fit.std < np.maximum(0.6 * np.abs(fit.inverse), 0.35)
    sound = told & (fit.left < EXPLAINED) & (np.abs(fit.offset) < 3 * OFFSET * size)
    scale = 1.0
    if common != 1.0 and sound.sum() >= 2:
        scale = 1 / (common * max(float(np.median(np.abs(fit.inverse[sound]))), TINY))
    if not 1 / GAIN < scale < GAIN:
        yield Doubt(
            "effort_gain",
            f"efforts are about {scale:.2g} times what gravity and motion need",
            "not_trusted",
            max(scale, 1 / scale) / GAIN,
            f"divide efforts by {1 / common:g}, if their unit is another",
            channel="effort",
            recording="",
        )
    turned = sound & (fit.inverse < -SURE * fit.std / 2) & (fit.inverse < -0.3)
    upright = told & (fit.inverse > SURE * fit.std / 2) & (fit.inverse > 0.3)
    if turned.sum() >= 2 and not upright.any():
        depth = float(np.max(-fit.inverse[turned] / fit.std[turned])) / (SURE / 2)
        yield _sign("all efforts have", depth, "effort")
    else:
        for j in np.flatnonzero(turned):
            depth = float(-fit.inverse[j] / fit.std[j]) / (SURE / 2)
            yield _sign(f"the effort of {arm.names[j]} has", depth, f"effort.{arm.names[j]}")
    for j in np.flatnonzero(sound & ~turned):
        inverse, off = float(fit.inverse[j]), abs(float(fit.inverse[j]) - 1) / float(fit.std[j])
        weak, strong = inverse > GAIN, 0 < inverse < 1 / GAIN and fit.direct[j] > GAIN and not loaded[j]
        if off > SURE and (weak or strong):
            yield Doubt(
                "effort_gain",
                f"the effort of {arm.names[j]} is {1 / inverse:.2g} times what gravity and motion need",
                "not_trusted",
                off / SURE,
                "find out what the number stands for",
                "",
                "joints",
                f"effort.{arm.names[j]}",
            )
    # a large zero error looks like a large gain; but then the variation follows as it should
    off_zero = (fit.inverse > 0) & (fit.inverse < 1 / GAIN) & (fit.direct > 1 / GAIN) & (fit.direct < GAIN)
    offset = np.where(off_zero, fit.shift, fit.offset)
    calm = told & (fit.left < EXPLAINED / 1.5) & (off_zero | ((fit.inverse > 1 / GAIN) & (fit.inverse < GAIN)))
    for j in np.flatnonzero(calm & ~loaded & (np.abs(offset) > 3 * OFFSET * size)):
        # springs that carry part of the weight are no wrong zero
        balanced = offset[j] * np.mean(needed[:, j]) < 0 and abs(offset[j]) < np.max(np.abs(needed[:, j]))
        sure = abs(offset[j]) > SURE * fit.offset_std[j]
        if sure and not balanced:
            yield Doubt(
                "effort_offset",
                f"the zero of the effort of {arm.names[j]} is off by {offset[j]:+.3g} N m",
                "not_trusted",
                abs(float(offset[j])) / (3 * OFFSET * float(size[j])),
                "let it be estimated, or set the sensor's zero",
                "",
                "joints",
                f"effort.{arm.names[j]}",
                setting=effect_line("effort_offset", arm.names[j], "offset", float(offset[j])),
            )
    lost = fit.left > UNLIKE
    if arm.complete and lost.sum() > len(arm.names) / 2:
        yield Doubt(
            "effort_unlike",
            f"efforts of {lost.sum()} of {len(arm.names)} joints are not what this robot needs for this motion: "
            f"{np.median(fit.left[lost]):.2g} times what a robot's model is off by",
            "not_trusted",
            float(np.median(fit.left[lost])) / UNLIKE,
            "check that the recording is this robot's, its unit of time, and the order of joints",
            "",
            "joints",
            "effort",
        )


def _sign(who: str, depth: float, channel: str) -> Doubt:
    return Doubt(
        "effort_sign",
        f"{who} the opposite sign of what gravity and motion need",
        "not_trusted",
        depth,
        "turn the sign; effort is what the motor does to the joint",
        "",
        "joints",
        channel,
    )


def _late(arm: Arm, motion: Motion, needed: Array, size: Array) -> Iterator[Doubt]:
    """Efforts that follow the motion late or early, all alike."""
    assert motion.effort is not None
    trials = LAG * np.arange(-5, 6)
    if motion.t[-1] - motion.t[0] < 4 * trials[-1]:
        return
    if np.max(_fitted(arm, motion, motion.effort, needed, size).left) < WELL:
        return
    inside = (motion.t >= motion.t[0] + trials[-1]) & (motion.t <= motion.t[-1] - trials[-1])
    kept = replace(motion, t=motion.t[inside], q=motion.q[inside], v=motion.v[inside], a=motion.a[inside])
    costs = []
    for late in trials:
        moved = np.stack([np.interp(kept.t + late, motion.t, column) for column in motion.effort.T], axis=1)
        costs.append(_fitted(arm, kept, moved, needed[inside], size).cost)
    at = int(np.argmin(costs))
    # twice over, so that what friction and grasp take up of a lag does not count
    if abs(trials[at]) > 0.5 * LAG and costs[at] < 0.4 * costs[len(trials) // 2]:
        yield Doubt(
            "effort_lag",
            f"efforts fit the motion best {abs(trials[at]):.2g} s {'earlier' if trials[at] > 0 else 'later'} than "
            "they were recorded",
            "not_trusted",
            abs(float(trials[at])) / LAG,
            "shift their times",
            "",
            "joints",
            "effort",
            setting="; ".join(
                effect_line("effort_delay", name, "delay", float(trials[at])) for name in arms(arm.system)
            )
            if abs(trials[at]) <= LAG
            else "",
        )


def _fitted(arm: Arm, motion: Motion, effort: Array, needed: Array, size: Array) -> _Fit:
    count, width = needed.shape
    error = ERROR * size + ERROR_OF_MOTION * needed.std(axis=0)
    columns, spread = _by_itself(arm, motion, effort, size)
    loads, sizes = _loads(arm, motion)
    matrix = np.concatenate([columns, loads], axis=2) / error[:, None]
    prior = np.concatenate([spread, sizes])
    independent = max(2 * SLOW * (motion.t[-1] - motion.t[0]), 2.0)
    weight = math.sqrt(min(1.0, independent / count))
    rows, target = weight * matrix.reshape(count * width, -1), weight * (needed / error).ravel()
    normal = rows.T @ rows + np.diag(1 / prior**2)
    pull = np.zeros(len(prior))
    pull[:width] = 1 / prior[:width] ** 2
    found = np.linalg.solve(normal, rows.T @ target + pull)
    std = np.maximum(np.sqrt(np.diag(np.linalg.inv(normal))), TINY)
    remains = (rows @ found - target).reshape(count, width) / weight
    others = np.concatenate([np.zeros(2 * width), found[2 * width :]])
    explained = needed - np.einsum("njc,c->nj", matrix * error[:, None], others)
    shift = effort.mean(axis=0) - explained.mean(axis=0)
    moved, about = explained - explained.mean(axis=0), effort - effort.mean(axis=0)
    direct = np.sum(about * moved, axis=0) / np.maximum(np.sum(moved**2, axis=0), 1e-12)
    cost = float(
        np.sum((rows @ found - target) ** 2) + np.sum(((found - (np.arange(len(prior)) < width)) / prior) ** 2)
    )
    own = slice(width, 2 * width)
    return _Fit(
        found[:width], std[:width], found[own], std[own], np.sqrt(np.mean(remains**2, axis=0)), direct, shift, cost
    )


def _by_itself(arm: Arm, motion: Motion, effort: Array, size: Array) -> tuple[Array, Array]:
    """Columns of each joint alone, shape (N, k, 5 k), and their usual sizes: 1/g, offset, friction twice, spring."""
    count, width = effort.shape
    parts = [
        (effort, np.full(width, GAIN)),
        (-np.ones_like(effort), OFFSET * size),
        (-motion.v, VISCOUS * size),
        (-np.tanh(motion.v / 0.02), COULOMB * size),
        (-(motion.q - motion.q.mean(axis=0)), _springs(arm, size)),
    ]
    columns = np.zeros((count, width, width * len(parts)))
    for k, (values, _) in enumerate(parts):
        for j in range(width):
            columns[:, j, k * width + j] = values[:, j]
    return columns, np.concatenate([spread for _, spread in parts])


def _springs(arm: Arm, size: Array) -> Array:
    """Usual size of a spring on each joint; large where the model has one whose stiffness is sought."""
    sprung = {spring.joint for spring in arm.system.elastic}
    return np.where([name in sprung for name in arm.names], 10 * size, SPRING * size)


def _loaded(arm: Arm, motion: Motion, size: Array) -> NDArray[np.bool_]:
    """Joints on which what is held can act like a wrong zero."""
    holders = tuple(grasp.holder for grasp in arm.system.grasps if arm.carries(grasp.holder))
    if not holders:
        return np.zeros(len(arm.names), bool)
    _, by_angle = arm.places(holders, motion.q[:: max(1, len(motion.q) // 20)])
    lever = np.max(np.linalg.norm(by_angle, axis=2), axis=(0, 1))
    return np.asarray(FORCE * lever > 3 * OFFSET * size)


def _loads(arm: Arm, motion: Motion) -> tuple[Array, Array]:
    """Columns of the force at every grasp, shape (N, k, 33 per grasp), and their usual sizes."""
    holders = tuple(grasp.holder for grasp in arm.system.grasps if arm.carries(grasp.holder))
    count, width = motion.q.shape
    if not holders:
        return np.zeros((count, width, 0)), np.zeros(0)
    place, by_angle = arm.places(holders, motion.q)
    columns, sizes = [], []
    for g in range(len(holders)):
        moved = place[:, g] - place[:, g].mean(axis=0)
        speed = np.einsum("nik,nk->ni", by_angle[:, g], motion.v)
        for axis in range(3):
            lever = by_angle[:, g, axis, :]
            squares = [lever * (moved[:, [b]] * moved[:, [c]]) for b in range(3) for c in range(b, 3)]
            columns += [lever, *(lever * moved[:, [b]] for b in range(3)), *squares, lever * speed[:, [axis]]]
            sizes += [FORCE, *[STIFFNESS] * 3, *[BENDING] * 6, DAMPER]
    return np.stack(columns, axis=2), np.array(sizes)
