"""The command `blind`: diagnose synthetic cases without their labels, then open the labels and score the answers.

An experiment is a configuration in one of the `EXPERIMENT_VARIATIONS`. A `BlindCaseGenerator` draws its cases.
"""

from __future__ import annotations

import argparse
import functools
import json
import logging
import math
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.config.reader import SHIPPED_DEFAULT_CONFIG_FILE_NAME, SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.config.settings import RunSettings, config_yaml_with_defaults
from yid_ocp.data.recording_hdf5 import read_recording, write_recording
from yid_ocp.diagnosis import blind, blind_scores
from yid_ocp.diagnosis.diagnosis_result import diagnosis_decision_statistics
from yid_ocp.display import NULL_PROGRESS, Progress, count_with_noun
from yid_ocp.effects.friction import FrictionLawName
from yid_ocp.errors import ConfigError, ModelError, OutputError, YidError
from yid_ocp.files import make_folder, read_input_json, read_input_text, to_json_types, write_strict_json, write_text
from yid_ocp.model.system import System
from yid_ocp.parallel import LOCAL_WORKER_CONFIG, Task, WorkerConfig, require_task_values, run_tasks
from yid_ocp.problem.recorded_inputs import servo_gain_parameters_by_recording
from yid_ocp.version import installed_versions, package_source_hash
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualArmImperfections
from yid_ocp.virtual.mjcf import import_mujoco
from yid_ocp.virtual.mujoco_simulation import DEFAULT_SIMULATOR_TIME_STEP, SimulationOptions
from yid_ocp.workflow.blind_slices import rescore_blind, score_joined_slices, score_whole_ensemble, write_slice_results
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.command_runner import CommandOutcome, run_command_and_print, worker_config_from_arguments
from yid_ocp.workflow.run_inputs import read_recordings_of_role

_MIN_TWO_ARM_CASES = 100  # cases from which the embedded proof has experiments with two arms as well
_TORQUE_NOISE_STD, _TORQUE_OFFSET_STD = 0.1, 0.3
"""Standard deviations [N m] of the torques' white noise and constant offsets, in experiments with torque noise."""
_PRESCRIBED_SIGN_SMOOTHING_SPEED = 0.005  # of nominal friction, for joints that stand still under a load [rad/s]
_SERVO_SIGN_SMOOTHING_SPEED = 2e-4  # likewise, of joints with servos, whose encoders show even slow creep
_NO_ANSWER = {"effects": [], "which": [], "where": [], "confusable": [], "gap": {"closure": None}}
log = logging.getLogger(__name__)


def run_and_return_exit_code(arguments: argparse.Namespace) -> int:
    """Run the command `blind` and return its exit code."""
    if arguments.rescore is not None:
        folder, target = arguments.rescore, arguments.out or Path(arguments.rescore) / "rescored"
        return run_command_and_print(arguments, functools.partial(rescore_blind, folder, target, arguments.overrides))
    if arguments.join:
        together = functools.partial(score_joined_slices, arguments.join, arguments.out or "joined-slices")
        return run_command_and_print(arguments, together)
    said, default = arguments.overrides, SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME
    runs = [load_config(path, said, default) for path in arguments.configs or [None]]
    if not arguments.configs and arguments.cases >= _MIN_TWO_ARM_CASES:
        runs.append(load_config(None, said, SHIPPED_DEFAULT_CONFIG_FILE_NAME))
    workers = worker_config_from_arguments(arguments) or LOCAL_WORKER_CONFIG
    purpose = blind.BLIND_ENSEMBLE_PURPOSES[int(arguments.calibration)]
    out = arguments.out or f"{runs[0].name}-blind-{'calibration-' if arguments.calibration else ''}{arguments.seed}"
    asked, part = (runs, out, arguments.cases, arguments.seed), _slice_numbers(arguments.slice)
    return run_command_and_print(arguments, lambda shown: run_blind(*asked, shown, workers, purpose, part))


def _slice_numbers(text: str) -> tuple[int, int]:
    """Return K and N of the text `K/N`. Raises `ConfigError` for any other text."""
    own, _, of = text.partition("/")
    if not (own.isdigit() and of.isdigit() and 1 <= int(own) <= int(of)):
        what, hint = f"--slice is '{text}', but must be K/N, the K-th of N parts", "write for example --slice 1/4"
        raise ConfigError(what, where="--slice", allowed="two whole numbers K/N, with K from 1 to N", hint=hint)
    return int(own), int(of)


