"""Whether the standard deviations of `solve` are true: cells of MuJoCo twins whose truth is known.

    python benchmarks/coverage.py --out FOLDER [CELL ...] [--twins 40] [--first 0] [--workers 2] [--record-only]

A cell is a kind of experiment: arms, noise of the torques, controller, start, sensors, time step. Each of its twins
has a motion, noise and stiffnesses of its own, drawn around those of the embedded recordings, and is solved as a user
would, with the shipped configurations. Motions shake the arms so that torques are as rough as those of a real Baxter
(second differences of 0.03 to 0.3 N m from one sample of 10 ms to the next), stay within its limits, and do not let the
Y snap.

Recordings and solutions are kept in FOLDER by the hash of what they depend on: recordings by the cell, the twin's
number and `yid_ocp/virtual`, solutions by the recording, the configuration and the whole package. A run that was
interrupted goes on, and a change of the estimator solves again without recording again.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats
from baxter import baxter_foam_y_system
from make_recordings import OFFSETS, SNAP, TRUTH, shaken_motion, within_limits

import yid_ocp
from yid_ocp.config.reader import load_config
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.errors import ModelError
from yid_ocp.files import json_sha256, write_strict_json
from yid_ocp.model.system import System
from yid_ocp.parallel import Task, TaskResult, WorkerConfig, run_tasks
from yid_ocp.report.terminal import aligned_table_lines, summary_blocks, summary_terminal_lines
from yid_ocp.sensors.base import EffortSamplingKind
from yid_ocp.version import sha256_of_folder_sources
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.joint_motion import (
    MultisineMotion,
    MultisineOptions,
    grasping_joint_angles,
)
from yid_ocp.virtual.mujoco_simulation import SimulationOptions, simulate_in_mujoco
from yid_ocp.workflow.solve import run_solve

PACKAGE = Path(yid_ocp.__file__).parent
CONFIGS = Path(__file__).resolve().parents[1] / "configs"

DURATION = 5.0  # [s]
INNER_STEP = 5e-5  # [s]
TRIAL_STEP = 2.5e-4  # of the run that shows whether a motion will do [s]
TRAVEL = {False: 0.11, True: 0.08}  # by whether the Y starts undeformed, where two arms soon bring it to snap [m]
SHAKE = 0.6  # gives second differences as large as a real arm's without any noise [N m]
SPREAD = 0.25  # of the logarithm of the true stiffnesses, either way
ATTEMPTS = 50

JUDGED = ("identifiable", "weak")
RMS, COVERED, LEAST, BAND = (0.9, 1.1), (0.92, 0.97), 400, 0.999
SILENT = 0.95  # fraction of twins with errors that nobody states in which nothing may be called found
NORMAL_95 = float(scipy.stats.norm.ppf(0.975))


@dataclass(frozen=True)
class Cell:
    """One kind of twins.

    Attributes
    ----------
    arms : int
    effort, effort_bias : float
        Standard deviations of the torques' noise, white and constant [N m].
    stated : bool
        Whether the recordings say so.
    controller_rate : float
        [Hz]; recorded are 100.
    effort_kind : {'sample', 'mean', 'command'}
    undeformed : bool
        Whether the motion starts with the Y as it is without a load, else pushed together where two arms hold it.
    sees : tuple of str
        Groups of points that are recorded.
    settings : tuple of str
        What is changed of the shipped configuration.
    """

    arms: int = 2
    effort: float = 0.0
    effort_bias: float = 0.0
    stated: bool = True
    controller_rate: float = 100.0
    effort_kind: EffortSamplingKind = "command"
    undeformed: bool = False
    sees: tuple[str, ...] = ("points_arm", "points_camera")
    settings: tuple[str, ...] = ()

    @property
    def recipe(self) -> dict[str, Any]:
        """What the recordings depend on, as plain data."""
        chosen = {key: value for key, value in asdict(self).items() if key != "settings"}
        limits = {"duration": DURATION, "travel": TRAVEL[self.undeformed], "shake": SHAKE, "snap": SNAP}
        return {**chosen, **limits, "spread": SPREAD, "inner_step": INNER_STEP}

    @property
    def config(self) -> Path:
        """The shipped configuration."""
        return CONFIGS / f"{'single' if self.arms == 1 else 'dual'}_arm_vision.yaml"


PRESCRIBED = ("model.arms.mode=prescribed",)
CELLS: Mapping[str, Cell] = {
    "no_torque_error": Cell(),
    "white_0.1": Cell(effort=0.1),
    "white_0.5": Cell(effort=0.5),
    "offsets_0.3": Cell(effort_bias=0.3),
    "mean_2khz": Cell(controller_rate=2000.0, effort_kind="mean"),
    "sample_2khz": Cell(controller_rate=2000.0, effort_kind="sample"),
    "undeformed_start": Cell(controller_rate=2000.0, effort_kind="sample", undeformed=True),
    "encoders_only": Cell(effort=0.1, sees=()),
    "prescribed_one_grasp": Cell(arms=1, effort=0.1, sees=("points_camera",), settings=PRESCRIBED),
    "prescribed_two_grasps": Cell(effort=0.1, undeformed=True, sees=("points_camera",), settings=PRESCRIBED),
    "steps_5ms": Cell(settings=("problem.time_step=0.005",)),
    "both_noises_one_arm": Cell(arms=1, effort=0.1, effort_bias=0.3),
    "both_noises_two_arms": Cell(effort=0.1, effort_bias=0.3),
    "offsets_unstated": Cell(effort_bias=0.3, stated=False),
}


# -- recordings -------------------------------------------------------------------------------------------------------


def make_twin(cell: str, recipe: Mapping[str, Any], number: int, folder: str, code: str) -> dict[str, Any]:
    """Record a twin; returns its file, its truth and how rough its torques are."""
    made = CELLS[cell]
    assert made.recipe == recipe
    rng = np.random.default_rng([zlib.crc32(cell.encode()), number])
    truth = {name: value * math.exp(rng.uniform(-SPREAD, SPREAD)) for name, value in TRUTH.items()}
    system = baxter_foam_y_system(made.arms)
    posture = grasping_joint_angles(system, truth, offsets={} if made.undeformed else OFFSETS[made.arms])
    simulation = SimulationOptions(
        DURATION, time_step=INNER_STEP, controller_rate=made.controller_rate, effort_kind=made.effort_kind
    )
    noise_seed = int(rng.integers(2**31))
    motion, motion_seed = gentle_enough(system, truth, posture, simulation, made.undeformed, rng)
    experiment = VirtualExperimentSettings(
        motion=motion,
        initial_joint_angles=posture,
        simulation=simulation,
        arm_noise=ArmSensorNoise(
            effort_std=made.effort, effort_bias_std=made.effort_bias, records_effort_std=made.stated
        ),
        seed=noise_seed,
        recording_name=f"{cell}_{number:03d}",
        description=f"Twin {number} of the cell {cell} (motion seed {motion_seed}).",
    )
    recording = run_virtual_experiment(system, truth, experiment)
    recording = replace(recording, points=tuple(group for group in recording.points if group.name in made.sees))
    path = Path(folder) / f"{recording.name}_{json_sha256([recipe, code])[:8]}.h5"
    write_recording(recording, path)
    assert recording.joints is not None
    assert recording.joints.effort is not None
    rough = np.diff(recording.joints.effort, 2, axis=0).std(0)
    return {"file": str(path), "truth": truth, "motion_seed": motion_seed, "roughness": rough.tolist()}


def gentle_enough(
    system: System,
    truth: Mapping[str, float],
    posture: Mapping[str, float],
    simulation: SimulationOptions,
    undeformed: bool,
    rng: np.random.Generator,
) -> tuple[MultisineMotion, int]:
    """The first of many motions drawn that stays within the robot's limits and does not let the object snap."""
    excitation = MultisineOptions(gripper_travel=TRAVEL[undeformed], duration=simulation.duration)
    trial = replace(simulation, time_step=TRIAL_STEP)
    for _ in range(ATTEMPTS):
        seed = int(rng.integers(2**31))
        motion = shaken_motion(system, truth, posture, seed, excitation, SHAKE)
        if within_limits(system, simulate_in_mujoco(system, truth, motion, trial, initial_joint_angles=posture)):
            return motion, seed
    raise ModelError(f"none of {ATTEMPTS} motions stays within the limits", hint="let the arms travel less")


