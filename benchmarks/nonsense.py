"""Recordings that are wrong on purpose: is each named with its cause, and is nothing found on any of them?

    python benchmarks/nonsense.py [FOLDER] [--only TEXT] [--real RECORDINGS]

Every case damages a recording that ships with the package (Baxter and the foam Y, from MuJoCo), or a real one of
RECORDINGS (Baxter's arm in free motion, a Panda with a beam, a branched cable), and hands it to the same steps as
`yid-ocp solve`. Finished cases are kept in FOLDER/cases.jsonl and not repeated. A case passes where the cause that was
made is named, or the recording is refused; a solve follows where no doubt forbids to trust it, and must find nothing.
That the undamaged recordings of shipped configurations are not in doubt is for `tests/test_nonsense_benchmark.py`.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.errors import DataError, YidError
from yid_ocp.integrator.step import Step
from yid_ocp.solvers import fit_problem
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.run_inputs import resolve_recording_path

Damage = Callable[[Recording], Recording]
CONFIGS = Path(__file__).parents[1] / "configs"
DEFAULT_REAL = Path(__file__).parents[2] / "shared" / "recordings"
REAL = {
    "baxter_arm": "baxter/random.h5",
    "panda_beam": "panda_beam/ocp_z_25cm_0.50s_1.h5",
    "deft_bdlo1": "deft/bdlo1_train_007.h5",
}


@dataclass(frozen=True)
class Case:
    """One wrong recording.

    Attributes
    ----------
    name : str
    config : str
        Shipped configuration whose first recording is damaged.
    damage : callable
    causes : tuple of str
        Of which one has to be named.
    role : {'estimate', 'held_out', 'twice', 'both'}
        What the damaged recording is used for; `twice` adds it to the undamaged one, `both` holds it out as well.
    settings : tuple of str
        Further `KEY=VALUE`.
    refused : str
        Words of the error with which it may be refused instead.
    """

    name: str
    config: str
    damage: Damage
    causes: tuple[str, ...]
    role: str = "estimate"
    settings: tuple[str, ...] = ()
    refused: str = ""


# -- what can be wrong ------------------------------------------------------------------------------------------------


def joints(**changes: Callable[[JointGroup], Any]) -> Damage:
    """Change fields of the joints."""

    def damage(recording: Recording) -> Recording:
        group = recording.joints
        assert group is not None
        made: dict[str, Any] = {name: change(group) for name, change in changes.items()}
        return replace(recording, joints=replace(group, **made))

    return damage


def points(name: str, change: Callable[[PointGroup], Mapping[str, Any]]) -> Damage:
    """Change fields of a group of points."""

    def damage(recording: Recording) -> Recording:
        made = [replace(g, **dict(change(g))) if g.name == name else g for g in recording.points]
        return replace(recording, points=tuple(made))

    return damage


def times(change: Callable[[np.ndarray], np.ndarray], *groups: str) -> Damage:
    """Change the clocks of some groups, or of all."""

    def damage(recording: Recording) -> Recording:
        own = recording.joints
        if own is not None and (not groups or "joints" in groups):
            own = replace(own, t=change(own.t))
        made = [replace(g, t=change(g.t)) if not groups or g.name in groups else g for g in recording.points]
        return replace(recording, joints=own, points=tuple(made))

    return damage


def kept(which: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Keep some samples of the joints, or of the first group of points."""

    def damage(recording: Recording) -> Recording:
        group = recording.joints
        if group is None:
            seen = recording.points[0]
            rows = which(seen.t)
            std = None if seen.std is None else seen.std[rows]
            first = replace(seen, t=seen.t[rows], position=seen.position[rows], std=std)
            return replace(recording, points=(first, *recording.points[1:]))
        rows = which(group.t)
        made: dict[str, Any] = {name: values[rows] for name, values in group.values_by_channel.items()}
        return replace(recording, joints=replace(group, t=group.t[rows], **made))

    return damage


