"""What errors of the torques do to the paper's own method: an ensemble beside each of its published values.

    python benchmarks/torque_ensemble.py --out FOLDER [EXPERIMENT ...] [--errors offsets both] [--members 8] [--jobs 2]

The paper's four experiments in MuJoCo, rough as those of `make_recordings.py --torques rough`; only the errors of the
torques, and all other noise, are drawn anew for every member. Steepest descent with the paper's cost and step lengths
solves each. Where a published value lies within what members find, an error of the torques is enough to explain it;
where it does not, it is not. The package's `data/defaults/torque_ensemble.json` is what `--errors none offsets
--members 4` leaves there, in four digits; of `none` the first member is enough. Recordings and solutions are kept in
FOLDER as those of `coverage.py` are.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from coverage import CONFIGS, PACKAGE, print_progress, solve_twin, working
from make_recordings import OFFSET, OFFSETS, ROUGH, TRUTH, WHITE

from yid_ocp.analysis.compare import PAPER_ESTIMATES, is_within_ensemble_range
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.errors import ModelError
from yid_ocp.files import json_sha256, write_strict_json
from yid_ocp.parallel import Task, WorkerConfig, run_tasks
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.version import folder_source_hash
from yid_ocp.virtual.experiment import (
    PointCamera,
    VirtualExperimentSettings,
    baxter_foam_y_system,
    run_virtual_experiment,
)
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion

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


def make_member(experiment: str, errors: Sequence[Sequence[float]], number: int, folder: str, code: str) -> str:
    """Record one member of an experiment's ensemble; returns its file."""
    arms, vision = (1 if experiment.startswith("single") else 2), not experiment.endswith("no_vision")
    system = baxter_foam_y_system(arms)
    posture = grasping_joint_angles(system, TRUTH, offsets=OFFSETS[arms])
    excitation = MultisineOptions(gripper_travel=ROUGH.travel[arms], shake_torque_rms=ROUGH.shake)
    motion = random_multisine_motion(
        system, TRUTH, seed=ROUGH.motion_seeds[arms, "estimate"], initial_joint_angles=posture, excitation=excitation
    )
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
    maker = folder_source_hash(PACKAGE / "virtual")
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
        raise ModelError(f"{lost[0].name} failed: {lost[0].error}")
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
    return f"{low:.3g} .. {middle:.3g} .. {high:.3g}{'*' if is_within_ensemble_range(published, values) else ''}"


def main() -> None:
    parser = argparse.ArgumentParser(description="What errors of the torques do to the paper's own method.")
    parser.add_argument(
        "experiments", nargs="*", metavar="EXPERIMENT", help=f"of {', '.join(PAPER_ESTIMATES)}; all if absent"
    )
    parser.add_argument("--errors", nargs="+", choices=list(ERRORS), default=list(ERRORS), help="of the torques")
    parser.add_argument("--members", type=int, default=8, help="of each ensemble")
    working(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder of recordings and solutions")
    chosen = parser.parse_args()
    unknown = sorted(set(chosen.experiments) - set(PAPER_ESTIMATES))
    if unknown:
        parser.error(f"there is no experiment '{unknown[0]}'; choose from {', '.join(PAPER_ESTIMATES)}")
    experiments = [name for name in PAPER_ESTIMATES if name in chosen.experiments or not chosen.experiments]
    found = run(experiments, chosen.errors, chosen.members, WorkerConfig(chosen.workers, chosen.scheduler), chosen.out)
    write_strict_json(chosen.out / "torque_ensemble.json", found)
    print("\n".join(report(found)))


if __name__ == "__main__":
    main()