# -- solutions --------------------------------------------------------------------------------------------------------


def solve_twin(config: Path, recording: Path, settings: Sequence[str]) -> dict[str, Any]:
    """What the command `solve` says of a twin."""
    given = [
        f"recordings.estimate=[{json.dumps(str(recording))}]",
        "recordings.held_out=[]",
        "output.write_report=false",
    ]
    with tempfile.TemporaryDirectory() as folder:
        result = run_solve(load_config(config, [*given, *settings]), Path(folder) / "run").result
    return {
        "status": result["status"],
        "message": result["message"],
        "seconds": result["seconds"],
        "chi2_per_dof": result.get("fit", {}).get("chi2_per_dof"),
        "parameters": {
            name: {key: entry[key] for key in ("value", "std", "verdict")}
            for name, entry in result["parameters"].items()
            if entry["free"]
        },
        "diagnose": any("diagnose" in line for line in summary_terminal_lines(summary_blocks(result))),
    }


# -- scores -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Twin:
    """What became of a twin: `error` where it could not be recorded or solved, else what `solve_twin` says."""

    truth: Mapping[str, float] = field(default_factory=dict)
    found: Mapping[str, Any] = field(default_factory=dict)
    error: str = ""

    @property
    def failed(self) -> bool:
        """Whether there is no estimate."""
        return bool(self.error) or self.found["status"] == "failed"

    @property
    def z(self) -> dict[str, float]:
        """(estimate - truth)/std of the parameters that are called found or weakly determined."""
        if self.failed:
            return {}
        return {
            name: (entry["value"] - self.truth[name]) / entry["std"]
            for name, entry in self.found["parameters"].items()
            if entry["verdict"] in JUDGED and entry["std"]
        }

    @property
    def silent(self) -> bool:
        """Whether nothing is called found, something is not trusted, and the way out is named."""
        if self.failed:
            return False
        verdicts = {entry["verdict"] for entry in self.found["parameters"].values()}
        return "identifiable" not in verdicts and "not_trusted" in verdicts and bool(self.found["diagnose"])