def scaled(quantity: str, factor: float, *columns: int) -> Damage:
    """Multiply a channel of the joints."""

    def change(group: JointGroup) -> np.ndarray:
        values = np.array(getattr(group, quantity))
        values[:, list(columns) or slice(None)] *= factor
        return values

    return joints(**{quantity: change})


def stuck(column: int, start: float) -> Damage:
    """An encoder that repeats what it read at a moment."""

    def change(group: JointGroup) -> np.ndarray:
        values = np.array(group.position)
        first = int(np.searchsorted(group.t, start))
        values[first:, column] = values[first, column]
        return values

    return joints(position=change)


def stuck_point(recording: Recording) -> Recording:
    """A marker that motion capture no longer follows."""
    group = recording.points[0]
    values = np.array(group.position)
    values[150:, 6] = values[150, 6]
    return replace(recording, points=(replace(group, position=values), *recording.points[1:]))


def constant(recording: Recording) -> Recording:
    """One sample published again and again."""
    group = recording.joints
    assert group is not None
    made: dict[str, Any] = {
        name: np.repeat(values[:1], len(group.t), axis=0) for name, values in group.values_by_channel.items()
    }
    seen = [replace(g, position=np.repeat(g.position[:1], len(g.t), axis=0)) for g in recording.points]
    return replace(recording, joints=replace(group, **made), points=tuple(seen))


def noisy(factor: float) -> Damage:
    """Noise of so many times what is stated, on efforts or on the first group of points."""

    def damage(recording: Recording) -> Recording:
        rng, group = np.random.default_rng(3), recording.joints
        assert group is not None
        assert group.effort is not None
        std = group.effort_std if group.effort_std is not None else 0.05
        more = factor * np.broadcast_to(std, (len(group.names),)) * rng.standard_normal(group.effort.shape)
        return replace(recording, joints=replace(group, effort=group.effort + more))

    return damage


def tenfold(group: PointGroup) -> Mapping[str, Any]:
    """Ten times the noise that a group of points states."""
    assert group.std is not None
    return {"std": 10 * group.std}


def held_still(column: int) -> Damage:
    """A joint that turns by a thousandth of what it did, as its velocity says."""

    def less(values: np.ndarray | None) -> np.ndarray:
        assert values is not None
        made = np.array(values)
        made[:, column] = values[0, column] + 1e-3 * (values[:, column] - values[0, column])
        return made

    return joints(position=lambda g: less(g.position), velocity=lambda g: less(g.velocity))


def clipped(recording: Recording) -> Recording:
    """Efforts cut off at what nine in ten of their samples stay within."""
    group = recording.joints
    assert group is not None
    assert group.effort is not None
    low, high = np.percentile(group.effort, [10, 90], axis=0)
    return replace(recording, joints=replace(group, effort=np.clip(group.effort, low, high)))


def jumping(recording: Recording) -> Recording:
    """A clock that is set forward in the middle."""

    def change(t: np.ndarray) -> np.ndarray:
        middle = 0.5 * (t[0] + t[-1])
        return np.where(t > middle, t + 2.0, t)

    return times(change)(recording)


def late_efforts(by: float) -> Damage:
    """Efforts that lag behind the motion."""

    def change(group: JointGroup) -> np.ndarray:
        assert group.effort is not None
        step = round(by / float(np.median(np.diff(group.t))))
        return np.vstack([group.effort[step:0:-1], group.effort[: len(group.t) - step]])

    return joints(effort=change)


def swapped_columns(first: int, second: int) -> Damage:
    """Two angles written into each other's column."""

    def change(group: JointGroup) -> np.ndarray:
        order = list(range(len(group.names)))
        order[first], order[second] = second, first
        return group.position[:, order]

    return joints(position=change)


def moved_points(name: str, change: Callable[[np.ndarray], np.ndarray]) -> Damage:
    """Change positions of a group of points."""
    return points(name, lambda group: {"position": change(group.position)})


