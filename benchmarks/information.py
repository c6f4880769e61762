"""Planned motions that tell more, recorded in MuJoCo with the configuration's noise.

    python benchmarks/information.py parameter [--starts 20] [--recordings 5]
    python benchmarks/information.py pair [--starts 3] [--case heavy_free_branch] [--share 1]
    python benchmarks/information.py wrist

`parameter`: one arm with a camera (`configs/single_arm_vision.yaml`), whose recording tells T3.bend to some 20 %. Its
solution is where the motion is planned that tells T3.bend best; that motion is recorded in MuJoCo with the true
stiffness and the noise of the shipped recordings, several draws of it, and each recording is solved by itself from
3 N m/rad.

`pair`: an effect of `diagnosis_cases.py`, or a share of its size, is withheld in MuJoCo, and the diagnosis finds
another one as likely. Two motions that tell them apart are planned, recorded with the same effect at work, and
diagnosed beside the first two recordings: one to estimate on, one held out.

`wrist`: relative standard deviations of the stiffnesses of T1 and T3 with and without a wrist force/torque sensor at
every gripper, 100 Hz, noise of 0.1 N and 0.01 N m: at the true values, on the shipped recordings of one and two arms,
which are prescribed, with the efforts' noise and offsets and the encoders' noise that the recordings state.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from baxter import baxter_foam_y_system
from diagnosis_cases import CASES, record
from make_recordings import ROUGH, TRUTH
from planning import PlannedMovement

from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.data.recording import Recording, SensorChannelGroup
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.diagnosis_result import DiagnosisResult
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects import make_effect
from yid_ocp.planning.information_plan import InformativeMotionPlan, plan_informative_motion
from yid_ocp.planning.joint_paths import PlanLimits, PlanOptions
from yid_ocp.problem import EstimationProblem, SensorOptions
from yid_ocp.report.terminal import aligned_table_lines
from yid_ocp.solvers import GaussNewton, Solution, fit_problem
from yid_ocp.virtual.experiment import PointCamera, VirtualExperimentSettings, run_virtual_experiment
from yid_ocp.virtual.injected import InjectedEffect, run_experiment_with_injected_effects
from yid_ocp.virtual.mujoco_simulation import SimulationOptions
from yid_ocp.workflow.build import build_step
from yid_ocp.workflow.build_problem import build_problem, make_problem_options
from yid_ocp.workflow.command_runner import StderrLogLinesProgress
from yid_ocp.workflow.plan import _parameter_and_effect_values
from yid_ocp.workflow.run_inputs import read_recordings_of_role

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "single_arm_vision.yaml"
SOUGHT = "T3.bend"
OPTIONS = PlanOptions(
    goal="information",
    parameters_to_identify=(SOUGHT,),
    duration=3.5,
    hold_duration=0.5,
    n_spline_coefficients=28,
    limits=PlanLimits(max_spring_angle=0.5),
)
NOISE_SEED = 500


def recorded(plan: InformativeMotionPlan, seed: int) -> Recording:
    """The planned motion as the virtual robot carries it out and its sensors see it."""
    movement = PlannedMovement(plan.joint_names, plan.simulator.path, plan.spline_coefficients)
    posture = dict(zip(plan.joint_names, map(float, plan.simulator.moved_joint_start_positions), strict=True))
    simulation = replace(ROUGH.simulation, duration=float(plan.t[-1]))
    experiment = VirtualExperimentSettings(
        motion=movement, initial_joint_angles=posture, simulation=simulation, arm_noise=ROUGH.noise(1),
        camera=PointCamera(), seed=seed,
        recording_name=f"planned_{seed}",
    )  # fmt: skip
    return run_virtual_experiment(baxter_foam_y_system(1), TRUTH, experiment)


def parameter(starts: int, recordings: int) -> None:
    problem = build_problem(load_config(CONFIG))
    solution = fit_problem(problem, GaussNewton(cost_tolerance=1e-5))
    values = {name: entry.value for name, entry in solution.parameters.items() if name in problem.free}
    plan = plan_informative_motion(
        problem, replace(OPTIONS, n_random_starts=starts), values, None, StderrLogLinesProgress()
    )
    rows: list[tuple[str, ...]] = [("", SOUGHT, "± std", "of it", "true value off by")]
    rows.append(_row("the configuration's recording, 5 s", solution))
    for i in range(recordings):
        recording = recorded(plan, NOISE_SEED + i)
        alone = EstimationProblem(problem.step, [recording], problem.free, problem.options)
        rows.append(
            _row(
                f"the planned motion, {recording.duration:g} s, noise {i + 1}",
                fit_problem(alone, GaussNewton(cost_tolerance=1e-5)),
            )
        )
    print("\n".join(aligned_table_lines(rows)))
    known = plan.parameter_precisions[SOUGHT]
    print(
        f"expected: {100 * known.std_recorded:.3g} % before, "
        f"{100 * known.std_planned:.3g} % after, verdict {known.verdict}"
    )
    print(f"starts, nat as judged: {', '.join(f'{start.configured_criterion:.3g}' for start in plan.start_results)}")
    print(f"limits reached: {dict(plan.active_limits)}; unseen: {', '.join(plan.unobservable_parameters)}")


def _row(words: str, solution: Solution) -> tuple[str, ...]:
    entry = solution.parameters[SOUGHT]
    error = (entry.value - TRUTH[SOUGHT]) / entry.std
    return (
        words,
        f"{entry.value:.3g}",
        f"{entry.std:.2g}",
        f"{100 * entry.std / entry.value:.3g} %",
        f"{error:+.2g} std",
    )


def pair(name: str, starts: int, share: float) -> None:
    case = CASES[name]
    case = replace(case, withheld=tuple(_share(effect, share) for effect in case.withheld))
    run = load_config(None, (), SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME)
    nominal = build_problem(run)
    made = [record(case, 1, 401), record(case, 7, 402)]
    before = _diagnosed(nominal, made[:1], made[1:])
    labels = (
        tuple(rival.label for rival in before.selected_effects[0].equivalent_effects) if before.accepted_effects else ()
    )
    print(f"withheld: {', '.join(effect.label for effect in case.withheld)}")
    print(f"before: {before.verdict}, {', '.join(labels)}")
    problem = EstimationProblem(nominal.step, made[:1], nominal.free, nominal.options)
    values, sizes = _parameter_and_effect_values(before.to_dict())
    planned = []
    for seed in (0, 100):
        options = replace(
            OPTIONS, parameters_to_identify=None, effects_to_discriminate=labels, n_random_starts=starts, seed=seed
        )
        plan = plan_informative_motion(problem, options, values, sizes, StderrLogLinesProgress())
        for (first, second), (then, now) in plan.effect_distances.items():
            print(f"seed {seed}: {first} beside {second}: {then:.3g} std in the recording, {now:.3g} in the plan")
        movement = PlannedMovement(plan.joint_names, plan.simulator.path, plan.spline_coefficients)
        posture = dict(zip(plan.joint_names, map(float, plan.simulator.moved_joint_start_positions), strict=True))
        experiment = VirtualExperimentSettings(
            motion=movement, initial_joint_angles=posture, simulation=SimulationOptions(float(plan.t[-1])),
            seed=NOISE_SEED + seed,
            recording_name=f"planned_{seed}",
        )  # fmt: skip
        planned.append(run_experiment_with_injected_effects(baxter_foam_y_system(1), TRUTH, case.withheld, experiment))
    after = _diagnosed(nominal, [made[0], planned[0]], [made[1], planned[1]])
    rivals = [rival.label for rival in after.selected_effects[0].equivalent_effects] if after.accepted_effects else []
    print(f"after: {after.verdict}, {', '.join(rivals)}")
    print(
        "\n".join(
            aligned_table_lines(
                [
                    ("effect", "held-out chi2/n"),
                    *(
                        (f.effects[-1].label, f"{f.held_out_loss.chi2_per_sample:.4f}")
                        for f in after.single_effect_models
                    ),
                ]
            )
        )
    )


def wrist() -> None:
    rows: list[tuple[str, ...]] = [("", *(name for name in TRUTH if not name.startswith("T2")))]
    for noun, name, sides in (("one arm", "single", ("left",)), ("two arms", "dual", ("left", "right"))):
        config = CONFIG.parent / f"{name}_arm_no_vision.yaml"
        asked = ["model.arms.mode=prescribed", "recordings.held_out=[]"]
        [recording] = read_recordings_of_role(load_config(config, asked))
        joints = recording.joints
        assert joints is not None
        frames = tuple(f"{side}_gripper" for side in sides)
        none = np.zeros((len(joints.t), len(frames), 3))  # what is read does not change what it tells
        stds = {"force_std": 0.1, "torque_std": 0.01}
        sensed = SensorChannelGroup("wrist", frames, joints.t, {"force": none, "torque": none}, stds)
        with tempfile.TemporaryDirectory() as folder:
            write_recording(replace(recording, channel_groups=(sensed,), points=()), f"{folder}/sensed.h5")
            run = load_config(config, [*asked, f"recordings.estimate=[{folder}/sensed.h5]"])
            step, [sensed_recording] = build_step(run), read_recordings_of_role(run)
            options = make_problem_options(run, step.system)
        for words, efforts, wrists in (("efforts", True, False), ("wrist", False, True), ("both", True, True)):
            used = {f"wrist.{quantity}": SensorOptions(use=wrists) for quantity in ("force", "torque")}
            used["joints.effort"] = SensorOptions(use=efforts)
            asked_of = replace(options, sensors=used)
            problem = EstimationProblem(step, [sensed_recording], tuple(TRUTH), asked_of)
            evaluation = problem.evaluate(x := np.array([TRUTH[name] for name in problem.free]))
            assert evaluation.jacobian is not None, evaluation.message
            scaled = evaluation.jacobian[problem.residual_rows.data] * x
            # nothing else is known of a stiffness than that it is within a factor of 100
            std = np.sqrt(np.diag(np.linalg.inv(scaled.T @ scaled + 1e-4 * np.eye(len(x)))))
            known = dict(zip(problem.free, std, strict=True))
            cells = (f"{100 * known[name]:.2g} %" if known[name] < 1 else "not" for name in rows[0][1:])
            rows.append((f"{noun}, {words}", *cells))
    print("\n".join(aligned_table_lines(rows)))


def _share(effect: InjectedEffect, share: float) -> InjectedEffect:
    """The same effect, its amplitudes that part of the way from neutral."""
    kind = make_effect(effect.kind, effect.location, baxter_foam_y_system(1))
    names = {name.removeprefix(f"{kind.label}."): name for name in kind.amplitude_parameter_names}
    neutral = {short: kind.neutral_values[name] for short, name in names.items()}
    values = {
        name: neutral[name] + share * (value - neutral[name]) if name in neutral else value
        for name, value in effect.values.items()
    }
    return replace(effect, values=values)


def _diagnosed(nominal: EstimationProblem, estimate: list[Recording], held_out: list[Recording]) -> DiagnosisResult:
    problem = EstimationProblem(nominal.step, estimate, nominal.free, nominal.options)
    return diagnose(problem, "all", held_out, thresholds=Thresholds(), progress=StderrLogLinesProgress())


def main() -> None:
    parser = argparse.ArgumentParser(description="Planned motions that tell more, in MuJoCo.")
    parser.add_argument("what", choices=("parameter", "pair", "wrist"))
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--recordings", type=int, default=5)
    parser.add_argument(
        "--case", default="heavy_free_branch", choices=CASES, metavar="CASE", help="see diagnosis_cases.py"
    )
    parser.add_argument("--share", type=float, default=1.0, help="part of the case's size")
    arguments = parser.parse_args()
    if arguments.what == "parameter":
        parameter(arguments.starts, arguments.recordings)
    elif arguments.what == "wrist":
        wrist()
    else:
        pair(arguments.case, arguments.starts, arguments.share)


if __name__ == "__main__":
    main()