@dataclass(frozen=True)
class Pool:
    """z values of one or more cells together, and whether they are as they should be."""

    cells: tuple[str, ...]
    z: Mapping[str, tuple[float, ...]]

    @property
    def values(self) -> np.ndarray:
        return np.concatenate([np.empty(0), *(np.asarray(values) for values in self.z.values())])

    @property
    def rms(self) -> float:
        return math.sqrt(float(np.mean(self.values**2))) if len(self.values) else math.nan

    @property
    def covered(self) -> float:
        """Fraction of the 95 % intervals that hold the truth."""
        return float(np.mean(np.abs(self.values) <= NORMAL_95)) if len(self.values) else math.nan

    @property
    def outside(self) -> tuple[str, ...]:
        """Parameters whose sum of squares lies outside the 99.9 % band of chi-squared."""
        return tuple(
            name
            for name, values in self.z.items()
            if values and not in_band(float(np.sum(np.square(values))), len(values))
        )

    @property
    def honest(self) -> bool:
        """Whether there are enough values, of the right size, and as many intervals as should hold the truth."""
        enough = len(self.values) >= LEAST
        return enough and RMS[0] <= self.rms <= RMS[1] and COVERED[0] <= self.covered <= COVERED[1]


def in_band(total: float, count: int) -> bool:
    """Whether a sum of squares lies in the central 99.9 % of chi-squared with `count` degrees of freedom."""
    low, high = scipy.stats.chi2.ppf([(1 - BAND) / 2, (1 + BAND) / 2], count)
    return bool(low <= total <= high)


def pooled(cell: str, twins: Iterable[Twin]) -> Pool:
    """All z values of a cell, by parameter."""
    z: dict[str, list[float]] = {name: [] for name in TRUTH}
    for twin in twins:
        for name, value in twin.z.items():
            z[name].append(value)
    return Pool((cell,), {name: tuple(values) for name, values in z.items()})


