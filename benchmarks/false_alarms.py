"""What `diagnose` says of MuJoCo twins whose torques are wrong as stated: false alarms, and effects that it misses.

    python benchmarks/false_alarms.py --out FOLDER [KIND ...] [--twins 15] [--candidates all] [--workers 2]
                                      [--record-only]

A kind is an experiment of `coverage.py` with white noise and constant offsets of the torques, both stated, and nothing
else that the model does not know (clean kinds), or with one effect in MuJoCo's own terms (the others). Every twin has a
truth of its own and two motions, one to estimate on and one held out. Clean twins have to be `no_gap`, three of sixty
excepted; in the others the effect has to be named. Recordings and findings are kept in FOLDER as those of `coverage.py`
are.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from baxter import baxter_foam_y_system
from coverage import (
    CONFIGS,
    DURATION,
    INNER_STEP,
    PACKAGE,
    SPREAD,
    Cell,
    asked_for,
    command,
    gentle_enough,
    print_progress,
)
from make_recordings import OFFSETS, TRUTH

from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.files import json_sha256, to_json_types, write_strict_json
from yid_ocp.parallel import Task, TaskResult, WorkerConfig, run_tasks
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.version import sha256_of_folder_sources
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperimentSettings
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.joint_motion import grasping_joint_angles
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.diagnose import run_diagnose

ALARMS = 0.05  # part of clean twins in which a gap may be found
FOUND = 0.9  # part of the others in which the effect has to be named


@dataclass(frozen=True)
class Kind:
    """An experiment, and what the model does not know of it."""

    cell: Cell
    effects: tuple[InjectedEffect, ...] = ()

    @property
    def recipe(self) -> dict[str, Any]:
        """What the recordings depend on, as plain data."""
        return {**self.cell.recipe, "effects": [asdict(effect) for effect in self.effects]}


ONE = Cell(arms=1, effort=0.1, effort_bias=0.3)
TWO = replace(ONE, arms=2)
KINDS: Mapping[str, Kind] = {
    "one_arm": Kind(ONE),
    "two_arms": Kind(TWO),
    "one_arm_encoders": Kind(replace(ONE, sees=("points_camera",))),
    "two_arms_encoders": Kind(replace(TWO, sees=("points_camera",))),
    "damped_trunk": Kind(ONE, (InjectedEffect("kelvin_voigt", "T1", {"tau": 0.05}),)),
    "heavy_link": Kind(ONE, (InjectedEffect("link_mass", "left_w1", {"scale": 1.5}),)),
    "offset_beyond": Kind(ONE, (InjectedEffect("effort_offset", "left_e1", {"offset": 1.5}),)),
}
CLEAN = tuple(name for name, kind in KINDS.items() if not kind.effects)


# -- recordings -------------------------------------------------------------------------------------------------------


def make_pair(name: str, recipe: Mapping[str, Any], number: int, folder: str, code: str) -> list[str]:
    """Record a twin twice, with two motions; returns the files."""
    kind = KINDS[name]
    cell = kind.cell
    assert json.loads(json.dumps(kind.recipe)) == json.loads(json.dumps(recipe))
    rng = np.random.default_rng([zlib.crc32(name.encode()), number])
    truth = {tube: value * math.exp(rng.uniform(-SPREAD, SPREAD)) for tube, value in TRUTH.items()}
    system = baxter_foam_y_system(cell.arms)
    posture = grasping_joint_angles(system, truth, offsets={} if cell.undeformed else OFFSETS[cell.arms])
    simulation = SimulationOptions(
        DURATION, time_step=INNER_STEP, controller_rate=cell.controller_rate, effort_kind=cell.effort_kind
    )
    files = []
    for purpose in ("estimate", "held_out"):
        noise_seed = int(rng.integers(2**31))
        motion, motion_seed = gentle_enough(system, truth, posture, simulation, cell.undeformed, rng)
        experiment = VirtualExperimentSettings(
            motion=motion,
            initial_joint_angles=posture,
            simulation=simulation,
            arm_noise=ArmSensorNoise(
                effort_std=cell.effort, effort_bias_std=cell.effort_bias, records_effort_std=cell.stated
            ),
            seed=noise_seed,
            recording_name=f"{name}_{number:03d}_{purpose}",
            description=f"Twin {number} of {name} (motion seed {motion_seed}).",
        )
        recording = run_experiment_with_injected_effects(system, truth, kind.effects, experiment)
        recording = replace(recording, points=tuple(group for group in recording.points if group.name in cell.sees))
        path = Path(folder) / f"{recording.name}_{json_sha256([recipe, code])[:8]}.h5"
        write_recording(recording, path)
        files.append(str(path))
    return files


# -- diagnoses --------------------------------------------------------------------------------------------------------


def diagnose_twin(config: Path, estimate: Path, held_out: Path, settings: Sequence[str]) -> dict[str, Any]:
    """What the command `diagnose` says of a twin."""
    given = [
        f"recordings.{key}=[{json.dumps(str(path))}]" for key, path in zip(USES, (estimate, held_out), strict=True)
    ]
    with tempfile.TemporaryDirectory() as folder:
        made = load_config(config, [*given, "output.write_report=false", *settings], SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME)
        finding = run_diagnose(made, Path(folder) / "run").output
    detectable = {
        f"{entry.effect.label}.{name}": value
        for entry in finding.screening.detectability
        for name, value in entry.detectable_amplitudes.items()
    }
    told = {
        "verdict": finding.verdict,
        "chi2_per_dof": finding.nominal_test.chi2_per_dof,
        "held_out_chi2_per_dof": finding.nominal_held_out_test.chi2_per_dof,
        "p_value": finding.nominal_test.p_value,
        "held_out_p_value": finding.nominal_held_out_test.p_value,
        "best": [[score.effect.label, score.p_value] for score in finding.screening.candidate_scores[:3]],
        "candidates": len(finding.screening.candidate_scores),
        "named": [effect.label for effect in finding.accepted_effects],
        "rivals": [[rival.label for rival in added.equivalent_effects] for added in finding.selected_effects],
        "values": {
            name: finding.final_model.values[name] for e in finding.accepted_effects for name in e.parameters.names
        },
        "detectable": detectable,
        "seconds": sum(finding.stage_seconds.values()),
    }
    found: dict[str, Any] = to_json_types(told)  # what cannot be seen has no detectable size
    return found


USES = ("estimate", "held_out")


# -- scores -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Twin:
    """What became of a twin: `error` where it could not be recorded or diagnosed, else what `diagnose_twin` says."""

    found: Mapping[str, Any] = field(default_factory=dict)
    error: str = ""

    def right(self, kind: Kind) -> bool:
        """Whether nothing is found in a clean twin, and the effect, or a set that it is in, in another one."""
        if self.error:
            return False
        if not kind.effects:
            return self.found["verdict"] == "no_gap"
        names = {*self.found["named"], *(label for rivals in self.found["rivals"] for label in rivals)}
        return {effect.label for effect in kind.effects} <= names


def shortcomings(twins: Mapping[str, Sequence[Twin]]) -> list[str]:
    """What is not as it should be, a sentence each."""
    lines = []
    clean = [(name, twin) for name, entries in twins.items() if name in CLEAN for twin in entries]
    alarms = sum(not twin.right(KINDS[name]) for name, twin in clean)
    if alarms > ALARMS * len(clean):
        lines.append(f"{alarms} of {len(clean)} clean twins are not called so")
    for name, entries in twins.items():
        named = sum(twin.right(KINDS[name]) for twin in entries)
        if name not in CLEAN and named < FOUND * len(entries):
            lines.append(f"{name}: the effect is named in {named} of {len(entries)} twins")
    return lines


def report(twins: Mapping[str, Sequence[Twin]]) -> list[str]:
    """Lines for a person: a row for each kind, every wrong answer, and what is not as it should be."""
    rows: list[Sequence[str]] = [("kind", "twins", "right", "chi2/n", "held out", "time [s]")]
    lines = []
    for name, entries in twins.items():
        done = [twin.found for twin in entries if not twin.error]
        right = sum(twin.right(KINDS[name]) for twin in entries)
        medians = [
            f"{np.median([found[key] for found in done]):.3g}" if done else "-"
            for key in ("chi2_per_dof", "held_out_chi2_per_dof", "seconds")
        ]
        rows.append((name, str(len(entries)), str(right), *medians))
        for number, twin in enumerate(entries):
            if not twin.right(KINDS[name]):
                lines.append(f"{name} {number}: {twin.error or _said(twin.found)}")
    return [*aligned_table_lines(rows), "", *lines, *shortcomings(twins)]


def _said(found: Mapping[str, Any]) -> str:
    best = ", ".join(f"{label} (p = {p:.1e})" for label, p in found["best"])
    return (
        f"{found['verdict']} {', '.join(found['named'])}; chi2/n {found['chi2_per_dof']:.3f} "
        f"(p = {found['p_value']:.1e}), held out {found['held_out_chi2_per_dof']:.3f} "
        f"(p = {found['held_out_p_value']:.1e}); best candidates {best}"
    )


# -- the run ----------------------------------------------------------------------------------------------------------


def record(names: Sequence[str], number: int, workers: WorkerConfig, out: Path) -> dict[str, list[TaskResult]]:
    """Record so many twins of some kinds; what stands in the folder is not done again."""
    recordings = out.resolve() / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    code = sha256_of_folder_sources(PACKAGE / "virtual")
    tasks = [
        Task(
            f"recordings {k} of {name}",
            {"name": name, "recipe": KINDS[name].recipe, "number": k, "folder": str(recordings), "code": code},
        )
        for k in range(number)
        for name in names
    ]
    made = run_tasks(make_pair, tasks, out / "made", workers, print_progress, code)
    return {name: made[i :: len(names)] for i, name in enumerate(names)}


def diagnosed(
    made: Mapping[str, Sequence[TaskResult]], candidates: str, workers: WorkerConfig, out: Path
) -> dict[str, list[Twin]]:
    """Diagnose the twins that were recorded; what stands in the folder is not done again."""
    whole = [(name, k) for k in range(max(map(len, made.values()))) for name in made if not made[name][k].error]
    tasks = [
        Task(
            f"diagnosis {k} of {name}",
            {
                "config": CONFIGS / KINDS[name].cell.config.name,
                **{use: Path(path) for use, path in zip(USES, made[name][k].value, strict=True)},
                "settings": [f"diagnosis.candidates={candidates}", *KINDS[name].cell.settings],
            },
        )
        for name, k in whole
    ]
    results = dict(zip(whole, run_tasks(diagnose_twin, tasks, out / "found", workers, print_progress), strict=True))
    return {
        name: [
            Twin(error=entry.error) if entry.error else Twin(results[name, k].value or {}, results[name, k].error)
            for k, entry in enumerate(entries)
        ]
        for name, entries in made.items()
    }


def main(arguments: Sequence[str] | None = None) -> int:
    parser = command("Whether `diagnose` finds what is not there, and misses what is.", "kind", KINDS, 15)
    parser.add_argument("--candidates", default="all", help="`all`, or a list such as [kelvin_voigt, effort_offset]")
    chosen = parser.parse_args(arguments)
    names = asked_for(parser, chosen.names, KINDS, "kind")
    workers = WorkerConfig(chosen.workers, chosen.scheduler)
    made = record(names, chosen.twins, workers, chosen.out)
    if chosen.record_only:
        return 1 if any(entry.error for entries in made.values() for entry in entries) else 0
    twins = diagnosed(made, chosen.candidates, workers, chosen.out)
    findings = {name: [asdict(twin) for twin in entries] for name, entries in twins.items()}
    write_strict_json(chosen.out / "false_alarms.json", findings)
    print("\n".join(report(twins)))
    return 1 if shortcomings(twins) else 0


if __name__ == "__main__":
    sys.exit(main())