def exchanged(first: str, second: str) -> Damage:
    """Two points of one group under each other's name."""

    def damage(recording: Recording) -> Recording:
        made = []
        for group in recording.points:
            order = list(range(len(group.names)))
            if first in group.names and second in group.names:
                i, j = group.names.index(first), group.names.index(second)
                order[i], order[j] = j, i
            made.append(replace(group, position=group.position[:, order]))
        return replace(recording, points=tuple(made))

    return damage


def in_camera(recording: Recording) -> Recording:
    """Points in the frame of the camera that saw them."""
    made = []
    for group in recording.points:
        if group.camera_pose is not None:
            back = np.linalg.inv(group.camera_pose)
            group = replace(group, position=group.position @ back[:3, :3].T + back[:3, 3])
        made.append(group)
    return replace(recording, points=tuple(made))


def renamed(old: str, new: str) -> Damage:
    """A point under another name."""

    def damage(recording: Recording) -> Recording:
        made = [replace(g, names=tuple(new if n == old else n for n in g.names)) for g in recording.points]
        return replace(recording, points=tuple(made))

    return damage


def other_arm(recording: Recording) -> Recording:
    """The right arm's recording under the left arm's names."""
    other = read_recording(resolve_recording_path("default:dual_arm_vision_held_out.h5"))
    group = other.joints
    assert group is not None
    columns = [i for i, name in enumerate(group.names) if name.startswith("right")]
    std = {key: value[columns] for key in ("effort_std", "effort_bias_std") if np.ndim(value := getattr(group, key))}
    made: dict[str, Any] = {name: values[:, columns] for name, values in group.values_by_channel.items()}
    names = tuple(group.names[i].replace("right", "left") for i in columns)
    own = recording.points[0]
    arm = other.points[0]
    column = arm.names.index("w_T3")
    seen = replace(own, t=arm.t, position=arm.position[:, [column]], std=np.full((len(arm.t), 1, 3), 1e-3))
    return replace(recording, joints=replace(group, names=names, **made, **std), points=(seen,))


def as_is(recording: Recording) -> Recording:
    """Nothing is damaged."""
    return recording


def common(config: str, column: int, start: float) -> Iterator[Case]:
    """What can be wrong with the joints of any robot."""
    gap = (
        (lambda t: (t < 0.4 * t[-1]) | (t > 0.4 * t[-1] + 2.0))
        if config != "panda_beam"
        else (lambda t: (t < 4.0) | (t > 6.0))
    )
    yield Case("effort x 0.1", config, scaled("effort", 0.1), ("effort_gain",))
    yield Case("effort in N mm", config, scaled("effort", 1e3), ("effort_gain", "effort_limits"))
    yield Case("effort flipped", config, scaled("effort", -1.0), ("effort_sign",))
    yield Case("effort zero", config, scaled("effort", 0.0), ("effort_zero",))
    yield Case("effort of one joint flipped", config, scaled("effort", -1.0, 3), ("effort_sign",))
    yield Case("10 x fast", config, times(lambda t: t / 10), ("time_scale",))
    yield Case("stuck encoder", config, stuck(column, start), ("stuck",))
    yield Case("gap of 2 s", config, kept(gap), ("gap",))
    wrists = scaled("position", 20.0, 4, 5, 6)
    said = "an angle has the wrong scale"
    yield Case("wrist angles x 20", config, wrists, ("angle_scale", "angle_limits"), refused=said)
    yield Case("degrees", config, scaled("position", 57.29578), ("degrees",), refused="degrees")
    yield Case("clock in ms", config, times(lambda t: 1e3 * t), ("time_unit", "time_scale"), refused="seconds")
    yield Case("clock in ns", config, times(lambda t: 1e9 * t), ("time_unit",), refused="seconds")
    yield Case("same data twice", config, as_is, ("same_data",), "twice")
    yield Case("same data held out", config, as_is, ("same_data",), "both", refused="both estimated on and held out")
    yield Case("saturated effort", config, clipped, ("saturated",))
    yield Case("clock jumps", config, jumping, ("clock_jump", "gap"))
    yield Case("two angles exchanged", config, swapped_columns(1, 3), ("swapped_joints", "angle_limits", "angle_scale"))