def grouped(pools: Sequence[Pool]) -> list[Pool]:
    """Cells one after another joined until there are enough values; what is left at the end joins the last group."""
    groups: list[Pool] = []
    rest: list[Pool] = []
    for pool in pools:
        rest.append(pool)
        if sum(len(entry.values) for entry in rest) >= LEAST:
            groups.append(_joined(rest))
            rest = []
    if rest:
        groups = [*groups[:-1], _joined([*groups[-1:], *rest])]
    return groups


def _joined(pools: Sequence[Pool]) -> Pool:
    names = dict.fromkeys(name for pool in pools for name in pool.z)
    z = {name: tuple(value for pool in pools for value in pool.z.get(name, ())) for name in names}
    return Pool(tuple(cell for pool in pools for cell in pool.cells), z)


def shortcomings(twins: Mapping[str, Sequence[Twin]]) -> list[str]:
    """What is not as it should be, a sentence each."""
    lines = [
        f"{cell}: {sum(twin.failed for twin in entries)} of {len(entries)} twins have no estimate"
        for cell, entries in twins.items()
        if any(twin.failed for twin in entries)
    ]
    pools = [pooled(cell, entries) for cell, entries in twins.items() if CELLS[cell].stated]
    for pool in pools:
        lines += [f"{pool.cells[0]}: {name} lies outside its band" for name in pool.outside]
    for group in grouped(pools):
        label = " + ".join(group.cells)
        if len(group.values) < LEAST:
            lines.append(f"{label}: {len(group.values)} values of z, too few to judge ({LEAST} are needed)")
        elif not group.honest:
            lines.append(f"{label}: rms {group.rms:.2f}, {100 * group.covered:.1f} % covered")
    for cell, entries in twins.items():
        silent = sum(twin.silent for twin in entries)
        if not CELLS[cell].stated and silent < SILENT * len(entries):
            lines.append(f"{cell}: {silent} of {len(entries)} twins warn and call nothing found")
    return lines


# -- the table --------------------------------------------------------------------------------------------------------


def report(twins: Mapping[str, Sequence[Twin]]) -> list[str]:
    """Lines for a person: a row for each cell and group, and what is not as it should be."""
    rows: list[Sequence[str]] = [("cell", "twins", "failed", "rms z", "covered", *TRUTH, "chi2/n", "time [s]")]
    for cell, entries in twins.items():
        done = [twin.found for twin in entries if not twin.failed]
        chi2 = [found["chi2_per_dof"] for found in done if found["chi2_per_dof"] is not None]
        counts = (str(len(entries)), str(len(entries) - len(done)))
        rows.append(
            (cell, *counts, *_numbers(pooled(cell, entries)), _median(chi2), _median([f["seconds"] for f in done]))
        )
    stated = [pooled(cell, entries) for cell, entries in twins.items() if CELLS[cell].stated]
    if len(stated) > 1:
        rows += [(f"all of {len(group.cells)} cells", "", "", *_numbers(group), "", "") for group in grouped(stated)]
    lines = aligned_table_lines(rows)
    lines += ["", "Of a parameter: rms of z and how many twins call it found or weak; * outside its 99.9 % band.", ""]
    errors = dict.fromkeys(f"{cell}: {twin.error}" for cell, entries in twins.items() for twin in entries if twin.error)
    return [*lines, *errors, *shortcomings(twins)]


def _numbers(pool: Pool) -> list[str]:
    cells = ["-" if math.isnan(pool.rms) else f"{pool.rms:.2f}"]
    cells.append("-" if math.isnan(pool.covered) else f"{100 * pool.covered:.0f} %")
    for name, values in pool.z.items():
        mark = "*" if name in pool.outside else ""
        rms = math.sqrt(float(np.mean(np.square(values)))) if values else math.nan
        cells.append(f"{rms:.2f}{mark} ({len(values)})" if values else "- (0)")
    return cells


def _median(values: Sequence[float]) -> str:
    return f"{np.median(values):.3g}" if values else "-"


# -- the run ----------------------------------------------------------------------------------------------------------