def run_blind(
    runs: Sequence[RunSettings],
    out: str | Path,
    count: int = 20,
    seed: int = 1,
    progress: Progress = NULL_PROGRESS,
    workers: WorkerConfig | Executor = LOCAL_WORKER_CONFIG,
    purpose: str = blind.BLIND_ENSEMBLE_PURPOSES[0],
    part: tuple[int, int] = (1, 1),
) -> CommandOutcome[None]:
    """Diagnose `count` synthetic cases without their labels, then score the answers against the labels.

    Each run gives a model; its first recording gives initial joint angles and sensors. As many `EXPERIMENT_VARIATIONS`
    are used as `count` allows. `seed` and `purpose` ('report' or 'calibration') determine the cases. With `part` (K,
    N), only every N-th case is made and diagnosed, in the folder `slice-K-of-N`. Finished parts in `out` are reused.

    docs/howto/blind.md has the files of the folder. Raises `OutputError` for a folder of another blind test.
    """
    for what, number, where, least in (("number of cases", count, "--cases", 1), ("seed", seed, "--seed", 0)):
        if number < least:
            what, allowed = f"the {what} is {number}, but must be at least {least}", f"a whole number from {least}"
            raise ConfigError(what, where=where, allowed=allowed, hint=f"leave {where} out, or give a larger number")
    import_mujoco()
    runs = list(map(_with_simulated_noise, runs))
    names = [entry.name for entry in runs]
    for i, name in enumerate(names):
        if name in names[:i]:
            what, where = f"two configurations have the name {name}", str(runs[i].config_file)
            raise ConfigError(what, where=where, allowed="different file names", hint="rename one of the two files")
    proof = _Proof(Path(out).absolute(), runs, count, seed, purpose, progress, workers, part)
    try:
        commitment, cases = proof.commit()
        progress.begin_stage(f"diagnosing {count_with_noun(len(cases), 'case')}")
        answers = proof.done(_diagnose_case_from_recordings_task, cases, "answers")
        sealed = read_input_text(proof.folder / "sealed/labels.json")
        labels = blind.read_labels_checking_sha256(sealed, commitment["sha256"])
        progress.begin_stage("comparing the diagnoses with the labels")
        best = proof.best_closures(cases, labels, answers)
    except KeyboardInterrupt:
        log.warning("the finished cases are kept in %s. The same command continues with the others", proof.folder)
        raise
    flags = ["--cases", count, "--seed", seed]
    flags += ["--calibration"] if purpose == blind.BLIND_ENSEMBLE_PURPOSES[1] else []
    found = {
        **{key: commitment[key] for key in ("slice", "cases", "seed", "purpose", "configs")},
        "code": package_source_hash(),
        "code_of_cases": commitment["code"],
        "labels_sha256": commitment["sha256"],
        "command": shlex.join(["yid-ocp", "blind", *map(str, map(proof.config_file, names)), *map(str, flags)]),
        "versions": installed_versions(),
        "labels": json.loads(sealed),
        "answers": answers,
        "best": best,
    }
    return score_whole_ensemble([write_slice_results(found, proof.folder)], proof.folder, runs, progress)


