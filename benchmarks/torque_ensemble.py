"""What errors of the torques do to the paper's own method: an ensemble beside each of its published values.

    python benchmarks/torque_ensemble.py --out FOLDER [EXPERIMENT ...] [--errors offsets both] [--members 8] [--jobs 2]
    python benchmarks/torque_ensemble.py --explain RUN_FOLDER_OF_COMPARE ...

The paper's four experiments in MuJoCo, rough as those of `make_recordings.py --torques rough`; only the errors of the
torques, and all other noise, are drawn anew for every member. Steepest descent with the paper's cost and step lengths
solves each. Where a published value lies within what members find, an error of the torques is enough to explain it;
where it does not, it is not. `torque_ensemble.json` beside this file is what `--errors none offsets --members 4`
leaves there, in four digits; of `none` the first member is enough. Recordings and solutions are kept in FOLDER as those
of `coverage.py` are.

`--explain` gives one sentence for each published value of the experiment that a run of `compare` is about, the first of
these that holds for its synthetic recordings: they do not determine the parameter, or so weakly that its interval
contains the value; the value is near the chosen truth; the published method was on its way to where it stops without
errors of the torques; constant errors of the torques lead it there; none of these.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from baxter import baxter_foam_y_system
from coverage import CONFIGS, PACKAGE, print_progress, solve_twin, working
from make_recordings import OFFSET, OFFSETS, ROUGH, TRUTH, WHITE, shaken_motion

from yid_ocp.analysis.compare import PAPER_ESTIMATES
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.errors import ModelError
from yid_ocp.files import json_sha256, write_strict_json
from yid_ocp.inference.uncertainty import MAX_IDENTIFIABLE_RELATIVE_STD, VERDICT_TABLE_TEXTS, interval_text
from yid_ocp.parallel import Task, WorkerConfig, run_tasks
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.version import sha256_of_folder_sources
from yid_ocp.virtual.experiment import PointCamera, VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles

ERRORS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "none": ((), ()),
    "white": (WHITE, ()),
    "offsets": ((), (0.3,) * 7),
    "both": (WHITE, OFFSET),
}
"""White noise and constant offset of one arm's torques, standard deviations [N m]; empty for none."""
METHOD = (
    "solver={name: steepest_descent, max_iterations: 200}",
    "problem.weighting=paper",
    "compare.reference_paper_experiment_name=null",
)


ENSEMBLE = Path(__file__).with_suffix(".json")
CHOSEN_FROM = "single_arm_vision"  # its published values, rounded, are the truth of the embedded recordings
START, ITERATIONS, OFFSET_STD = 3.0, 200, 0.3  # of the published method [N m/rad]; of the torques' offsets [N m]


def make_member(experiment: str, errors: Sequence[Sequence[float]], number: int, folder: str, code: str) -> str:
    """Record one member of an experiment's ensemble; returns its file."""
    arms, vision = (1 if experiment.startswith("single") else 2), not experiment.endswith("no_vision")
    system = baxter_foam_y_system(arms)
    posture = grasping_joint_angles(system, TRUTH, offsets=OFFSETS[arms])
    excitation = MultisineOptions(gripper_travel=ROUGH.travel[arms])
    motion = shaken_motion(system, TRUTH, posture, ROUGH.motion_seeds[arms, "estimate"], excitation, ROUGH.shake)
    torques = replace(ROUGH, white=tuple(errors[0]), offset=tuple(errors[1]))
    described = VirtualExperimentSettings(
        motion=motion,
        initial_joint_angles=posture,
        simulation=torques.simulation,
        arm_noise=torques.noise(arms),
        camera=PointCamera() if vision else None,
        seed=1000 + number,
        recording_name=f"{experiment}_{number:03d}",
    )
    recording = run_virtual_experiment(system, TRUTH, described)
    path = Path(folder) / f"{recording.name}_{json_sha256([[list(entry) for entry in errors], code])[:8]}.h5"
    write_recording(recording, path)
    return str(path)


def run(
    experiments: Sequence[str], kinds: Sequence[str], members: int, workers: WorkerConfig, out: Path
) -> dict[str, dict[str, Any]]:
    """What steepest descent finds: experiment, errors of the torques, parameter to the members' values."""
    recordings = out.resolve() / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    maker = sha256_of_folder_sources(PACKAGE / "virtual")
    keys = [(experiment, errors, k) for experiment in experiments for errors in kinds for k in range(members)]
    tasks = [
        Task(
            f"recording {k} of {experiment}, {errors}",
            {
                "experiment": experiment,
                "errors": [list(std) for std in ERRORS[errors]],
                "number": k,
                "folder": str(recordings),
                "code": maker,
            },
        )
        for experiment, errors, k in keys
    ]
    made = run_tasks(make_member, tasks, out / "made", workers, print_progress, maker)
    lost = [entry for entry in made if entry.error]
    if lost:
        raise ModelError(f"{lost[0].name} failed: {lost[0].error}", hint="choose another seed")
    tasks = [
        Task(
            f"solution {k} of {experiment}, {errors}",
            {
                "config": CONFIGS / f"{experiment}.yaml",
                "recording": Path(entry.value),
                "settings": list(METHOD),
            },
        )
        for (experiment, errors, k), entry in zip(keys, made, strict=True)
    ]
    solved = run_tasks(solve_twin, tasks, out / "solved", workers, print_progress)
    found: dict[str, dict[str, Any]] = {}
    for (experiment, errors, _), entry in zip(keys, solved, strict=True):
        values = found.setdefault(experiment, {}).setdefault(errors, {name: [] for name in TRUTH})
        if entry.value is not None and entry.value["status"] != "failed":
            for name in TRUTH:
                values[name].append(entry.value["parameters"][name]["value"])
    return found