def record(
    names: Sequence[str], numbers: Sequence[int], workers: WorkerConfig, out: Path
) -> dict[str, list[TaskResult]]:
    """Record twins of some cells by their numbers; what stands in the folder is not done again."""
    recordings = out.resolve() / "recordings"
    recordings.mkdir(parents=True, exist_ok=True)
    code = sha256_of_folder_sources(PACKAGE / "virtual")
    tasks = [
        Task(
            f"recording {k} of {name}",
            {"cell": name, "recipe": CELLS[name].recipe, "number": k, "folder": str(recordings), "code": code},
        )
        for name in names
        for k in numbers
    ]
    made = run_tasks(make_twin, tasks, out / "made", workers, print_progress, code)
    return {name: made[i * len(numbers) : (i + 1) * len(numbers)] for i, name in enumerate(names)}


def solve(made: Mapping[str, Sequence[TaskResult]], workers: WorkerConfig, out: Path) -> dict[str, list[Twin]]:
    """Solve the twins that were recorded; what stands in the folder is not done again."""
    whole = [(name, entry) for name, entries in made.items() for entry in entries if not entry.error]
    tasks = [
        Task(
            f"solution of {entry.name}",
            {
                "config": CELLS[name].config,
                "recording": Path(entry.value["file"]),
                "settings": list(CELLS[name].settings),
            },
        )
        for name, entry in whole
    ]
    solved = run_tasks(solve_twin, tasks, out / "solved", workers, print_progress)
    done = {entry.value["file"]: result for (_, entry), result in zip(whole, solved, strict=True)}
    return {
        name: [_twin(entry, None if entry.error else done[entry.value["file"]]) for entry in entries]
        for name, entries in made.items()
    }


def _twin(made: TaskResult, solved: TaskResult | None) -> Twin:
    if solved is None:
        return Twin(error=made.error)
    return Twin(made.value["truth"], solved.value or {}, solved.error)


def print_progress(done: int, total: int, text: str) -> None:
    print(f"{done} of {total}: {text}", file=sys.stderr, flush=True)


def command(description: str, what: str, known: Mapping[str, Any], twins: int) -> argparse.ArgumentParser:
    """The command line of a benchmark over twins of several cells or kinds, as `what` says."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("names", nargs="*", metavar=what.upper(), help=f"of {', '.join(known)}; all when absent")
    parser.add_argument("--twins", type=int, default=twins, help=f"of each {what}")
    working(parser)
    parser.add_argument("--out", type=Path, required=True, help="folder of recordings and results")
    parser.add_argument("--record-only", action="store_true", help="make the recordings, to be used later")
    return parser


def working(parser: argparse.ArgumentParser) -> None:
    """Add what says who does the work."""
    parser.add_argument("--workers", type=int, help="processes; as many as there are processors when absent")
    parser.add_argument("--scheduler", default="", help="of Dask workers that do the work instead")


def asked_for(parser: argparse.ArgumentParser, asked: Sequence[str], known: Mapping[str, Any], what: str) -> list[str]:
    """Names in their own order, all of them where none is asked for; the parser's error where one is not known."""
    unknown = sorted(set(asked) - set(known))
    if unknown:
        parser.error(f"there is no {what} '{unknown[0]}'; choose from {', '.join(known)}")
    return [name for name in known if name in asked or not asked]


def main(arguments: Sequence[str] | None = None) -> int:
    parser = command("Whether the standard deviations of `solve` are true.", "cell", CELLS, 40)
    parser.add_argument("--first", type=int, default=0, help="number of the first twin, to add to those of another run")
    chosen = parser.parse_args(arguments)
    names = asked_for(parser, chosen.names, CELLS, "cell")
    workers = WorkerConfig(chosen.workers, chosen.scheduler)
    made = record(names, range(chosen.first, chosen.first + chosen.twins), workers, chosen.out)
    if chosen.record_only:
        return 1 if any(entry.error for entries in made.values() for entry in entries) else 0
    twins = solve(made, workers, chosen.out)
    write_strict_json(
        chosen.out / "coverage.json", {cell: [asdict(twin) for twin in entries] for cell, entries in twins.items()}
    )
    print("\n".join(report(twins)))
    return 1 if shortcomings(twins) else 0


if __name__ == "__main__":
    sys.exit(main())