@dataclass(frozen=True)
class _Proof:
    whole: Path  # folder of the ensemble, of all its slices
    runs: Sequence[RunSettings]
    count: int
    seed: int
    purpose: str
    progress: Progress
    workers: WorkerConfig | Executor
    part: tuple[int, int]  # K and N of slice K/N

    @property
    def folder(self) -> Path:
        own, of = self.part
        return self.whole if of == 1 else self.whole / f"slice-{own}-of-{of}"

    def config_file(self, name: str) -> Path:
        return self.folder / "configs" / f"{name}.yaml"

    def commit(self) -> tuple[dict[str, Any], list[Task]]:
        """Return the commitment to the labels, and one diagnosis task per case; draw the cases if there are none."""
        file = self.folder / "commitment.json"
        configs = {entry.name: config_yaml_with_defaults(entry) for entry in self.runs}
        asked = {"cases": self.count, "seed": self.seed, "purpose": self.purpose, "configs": configs}
        asked["slice"] = "/".join(map(str, self.part))
        if not file.exists():
            write_strict_json(file, asked | {"sha256": self._draw(configs), "code": package_source_hash()})
        said = read_input_json(file)
        if {key: said[key] for key in asked} != asked:
            holds = f"{said['cases']} cases, seed {said['seed']}, for {said['purpose']}"
            hint = "choose another --out, or the same configurations, --cases, --seed, --slice and --calibration"
            differing = ", ".join(key for key in asked if said[key] != asked[key])
            what = f"the folder has the cases of another blind test ({holds}), which differs in: {differing}"
            allowed = "a new folder, or the folder of the same blind test, to complete it"
            raise OutputError(what, where=str(self.folder), allowed=allowed, hint=hint)
        tasks = []
        for entry in read_input_json(self.folder / "cases" / "cases.json"):
            config, _, variation = str(entry["experiment"]).rpartition(".")
            experiment = _BlindExperiment(self.config_file(config), variation, self.seed, self.purpose)
            recordings = [self.folder / "cases" / name for name in (*entry["estimate"], entry["held_out"])]
            own = {"name": str(entry["name"]), "recordings": recordings, "without": entry["without"]}
            own |= {"experiment": vars(experiment), "first": self.whole / "prepared" / f"{entry['experiment']}.h5"}
            tasks.append(Task(own["name"], own))
        return said, tasks

    def _draw(self, configs: Mapping[str, str]) -> str:
        """Draw the cases, and return the hash of their labels."""
        cases, prepared = self.folder / "cases", self.whole / "prepared"
        for part in (self.folder / "configs", prepared, cases, self.folder / "sealed/drawn"):
            make_folder(part)
        for name, text in configs.items():
            write_text(self.config_file(name), text)
        files = {name: self.config_file(name) for name in configs}
        experiments, chains = _blind_experiments_and_refinable_subset(files, self.seed, self.purpose)
        weights = {name: EXPERIMENT_VARIATIONS[entry.variation].case_fraction for name, entry in experiments.items()}
        own, of = self.part
        whole = blind.plan_blind_cases(self.count, self.seed, weights, chains, self.purpose)
        plan = [entry for entry in whole if entry.number % of == own - 1]
        if not plan:
            what, allowed = f"part {own}/{of} is empty: there are {self.count} cases", f"K/N with N up to {self.count}"
            raise ConfigError(what, where="--slice", allowed=allowed, hint="use fewer parts (N), or more --cases")
        used = [name for name in experiments if any(entry.experiment == name for entry in plan)]
        self.progress.begin_stage(f"preparing {count_with_noun(len(used), 'experiment')}")
        told = {name: {"experiment": vars(experiments[name])} for name in used}
        tasks = [Task(name, {**told[name], "folder": str(prepared), "name": name}) for name in used]
        self.done(_prepare_experiment, tasks, prepared / "tasks")
        self.progress.begin_stage(f"simulating {count_with_noun(len(plan), 'case')}")
        tasks = []
        for entry in plan:
            name = entry.experiment
            known = {"first": prepared / f"{name}.h5", "folder": str(cases)}
            tasks.append(Task(f"case {entry.number}", {**told[name], **known, "planned": asdict(entry)}))
        made = self.done(_draw_case, tasks, "sealed/drawn")
        text, digest = blind.labels_json_and_sha256([blind.CaseGroundTruth.from_dict(entry["label"]) for entry in made])
        write_text(self.folder / "sealed/labels.json", text)
        write_strict_json(cases / "cases.json", [entry["case"] for entry in made])
        return digest

    def best_closures(
        self, cases: Sequence[Task], labels: Sequence[blind.CaseGroundTruth], answers: Sequence[Mapping[str, Any]]
    ) -> dict[str, float]:
        """Return the closure that the true effects reach, by case: cases with one or two effects and a detected gap."""
        tasks = []
        for case, label, found in zip(cases, labels, answers, strict=True):
            gap = found["result"]["verdict"] not in ("no_gap", "insufficient_data")
            if gap and label.category in ("single", "pair"):
                arguments = {key: value for key, value in case.arguments.items() if key != "without"}
                tasks.append(Task(case.name, {**arguments, "label": asdict(label)}))
        best = self.done(_true_effect_closure, tasks, "best")
        return {task.name: value for task, value in zip(tasks, best, strict=True) if value is not None}

    def done(self, function: Callable[..., Any], tasks: Sequence[Task], results: str | Path) -> list[Any]:
        """Return the results of `function` in the order of `tasks`. Tasks run by experiment, so each is built once."""
        order = sorted(range(len(tasks)), key=lambda i: str(tasks[i].arguments["experiment"]))
        folder, report = self.folder / results, self.progress.report_parts_done
        found = run_tasks(function, [tasks[i] for i in order], folder, self.workers, report)
        values = dict(zip(order, require_task_values(found), strict=True))
        return [values[i] for i in range(len(tasks))]


