"""Injected effects in data from MuJoCo: what the diagnosis says of each, failures included.

    python benchmarks/diagnosis_cases.py [CASE ...] [--seeds 1 7] [--json FILE] [--workers 2] [--keep DIR]
    python benchmarks/diagnosis_cases.py [CASE ...] --record DIR
    python benchmarks/diagnosis_cases.py [CASE ...] --rescore DIR [--set KEY=VALUE ...]

Every case is one arm that moves the foam Y (43 variables, 5 s to estimate on, 5 s of another motion held out, arm and
camera points), all candidates of the library in play. Effects are done in the simulator's own terms
(`yid_ocp.virtual.injected`). With `--keep`, what a folder holds is not done again; it counts for one version of the
package only, so take another folder after a change of the code. `--record` writes the numbers that every rule needs;
`--rescore` judges them again, without a refit, by the rules and thresholds of now.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import threadpoolctl
from make_recordings import TRAVEL, TRUTH

from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.blind import scale_parameters_to_more_links
from yid_ocp.diagnosis.blind_scores import diagnosis_evidence_to_dict, rejudge_diagnosis_evidence
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, make_candidate_effects
from yid_ocp.diagnosis.refit import RefitContext, refit_with_effects
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.files import make_folder, read_input_json, write_strict_json
from yid_ocp.parallel import Task, WorkerConfig, run_tasks
from yid_ocp.problem import EstimationProblem
from yid_ocp.virtual.experiment import VirtualExperimentSettings
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import build_problem

NOISE_SEEDS = (401, 402)


@dataclass(frozen=True)
class Case:
    """What is done in the simulator, the verdict that it deserves, and what is left out of the library."""

    withheld: tuple[InjectedEffect, ...]
    verdict: str = "effect"
    without: tuple[str, ...] = ()
    links: int = 1


def injected(kind: str, location: str, **values: float) -> InjectedEffect:
    return InjectedEffect(kind, location, values)


def one(kind: str, location: str, **values: float) -> Case:
    return Case((injected(kind, location, **values),))


def both(*effects: InjectedEffect) -> Case:
    return Case(effects)


def outside(kind: str, location: str, size: float) -> Case:
    return Case((injected(kind, location, size=size),), "unknown")


CASES: Mapping[str, Case] = {
    "clean": Case((), "no_gap"),
    "damped_trunk": one("kelvin_voigt", "T1", tau=0.05),
    "damped_branch": one("kelvin_voigt", "T2", tau=0.05),
    "slow_trunk": one("standard_linear_solid", "T1", ratio=0.5, relaxation_time=0.3),
    "stiffening_trunk": one("cubic_stiffness", "T1", k3=150.0),
    "bent_trunk": one("rest_curvature", "T1", qx=0.05, qy=0.03),
    "dahl_trunk": one("hysteresis", "T1", stiffness=8.0, yield_angle=0.1),
    "heavy_free_branch": one("density", "T3", scale=1.8),
    "marker_on_branch": one("point_mass", "w_T3", mass=0.02),
    "long_branch": one("length_scale", "T2", scale=1.02),
    "air": Case((InjectedEffect("aerodynamic_drag", "T3", {"cd": 3.0}),), "no_gap"),  # too little to be seen here
    "weightless": one("gravity_scale", "object", fraction=-0.8),
    "tilted_world": one("gravity_tilt", "world", rx=0.03, ry=0.02),
    "shifted_grasp": one("grasp_offset", "left", dx=0.01, dy=-0.005, dz=0.005),
    "stiff_gear": one("joint_viscous", "left_e1", b=1.0),
    "dry_gear": one("joint_coulomb", "left_e1", tau_c=1.0),
    "shoulder_spring": one("joint_spring", "left_s1", stiffness=15.0, rest_angle=-0.5),
    "heavy_rotor": one("rotor_inertia", "left_e1", armature=0.4),
    "heavy_link": one("link_mass", "left_w1", scale=1.15),
    "strong_sensor": one("effort_gain", "left_s1", scale=1.05),
    "biased_torque": one("effort_offset", "left_e1", offset=0.8),
    "late_torque": one("effort_delay", "left", delay=0.05),
    "turned_encoder": one("encoder_offset", "left_s1", offset=0.01),
    "moved_camera": one("camera_translation", "camera", x=0.02, y=0.0, z=0.0),
    "late_camera": one("camera_latency", "camera", delay=0.08),
    "near_surface": one("surface_offset", "camera", fraction=0.8),
    "robbed_trunk": Case((InjectedEffect("kelvin_voigt", "T1", {"tau": 0.05}),), "unknown", ("kelvin_voigt",)),
    "ripple": outside("torque_ripple", "left_e1", 1.0),
    "crossed_springs": outside("cross_stiffness", "T1", 8.0),
    "gusts": outside("gusts", "T3", 0.1),
    "crease": outside("crease", "T1", 18.0),
    "tether": outside("tether", "T3", 15.0),
    "dress_pack": outside("tether", "left_w0", 200.0),
    "magnet": outside("magnet", "T3", 0.3),
    "wall": outside("wall", "T3", 30.0),
    "softening_trunk": outside("stiffness_drift", "T1", 0.3),
    "one_way_trunk": outside("one_way_damping", "T1", 0.6),
    "saturating_elbow": outside("saturating_drive", "left_e1", 32.0),
    "warming_shoulder": outside("warming_gear", "left_s1", 3.0),
    "loose_load": outside("shifting_load", "left_w1", 0.8),
    "slipping_grasp": outside("slipping_grasp", "left", 0.008),
    "damped_and_moved_camera": both(
        injected("kelvin_voigt", "T1", tau=0.05), injected("camera_translation", "camera", x=0.02, y=0.0, z=0.0)
    ),
    "damped_and_dry": both(injected("kelvin_voigt", "T1", tau=0.05), injected("joint_coulomb", "left_e1", tau_c=0.6)),
    "bent_and_heavy_link": both(
        injected("rest_curvature", "T1", qx=0.03, qy=0.0), injected("link_mass", "left_w1", scale=1.1)
    ),
    "bent_and_shifted": both(
        injected("rest_curvature", "T2", qx=0.05, qy=-0.03), injected("grasp_offset", "left", dx=0.008, dy=0.0, dz=0.0)
    ),
    "long_and_damped": both(injected("length_scale", "T2", scale=1.015), injected("kelvin_voigt", "T1", tau=0.06)),
    "spring_and_weight": both(
        injected("joint_spring", "left_s1", stiffness=10.0, rest_angle=-0.5), injected("point_mass", "w_T3", mass=0.02)
    ),
    "gain_and_friction": both(
        injected("effort_gain", "left_s1", scale=1.05), injected("joint_viscous", "left_e1", b=1.0)
    ),
    "offset_and_solid": both(
        injected("effort_offset", "left_e1", offset=0.6),
        injected("standard_linear_solid", "T1", ratio=0.5, relaxation_time=0.3),
    ),
    "tilt_and_rotor": both(
        injected("gravity_tilt", "world", rx=0.03, ry=0.0), injected("rotor_inertia", "left_e1", armature=0.4)
    ),
    "late_camera_and_encoder": both(
        injected("camera_latency", "camera", delay=0.1), injected("encoder_offset", "left_s1", offset=0.01)
    ),
    "stiffening_and_dense": both(injected("cubic_stiffness", "T1", k3=400.0), injected("density", "T3", scale=1.8)),
    "dahl_and_late_torque": both(
        injected("hysteresis", "T1", stiffness=8.0, yield_angle=0.1), injected("effort_delay", "left", delay=0.03)
    ),
    "finer_chain": Case((), "-", (), 2),
}


def record(case: Case, motion_seed: int, noise_seed: int) -> Recording:
    run = load_config(None, (), SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME)
    nominal = build_system(run)
    links = len(nominal.segment_layouts[0].link_joints) * case.links
    system = nominal if case.links == 1 else build_system(run, links)
    values = TRUTH if case.links == 1 else scale_parameters_to_more_links(nominal, system, TRUTH)
    posture = grasping_joint_angles(nominal, TRUTH)
    motion = random_multisine_motion(
        nominal,
        TRUTH,
        seed=motion_seed,
        initial_joint_angles=posture,
        excitation=MultisineOptions(gripper_travel=TRAVEL[1]),
    )
    experiment = VirtualExperimentSettings(
        motion=motion, initial_joint_angles=posture, seed=noise_seed, recording_name=f"motion_{motion_seed}"
    )
    return run_experiment_with_injected_effects(system, values, case.withheld, experiment)


def found(name: str, seeds: Sequence[int], truth: bool = True) -> tuple[DiagnosisResult, float, float]:
    """The diagnosis of a case, how long it took [s], and held-out chi2/n with the true effects in the model.

    NaN instead of the last one without `truth`.
    """
    case = CASES[name]
    estimate, held_out = (record(case, *pair) for pair in zip(seeds, NOISE_SEEDS, strict=True))
    nominal = build_problem(load_config(None, (), SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME))
    problem = EstimationProblem(nominal.step, [estimate], nominal.free, nominal.options)
    everything = [effect.label for effect in make_candidate_effects(problem.system, [estimate], "all")]
    library = [label for label in everything if label.partition("@")[0] not in case.without]
    begun = time.perf_counter()
    finding = diagnose(problem, library, [held_out], thresholds=Thresholds(max_effects=2))
    seconds = time.perf_counter() - begun
    if not truth:
        return finding, seconds, math.nan
    composed = AllCandidatesProblem.from_problem(
        problem, make_candidate_effects(problem.system, [estimate], "all"), [held_out]
    )
    true = [effect for effect in composed.candidate_effects if effect.label in {w.label for w in case.withheld}]
    with threadpoolctl.threadpool_limits(1):
        fit = refit_with_effects(RefitContext(composed), true, finding.nominal_model.values) if true else None
    return finding, seconds, math.nan if fit is None else fit.held_out_loss.chi2_per_sample


def right(case: Case, finding: DiagnosisResult) -> bool:
    """Whether the verdict is what the case deserves: the effect first, or in a set of no more than three."""
    true = {effect.label for effect in case.withheld}
    if case.verdict == "unknown":
        places = {effect.location for effect in case.withheld}
        # places that the data cannot tell apart are said together
        said = {finding.gap_locations[0].location, *finding.gap_locations[0].indistinguishable_from}
        return finding.verdict == "unknown" and bool(said & places)
    if case.verdict == "no_gap":
        return finding.verdict == "no_gap"
    named = [effect.label for effect in finding.accepted_effects]
    if len(true) > 1:
        return true <= set(named)
    rivals = {r.label for r in finding.selected_effects[0].equivalent_effects} if finding.accepted_effects else set()
    return set(named[:1]) == true or (bool(true & rivals) and len(rivals) <= 3)


def rescored(folder: Path, names: Sequence[str], overrides: Sequence[str]) -> int:
    """Recorded cases judged again, beside what was said; how many differ."""
    wanted, differ = load_config(None, overrides, SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME).diagnosis, 0
    changes = {name: getattr(wanted, name) for name in (text.split("=")[0].split(".")[-1] for text in overrides)}
    print("| case | then | now | differs |\n|---|---|---|---|")
    for name in names:
        if not (file := folder / f"{name}.json").exists():
            continue
        data = read_input_json(file)
        now = said(rejudge_diagnosis_evidence(data["evidence"], changes))
        differ += data["said"] != now
        print(f"| {name} | {data['said']} | {now} | {'yes' if data['said'] != now else '-'} |")
    return differ


def said(result: Mapping[str, Any]) -> str:
    """Verdict, effects with those that cannot be told from them, and the first place."""
    sets = [[f"{e['kind']}@{e['location']}" for e in own] for own in result["confusable"]]
    names = [f"{e['kind']}@{e['location']}" for e in result["effects"]]
    told = [" or ".join(next((own for own in sets if own[0] == name), [name])) for name in names]
    return "; ".join([result["verdict"], *told, *(f"at {place['location']}" for place in result["where"][:1])])


def run(name: str, seeds: Sequence[int], record: str = "") -> dict[str, str]:
    case = CASES[name]
    finding, seconds, best = found(name, seeds)
    if record:
        data = {"said": said(finding.to_dict()), "evidence": diagnosis_evidence_to_dict(finding)}
        write_strict_json(Path(record) / f"{name}.json", data)
    truth = " + ".join(effect.label for effect in case.withheld) or "-"
    rivals = "; ".join(
        ", ".join(r.label for r in a.equivalent_effects)
        for a in finding.selected_effects
        if len(a.equivalent_effects) > 1
    )
    closed = [100 * entry.cumulative_closure.fraction for entry in finding.accepted_selected_effects]
    judged = "-" if case.verdict == "-" else "yes" if right(case, finding) else "no"
    return {
        "case": name,
        "truth": truth,
        "verdict": finding.verdict,
        "right": judged,
        "added": ", ".join(effect.label for effect in finding.accepted_effects) or "-",
        "nameless": "-"
        if finding.accepted_effects
        else ", ".join(entry.effect.label for entry in finding.selected_effects) or "-",
        "why": finding.unknown_reason or "-",
        "explained": f"{100 * finding.explained_fraction:.0f} %" if finding.selected_effects else "-",
        "apart": ", ".join(finding.undetermined_sizes(finding.thresholds)) or "-",
        "not separable": rivals if finding.accepted_effects and rivals else "-",
        "where": " or ".join([finding.gap_locations[0].location, *finding.gap_locations[0].indistinguishable_from])
        if finding.gap_locations
        else "-",
        "chi2/n held out": f"{finding.nominal_held_out_test.chi2_per_dof:.3g}",
        "with the truth": "-" if math.isnan(best) else f"{best:.3g}",
        "closure": f"{closed[-1]:.0f} %" if closed else "-",
        "time": f"{seconds:.0f} s",
    }


def main() -> int:
    parser = argparse.ArgumentParser(description="Diagnose injected effects in data from MuJoCo.")
    parser.add_argument("cases", nargs="*", default=list(CASES), help=", ".join(CASES))
    parser.add_argument("--seeds", nargs=2, type=int, default=(1, 7), help="of the two motions")
    parser.add_argument("--json", type=Path, metavar="FILE", help="store the table")
    parser.add_argument("--workers", type=int, default=1, help="cases at once; the times are then longer")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="folder of results, which are not worked out again")
    parser.add_argument("--record", type=Path, metavar="DIR", help="folder for what every rule needs of each case")
    parser.add_argument("--rescore", type=Path, metavar="DIR", help="judge such a folder again instead")
    parser.add_argument("--set", metavar="KEY=VALUE", action="append", default=[], help="a setting for --rescore")
    arguments = parser.parse_args()
    if arguments.rescore is not None:
        print(f"{rescored(arguments.rescore, arguments.cases, arguments.set)} differ")
        return 0
    asked = {"seeds": list(arguments.seeds)}
    if arguments.record is not None:
        asked["record"] = str(make_folder(arguments.record).absolute())
    tasks = [Task(name, {"name": name, **asked}) for name in arguments.cases]
    with tempfile.TemporaryDirectory() as folder:
        results = run_tasks(run, tasks, arguments.keep or Path(folder), WorkerConfig(arguments.workers), show)
    rows = [result.value for result in results if not result.error]
    for i, row in enumerate(rows):
        if i == 0:
            print("| " + " | ".join(row) + " |")
            print("|" + "---|" * len(row))
        print("| " + " | ".join(row.values()) + " |")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return int(len(rows) < len(results))


def show(done: int, total: int, name: str) -> None:
    print(f"{done} of {total}: {name}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