def cases() -> list[Case]:
    """All of them."""
    y, two = "single_arm_vision", "dual_arm_vision"
    mirror, back = np.array([1.0, -1.0, 1.0]), np.array([-1.0, -1.0, -1.0])
    half = np.random.default_rng(5)
    found = [*common(y, 2, 2.0), *common("baxter_arm", 5, 20.0), *common("panda_beam", 3, 0.5)]
    found += [
        Case("constant", y, constant, ("stuck",)),
        Case("50 % dropped", y, kept(lambda t: half.random(len(t)) > 0.5), ("dropped_samples",)),
        Case("points' clocks + 3 s", y, times(lambda t: t + 3, "points_arm", "points_camera"), ("clock_offset",)),
        Case("camera's clock + 3 s", y, times(lambda t: t + 3, "points_camera"), ("clock_offset",)),
        Case("arm's points 0.3 s late", y, times(lambda t: t + 0.3, "points_arm"), ("clock_offset",)),
        Case("arm's points 20 ms late", y, times(lambda t: t + 0.02, "points_arm"), ("clock_offset",)),
        Case("arm's points 1 % fast", y, times(lambda t: 1.01 * t, "points_arm"), ("clock_drift",)),
        Case("arm's points 5 % slow", two, times(lambda t: 0.95 * t, "points_arm"), ("clock_drift",)),
        Case("noise of efforts stated 10 x", y, joints(effort_std=lambda g: 10 * g.effort_std), ("noise_overstated",)),
        Case("noise of points stated 10 x", two, points("points_arm", tenfold), ("noise_overstated",)),
        Case("a wrist that does not turn", "baxter_arm", held_still(6), ("weak_excitation",)),
        Case("joints since 1970", y, times(lambda t: t + 1.7e9, "joints"), ("clock_base",), refused="1970"),
        Case("camera inverted", y, moved_points("points_camera", lambda p: back * p), ("point_mirrored",)),
        Case("camera mirrored", y, moved_points("points_camera", lambda p: mirror * p), ("point_mirrored",)),
        Case("camera 10 x too large", y, moved_points("points_camera", lambda p: 10 * p), ("point_scale",)),
        Case("camera in feet", y, moved_points("points_camera", lambda p: p / 0.3048), ("point_scale",)),
        Case("points in the camera's frame", y, in_camera, ("point_frame", "point_reach")),
        Case("arm's points mirrored", y, moved_points("points_arm", lambda p: mirror * p), ("point_mirrored",)),
        Case(
            "arm's points in another frame",
            y,
            moved_points("points_arm", lambda p: p + np.array([0.1, 0.2, 0.0])),
            ("point_frame",),
        ),
        Case("two of the object's points exchanged", y, exchanged("w_T1", "w_T3"), ("point_swapped", "point_reach")),
        Case(
            "encoder + 0.05 rad",
            y,
            joints(position=lambda g: g.position + 0.05 * (np.arange(7) == 1)),
            ("encoder_offset",),
        ),
        Case(
            "encoder of the elbow + 0.05 rad",
            y,
            joints(position=lambda g: g.position + 0.05 * (np.arange(7) == 3)),
            ("encoder_offset",),
        ),
        Case("quantised angles", y, joints(position=lambda g: 0.01 * np.rint(g.position / 0.01)), ("quantised",)),
        Case("quantised efforts", y, joints(effort=lambda g: 2.0 * np.rint(g.effort / 2.0)), ("quantised",)),
        Case("noise 10 x that stated", y, noisy(10.0), ("noise",)),
        Case("efforts 0.3 s late", y, late_efforts(0.3), ("effort_lag",)),
        Case(
            "effort of the last wrist joint + 5 N m",
            y,
            joints(effort=lambda g: g.effort + 5.0 * (np.arange(7) == 6)),
            ("effort_offset",),
        ),
        Case(
            "effort of the shoulder + 15 N m",
            y,
            joints(effort=lambda g: g.effort + 15.0 * (np.arange(7) == 0)),
            (),  # what an arm holds may do so as well; the fit has to be distrusted
        ),
        Case(
            "another arm held out",
            y,
            other_arm,
            ("encoder_offset", "point_unlike", "point_frame", "effort_unlike", "angle_limits"),
            "held_out",
            refused="cannot be closed",
        ),
        Case(
            "a point renamed",
            y,
            renamed("w_T1", "w_T11"),
            (),
            settings=("sensors.points_camera.used_points=[w_T1, w_T3]",),
            refused="w_T1",
        ),
        Case(
            "a link renamed",
            y,
            as_is,
            (),
            settings=("sensors.points_camera.frame_by_recorded_name={w_T1: w_Tl}",),
            refused="w_Tl",
        ),
        Case("grippers exchanged", two, exchanged("w_T2", "w_T3"), ("point_swapped",)),
        Case("efforts of one arm flipped", two, scaled("effort", -1.0, *range(7, 14)), ("effort_sign",)),
        Case("efforts flipped", two, scaled("effort", -1.0), ("effort_sign",)),
        Case("camera inverted", two, moved_points("points_camera", lambda p: back * p), ("point_mirrored",)),
        Case(
            "encoder + 0.05 rad",
            two,
            joints(position=lambda g: g.position + 0.05 * (np.arange(14) == 8)),
            ("encoder_offset",),
        ),
        Case(
            "another robot held out",
            "baxter_arm",
            lambda r: read_recording(_real("panda_beam")),
            (),
            "held_out",
            refused="not recorded",
        ),
        Case("noise 10 x that stated", "baxter_arm", noisy(20.0), ("noise",)),
        Case("effort of a wrist x 10", "panda_beam", scaled("effort", 10.0, 5), ("effort_gain", "effort_limits")),
    ]
    cable = "deft_bdlo1"
    flip = np.array([1.0, 1.0, -1.0])
    found += [
        Case("10 x too large", cable, moved_points("points", lambda p: 10 * p), ("point_scale",)),
        Case("10 x too small", cable, moved_points("points", lambda p: p / 10), ("point_scale",)),
        Case("in mm", cable, moved_points("points", lambda p: 1e3 * p), ("point_scale",), refused="millimetres"),
        Case("upside down", cable, moved_points("points", lambda p: flip * p), ("point_mirrored",)),
        Case("two points exchanged", cable, exchanged("p5", "b2"), ("point_swapped",)),
        Case("a marker stuck", cable, stuck_point, ("stuck",)),
        Case("gap of 2 s", cable, kept(lambda t: (t < 2.0) | (t > 4.0)), ("gap",)),
        Case("clock in ns", cable, times(lambda t: 1e9 * t), ("time_unit",), refused="seconds"),
        Case("same data twice", cable, as_is, ("same_data",), "twice"),
    ]
    return found