def report(found: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """For each experiment the truth, the published value and the range that each kind of error gives."""
    lines: list[str] = []
    for experiment, by_errors in found.items():
        rows: list[Sequence[str]] = [(experiment, "truth", "published", *by_errors)]
        for name, truth in TRUTH.items():
            published = PAPER_ESTIMATES[experiment][name]
            cells = [_range(entry[name], published) for entry in by_errors.values()]
            rows.append((name, f"{truth:g}", f"{published:g}", *cells))
        lines += [*aligned_table_lines(rows), ""]
    return [*lines, "smallest .. median .. largest value; * holds the published one"]


def _range(values: Sequence[float], published: float) -> str:
    if not values:
        return "-"
    low, middle, high = np.quantile(values, [0.0, 0.5, 1.0])
    return f"{low:.3g} .. {middle:.3g} .. {high:.3g}{'*' if is_within_range(published, values) else ''}"


def explain(result: Mapping[str, Any]) -> list[str]:
    """One sentence for each published value of the experiment that a result of `compare` is about."""
    experiment = next(name for name, values in PAPER_ESTIMATES.items() if values == result["published"])
    judged = {name: own for name, own in result["judged"]["parameters"].items() if own["free"] and name in TRUTH}
    if any(own["verdict"] == "not_trusted" for own in judged.values()):
        return []
    ensemble = json.loads(ENSEMBLE.read_text(encoding="utf-8"))[experiment]
    found = []
    for name, own in judged.items():
        published, truth = PAPER_ESTIMATES[experiment][name], result["truth"].get(name)
        said = _reason(experiment, published, own, truth, ensemble["none"][name][0], ensemble["offsets"][name])
        found.append(f"{name} = {published:.4g} of Caldwell et al.: {said}")
    return found


def _reason(
    experiment: str,
    published: float,
    own: Mapping[str, Any],
    truth: float | None,
    stopped: float,
    offsets: Sequence[float],
) -> str:
    interval = None if own["verdict"] != "weak" or own["interval"] in (None, [None, None]) else own["interval"]
    if own["interval"] is not None:
        lower, upper = own["interval"]
    elif own["std"] is not None:
        lower, upper = own["value"] - 2 * own["std"], own["value"] + 2 * own["std"]
    else:
        lower = upper = None
    holds = (lower is None or lower <= published) and (upper is None or published <= upper)
    if own["verdict"] == "not_identifiable" or (own["verdict"] != "identifiable" and holds):
        known = f"its verdict in such an experiment is '{VERDICT_TABLE_TEXTS[own['verdict']]}'"
        if interval is not None:
            return f"hardly informed; {known}, {interval_text(*interval)}, where the value lies"
        return f"not informed; {known}"
    if truth is not None and _near(published, truth):
        chosen = experiment == CHOSEN_FROM and abs(published - truth) <= 0.02 * abs(truth)
        return f"near the truth of these recordings, {truth:.4g}" + (", which was chosen from it" if chosen else "")
    low, high = sorted((START, stopped))
    if truth is not None and not _near(stopped, truth) and (low <= published <= high or _near(published, stopped)):
        goes = f"goes from {START:.3g} to {stopped:.3g} in {ITERATIONS} iterations"
        return f"slow; without torque errors the published method {goes}"
    many = f"{min(offsets):.3g} to {max(offsets):.3g} in {len(offsets)} synthetic recordings"
    led = f"constant torque errors of {OFFSET_STD:g} N m lead the published method to {many}"
    if is_within_range(published, offsets):
        return f"torque error; {led}"
    open_interval = "inform it" if interval is None else f"leave {interval_text(*interval)} open and not this"
    return f"unexplained; such recordings {open_interval}, it is not slow, and {led}"


def is_within_range(published: float, values: Sequence[float]) -> bool:
    """Whether a published value lies among an ensemble's, with a margin for a bound at zero."""
    return min(values) - 0.01 * max(values) <= published <= max(values)


def _near(value: float, truth: float) -> bool:
    return abs(value - truth) <= MAX_IDENTIFIABLE_RELATIVE_STD * abs(truth)


def main() -> None:
    parser = argparse.ArgumentParser(description="What errors of the torques do to the paper's own method.")
    parser.add_argument(
        "experiments", nargs="*", metavar="EXPERIMENT", help=f"of {', '.join(PAPER_ESTIMATES)}; all if absent"
    )
    parser.add_argument("--errors", nargs="+", choices=list(ERRORS), default=list(ERRORS), help="of the torques")
    parser.add_argument("--members", type=int, default=8, help="of each ensemble")
    working(parser)
    parser.add_argument("--out", type=Path, help="folder of recordings and solutions")
    parser.add_argument("--explain", nargs="+", type=Path, help="run folders of `compare`, instead of an ensemble")
    chosen = parser.parse_args()
    for folder in chosen.explain or ():
        print("\n".join(explain(json.loads((folder / "result.json").read_text(encoding="utf-8")))))
    if chosen.explain:
        return
    if chosen.out is None:
        parser.error("the following arguments are required: --out")
    unknown = sorted(set(chosen.experiments) - set(PAPER_ESTIMATES))
    if unknown:
        parser.error(f"there is no experiment '{unknown[0]}'; choose from {', '.join(PAPER_ESTIMATES)}")
    experiments = [name for name in PAPER_ESTIMATES if name in chosen.experiments or not chosen.experiments]
    found = run(experiments, chosen.errors, chosen.members, WorkerConfig(chosen.workers, chosen.scheduler), chosen.out)
    write_strict_json(chosen.out / "torque_ensemble.json", found)
    print("\n".join(report(found)))


if __name__ == "__main__":
    main()