def _prepare_experiment(experiment: Mapping[str, Any], folder: str, name: str) -> None:
    """Task: write an experiment's first recording."""
    _BlindExperiment(**experiment)._write_first_recording(Path(folder) / f"{name}.h5")


def _draw_case(experiment: Mapping[str, Any], first: Path, planned: Mapping[str, Any], folder: str) -> dict[str, Any]:
    """Task: simulate and write the recordings of a case. Returns its label, and the data that its diagnosis may use."""
    _, ensemble = _BlindExperiment(**experiment)._build_ensemble(first)
    case, label = ensemble.draw_recordings_and_ground_truth(blind.PlannedBlindCase(**planned))
    for recording in (*case.estimation_recordings, case.held_out_recording):
        write_recording(recording, Path(folder) / f"{recording.name}.h5")
    told = {
        "name": case.name,
        "experiment": planned["experiment"],
        "estimate": [f"{recording.name}.h5" for recording in case.estimation_recordings],
        "held_out": f"{case.held_out_recording.name}.h5",
        "without": list(case.excluded_kinds),
    }
    return dict(to_json_types({"label": asdict(label), "case": told}))


def _diagnose_case_from_recordings_task(
    experiment: Mapping[str, Any], first: Path, name: str, recordings: Sequence[Path], without: Sequence[str]
) -> dict[str, Any]:
    """Task: diagnose a case from its recordings, the last one held out. Returns {seconds, result, evidence}.

    `evidence` allows the case to be judged again. In a calibration ensemble, the answer `no_gap` also has `open`:
    statistics of a diagnosis with thresholds that always accept the best candidate.
    """
    run, ensemble = _BlindExperiment(**experiment)._build_ensemble(first)
    case = _case(name, recordings, without)
    begun, evidence = time.perf_counter(), None
    try:
        finding = blind.diagnose_unlabelled_case(ensemble, case, run.diagnosis)
        result, evidence = finding.to_dict(), blind_scores.diagnosis_evidence_to_dict(finding)
    except YidError as error:
        result = {"verdict": "insufficient_data", "message": str(error), **_NO_ANSWER}
    found: dict[str, Any] = to_json_types({"seconds": time.perf_counter() - begun, "result": result})
    found["evidence"] = evidence
    if experiment["purpose"] == blind.BLIND_ENSEMBLE_PURPOSES[1] and result["verdict"] == "no_gap":
        wide = blind_scores.thresholds_always_accepting_best_candidate(run.diagnosis)
        try:
            anything = blind.diagnose_unlabelled_case(ensemble, case, wide)
            found["open"] = to_json_types(diagnosis_decision_statistics(anything))
        except YidError as error:
            found["open"] = {"message": str(error)}
    return found


def _true_effect_closure(
    experiment: Mapping[str, Any], first: Path, name: str, recordings: Sequence[Path], label: Mapping[str, Any]
) -> float | None:
    """Task: return the closure of a case by its refitted true effects; None if the fit fails or is not finite."""
    _, ensemble = _BlindExperiment(**experiment)._build_ensemble(first)
    case, truth = _case(name, recordings, ()), blind.CaseGroundTruth.from_dict(label)
    try:
        best = blind.true_effects_gap_closure(ensemble, case, truth)
    except YidError:
        return None
    return best if math.isfinite(best) else None


def _case(name: str, recordings: Sequence[Path], without: Sequence[str]) -> blind.UnlabelledCase:
    *estimate, held_out = map(read_recording, recordings)
    return blind.UnlabelledCase(name, tuple(estimate), held_out, tuple(without))