# -- the run ----------------------------------------------------------------------------------------------------------

_FOLDER = DEFAULT_REAL


def _real(config: str) -> Path:
    return _FOLDER / REAL[config]


def clean_recording(case: Case) -> Path | None:
    """The recording that a case damages, None where it is not here."""
    if case.config in REAL:
        return _real(case.config) if _real(case.config).is_file() else None
    return Path(resolve_recording_path(f"default:{case.config}_estimate.h5"))


def prepared(case: Case, folder: Path) -> RunSettings:
    """The settings of a case; its recordings are written into the folder."""
    clean = clean_recording(case)
    assert clean is not None
    made = replace(case.damage(read_recording(clean)), name="damaged")
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "damaged.h5"
    write_recording(made, path)
    files = {
        "estimate": ([path], []),
        "held_out": ([clean], [path]),
        "twice": ([clean, path], []),
        "both": ([clean], [path]),
    }[case.role]
    chosen = [
        f"recordings.{key}=[{', '.join(map(str, own))}]"
        for key, own in zip(("estimate", "held_out"), files, strict=True)
    ]
    if case.config == "deft_bdlo1":
        chosen.append(f"model.object.undeformed_shape_file={_FOLDER / 'deft' / 'bdlo1_undeformed.csv'}")
    return load_config(CONFIGS / f"{case.config}.yaml", [*chosen, *case.settings])