@dataclass(frozen=True)
class _ExperimentVariation:
    """Differences of an experiment from its configuration. `case_fraction`: its share of all cases."""

    case_fraction: float
    description: str
    has_torque_noise: bool = False
    time_step_factor: float = 1.0
    n_recordings: int = 1
    is_without_object: bool = False
    has_prescribed_arms: bool = False
    friction: FrictionLawName = "coulomb"  # law of the diagnosed model if the settings vary it

    def simulation_overrides(self, arm: VirtualArmImperfections) -> tuple[str, ...]:
        # settings of the object and its sensors do not apply without it
        bare = ("model.object=null", "model.grasp={}", "model.measured_points=null", "sensors={}", "parameters={}")
        mass = f"model.arms.relative_link_mass_std={arm.max_relative_link_mass_error}"
        own = (mass, *bare) if self.is_without_object else (mass,)
        return own if arm.friction_law == "none" else (*own, "model.friction=null")

    def diagnosis_overrides(self, simulated: System, arm: VirtualArmImperfections) -> list[str]:
        own = [text for text in self.simulation_overrides(arm) if text != "model.friction=null"]
        if arm.friction_law != "none":
            law = self.friction if arm.friction_law == "varied" else arm.friction_law
            speed = _SERVO_SIGN_SMOOTHING_SPEED if simulated.servos else "null"
            speed = _PRESCRIBED_SIGN_SMOOTHING_SPEED if self.has_prescribed_arms else speed
            own.append(f"model.friction={{law: {law}, sign_smoothing_speed: {speed}}}")
            own += ['parameters={"*.v_stribeck": {free: false}}'] if "stribeck" in law else []
        if self.is_without_object:
            free = {f"{name}.damping": {"free": True, "bounds": [0.0, 50.0]} for name in simulated.driven}
            own += [f"parameters={json.dumps(free)}", "diagnosis.candidates=all"]
        return own + (["model.arms.mode=prescribed"] if self.has_prescribed_arms else [])


EXPERIMENT_VARIATIONS: Mapping[str, _ExperimentVariation] = {
    "as_configured": _ExperimentVariation(0.4, "as the configuration has it, torques exact"),
    "torque_noise": _ExperimentVariation(0.2, "noisy torques with offsets", has_torque_noise=True, friction="stribeck"),
    "several_recordings": _ExperimentVariation(0.1, "three recordings to estimate on", n_recordings=3, friction="load"),
    "finer_integration": _ExperimentVariation(0.1, "the other engine's step halved", time_step_factor=0.5),
    "bare_arm": _ExperimentVariation(0.1, "the arms alone, driven", has_torque_noise=True, is_without_object=True),
    "bare_arm_efforts": _ExperimentVariation(
        0.1, "the arms, moved as measured", has_torque_noise=True, is_without_object=True, has_prescribed_arms=True
    ),
}
"""Variations by name. An experiment has the name `CONFIGURATION.VARIATION`."""


@dataclass(frozen=True)
class _BlindExperiment:
    config_file: Path
    variation: str
    seed: int
    purpose: str

    def simulation_settings(self) -> RunSettings:
        overrides = EXPERIMENT_VARIATIONS[self.variation].simulation_overrides(self._virtual_arm)
        return load_config(self.config_file, overrides)

    @property
    def _virtual_arm(self) -> VirtualArmImperfections:
        return load_config(self.config_file).virtual_arm

    def _recording_conditions(self) -> blind.SyntheticRecordingConditions:
        varied = EXPERIMENT_VARIATIONS[self.variation]
        arm, step = self._virtual_arm, DEFAULT_SIMULATOR_TIME_STEP * varied.time_step_factor
        noise = ArmSensorNoise(
            position_resolution=2 * math.pi / arm.encoder_counts_per_turn if arm.encoder_counts_per_turn else 0.0,
            lost_joint_sample_fraction=arm.lost_joint_sample_fraction,
        )
        if varied.has_torque_noise:
            noise = replace(noise, effort_std=_TORQUE_NOISE_STD, effort_bias_std=_TORQUE_OFFSET_STD)
        return blind.SyntheticRecordingConditions(
            varied.n_recordings,
            noise,
            SimulationOptions(time_step=step, period_jitter_std=arm.period_jitter_std),
            purpose=self.purpose,
            ordinary_friction=None if arm.friction_law == "none" else (),
        )

    def _write_first_recording(self, file: Path) -> None:
        """Write the experiment's first recording, from which all its cases take initial joint angles and sensors."""
        varied, run = EXPERIMENT_VARIATIONS[self.variation], load_config(self.config_file)
        first = read_recordings_of_role(run, count=1)
        if not first:
            what, allowed = "no recording gives the initial joint angles of the arms", "one recording or more"
            raise run.config_error(what, "recordings", "estimate", allowed=allowed, hint="list a recording of the arms")
        system = build_system(self.simulation_settings())
        vision = not varied.is_without_object and any(group.camera_pose is not None for group in first[0].points)
        values = dict(zip(system.parameters.names, map(float, system.parameters.vector()), strict=True))
        values |= servo_gain_parameters_by_recording(system, first).get(first[0].name, {})
        conditions = replace(self._recording_conditions(), has_camera=vision)
        posture = blind.first_recorded_driven_joint_positions(system, first[0])
        for attempt in range(blind.MAX_DRAWS_PER_CASE):
            rng = np.random.default_rng([self.seed, blind.BLIND_ENSEMBLE_PURPOSES.index(self.purpose), 3, attempt])
            try:
                made = blind.simulate_random_motion(system, system, posture, values, values, (), rng, conditions)
            except YidError as error:
                lately = error.what  # such as a motion that throws the object about; draw another
                continue
            write_recording(replace(made, name="first", description="", source="", true_parameters={}), file)
            return
        hint = "set a larger model.damping, or give a recording that begins where the object hangs in equilibrium"
        what = f"MuJoCo simulated none of {blind.MAX_DRAWS_PER_CASE} random motions, lately because {lately}"
        where, allowed = f"{self.config_file.name}, {varied.description}", "one motion that MuJoCo can simulate"
        raise ModelError(what, where=where, allowed=allowed, hint=hint)

    def _build_ensemble(self, first: Path) -> tuple[RunSettings, blind.BlindCaseGenerator]:
        return _ensemble(self, first, first.stat().st_mtime_ns)


@functools.lru_cache(maxsize=1)
def _ensemble(experiment: _BlindExperiment, first: Path, written: int) -> tuple[RunSettings, blind.BlindCaseGenerator]:
    """Return the settings of the diagnosed model and the case generator, cached for tasks of the same experiment."""
    del written
    varied, simulated_run = EXPERIMENT_VARIATIONS[experiment.variation], experiment.simulation_settings()
    simulated = build_system(simulated_run)
    begun = (f"recordings.estimate=[{json.dumps(str(first))}]", "recordings.held_out=[]", "diagnosis.budget=null")
    overrides = varied.diagnosis_overrides(simulated, simulated_run.virtual_arm)
    run = load_config(experiment.config_file, (*overrides, *begun))
    ensemble = blind.BlindCaseGenerator(
        build_problem(run),
        experiment.seed,
        (lambda times: build_system(simulated_run, times)) if simulated.segment_layouts else None,
        run.diagnosis.candidates,
        simulated_system=simulated,
        conditions=experiment._recording_conditions(),
    )
    return run, ensemble


def _with_simulated_noise(run: RunSettings) -> RunSettings:
    """Return the settings without stated noise, which simulated recordings do not have. Raises `ConfigError`."""
    first, system = read_recordings_of_role(run, count=1), build_system(run)
    has_pose = any(group.camera_pose is not None for recording in first for group in recording.points)
    simulated = ("points_arm", "points_camera")[: 1 + has_pose] if system.point_frames else ()
    missing = [name for name in run.sensors if first and name.startswith("points") and name not in simulated]
    for name in (own for own in missing if run.sensors[own].use is not False):
        what, allowed = f"a blind test cannot simulate '{name}' of this model", "joints, and points of model.object"
        lacks = "an object with measured points" if not system.point_frames else "the pose of a camera"
        hint = f"leave it out (sensors.{name}.use: false), as the recording or the model lacks {lacks}"
        raise run.config_error(what, "sensors", name, allowed=allowed, hint=hint)
    if not system.driven or system.prescribed:
        what, hint = "a blind test needs arms whose joints are all driven", "set model.arms.mode: driven"
        raise run.config_error(what, "model", "arms", "mode", allowed="driven, servo", hint=hint)
    sensors = {name: replace(own, std=None) for name, own in run.sensors.items() if name not in missing}
    return replace(run, sensors=sensors, diagnosis=replace(run.diagnosis, noise_fraction_of_stated_std=1.0))


def _blind_experiments_and_refinable_subset(
    configs: Mapping[str, Path], seed: int, purpose: str
) -> tuple[dict[str, _BlindExperiment], frozenset[str]]:
    """Return the experiments that the configurations allow, by name, and the names of those with divisible links."""
    found: dict[str, _BlindExperiment] = {}
    chains = set()
    for name, config in configs.items():
        whole = load_config(config).model.object is not None
        for variation, varied in EXPERIMENT_VARIATIONS.items():
            if varied.is_without_object and not whole:
                continue  # all its experiments are without an object
            experiment = _BlindExperiment(config, variation, seed, purpose)
            try:
                system = build_system(experiment.simulation_settings())
            except YidError as error:
                log.info("%s.%s is left out: %s", name, variation, error.what)
                continue
            if system.servos and varied.has_torque_noise:
                continue  # servos record no torques
            found[f"{name}.{variation}"] = experiment
            if system.segment_layouts:
                chains.add(f"{name}.{variation}")
    return found, frozenset(chains)