def tried(case: Case, folder: Path, solving: bool = True, step: Step | None = None) -> dict[str, Any]:
    """What becomes of a case, on a step built before where one is given: how it ended, causes, parameters found."""
    begun = time.perf_counter()
    try:
        run = prepared(case, folder)
        problem = build_problem(run, step)
    except (DataError, YidError) as error:
        named = bool(case.refused) and case.refused in str(error)
        return {"outcome": "refused", "named": named, "causes": [], "found": [], "error": str(error)}
    doubts = problem.options.data_issues
    causes = sorted({doubt.cause for doubt in doubts})
    found: list[str] = []
    wrong: list[str] = []
    if solving and problem.options.has_no_data_issue_above_warning:
        outcome = fit_problem(problem, run.solver, limits=run.diagnosis.fit_excess_residual_criteria)
        verdicts = {name: entry for name, entry in outcome.parameters.items() if entry.verdict == "identifiable"}
        found = list(verdicts)
        truth = problem.episodes[0].recording.true_parameters
        wrong = [n for n, e in verdicts.items() if n in truth and abs(e.value - truth[n]) > 3 * e.std]
    return {
        "outcome": "doubted" if doubts else "believed",
        "named": bool(set(causes) & set(case.causes)),
        "causes": causes,
        "harmless": problem.options.has_no_data_issue_above_warning and bool(doubts),
        "found": found,
        "wrong": wrong,
        "issues": [f"{doubt.location_text}: {doubt.what}" for doubt in doubts],
        "seconds": time.perf_counter() - begun,
    }


def table(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """One line a case, then the sums."""
    lines = ["| case | configuration | outcome | causes | found |", "| --- | --- | --- | --- | --- |"]
    for entry in entries:
        said = "named" if entry["named"] else "NOT NAMED"
        lines.append(
            f"| {entry['case']} | {entry['config']} | {entry['outcome']}, {said} | {', '.join(entry['causes'])} | "
            f"{', '.join(entry['found'])} |"
        )
    named = sum(entry["named"] for entry in entries)
    # what was left out of a recording does no harm to the rest, as far as the truth is known
    wrong = sum(bool(entry["found"] if not entry.get("harmless") else entry.get("wrong")) for entry in entries)
    total = max(len(entries), 1)
    return [
        *lines,
        "",
        f"{named} of {len(entries)} named ({100 * named / total:.0f} %), {wrong} with a parameter found",
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is not finished and print the table."""
    global _FOLDER
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", default="runs/nonsense")
    parser.add_argument("--only", default="", help="cases whose name or configuration holds this text")
    parser.add_argument("--real", default=str(DEFAULT_REAL), help="folder of real recordings")
    parser.add_argument("--no-solve", action="store_true", help="name causes only")
    chosen = parser.parse_args(arguments)
    _FOLDER = Path(chosen.real)
    folder = Path(chosen.folder)
    folder.mkdir(parents=True, exist_ok=True)
    kept_file = folder / "cases.jsonl"
    done = [json.loads(line) for line in kept_file.read_text().splitlines()] if kept_file.is_file() else []
    known = {(entry["case"], entry["config"]) for entry in done}
    for case in cases():
        wanted = chosen.only in case.name or chosen.only in case.config
        if not wanted or (case.name, case.config) in known or clean_recording(case) is None:
            continue
        entry = {"case": case.name, "config": case.config, **tried(case, folder / "work", not chosen.no_solve)}
        done.append(entry)
        with kept_file.open("a") as file:
            file.write(json.dumps(entry) + "\n")
        print(
            f"{case.config}, {case.name}: {entry['outcome']}, {'named' if entry['named'] else 'NOT NAMED'}", flush=True
        )
    print("\n".join(table(done)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
