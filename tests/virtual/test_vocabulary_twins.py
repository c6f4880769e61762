"""A small arm moved by MuJoCo with something wrong about it, which the library's equations find back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from yid_ocp.data.recording import Recording
from yid_ocp.diagnosis.diagnose import fit_nominal_model
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.diagnosis.refit import RefittedModel, refit_with_effects
from yid_ocp.diagnosis.screening import screen_candidates
from yid_ocp.effects import make_effect
from yid_ocp.errors import ModelError
from yid_ocp.integrator.step import compile_step
from yid_ocp.model import Mechanism, System
from yid_ocp.model.mechanism import Frame, Inertia, Joint, Placement
from yid_ocp.model.rotations import homogeneous_transform
from yid_ocp.problem import EstimationProblem, ProblemOptions
from yid_ocp.solvers import GaussNewton, solve
from yid_ocp.virtual.experiment import ArmSensorNoise, VirtualExperiment
from yid_ocp.virtual.injected import InjectedEffect, _InjectedTerms, run_experiment_with_effects
from yid_ocp.virtual.mjcf import compile_mjcf, mujoco_xml
from yid_ocp.virtual.mujoco_simulation import SimulationOptions

POSTURE = {"shoulder": 0.4, "elbow": 0.7}


def arm(mode: str = "driven") -> System:
    """Two joints across each other, 0.3 m links of 1 kg, a hand at the end."""
    along = Placement.from_matrix(homogeneous_transform(np.eye(3), [0.0, 0.0, 0.3]))
    body = Inertia.from_values(1.0, [0.0, 0.01, 0.15], np.diag([9e-3, 8e-3, 2e-3]))
    joints = (
        Joint("shoulder", "revolute", -1, Placement.identity(), (0.0, 1.0, 0.0), (body,)),
        Joint("elbow", "revolute", 0, along, (1.0, 0.0, 0.0), (body,)),
    )
    frames = {"upper": Frame(0, Placement.identity()), "hand": Frame(1, along)}
    return System.build(Mechanism("arm", joints, frames), damping=0.1, point_frames=(), **{mode: [*POSTURE]})


def recorded(effects: list[InjectedEffect], seed: int = 1, duration: float = 1.6) -> Recording:
    noise = ArmSensorNoise(position_std=5e-5, velocity_std=1e-3, effort_std=0.0)
    simulation = SimulationOptions(duration, time_step=2.5e-4)
    experiment = VirtualExperiment(None, POSTURE, simulation, noise, camera=None, seed=seed)
    return run_experiment_with_effects(arm(), {}, effects, experiment)


def fitted(kind: str, place: str, recording: Recording, mode: str, **start: float) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of an effect's quantities, fitted beside the dampings."""
    system = arm(mode)
    effect = make_effect(kind, place, system, start)
    step = compile_step(system.with_effects([effect]), 0.01, use_compiler=False)
    free = (*effect.parameters.names, "shoulder.damping", "elbow.damping")
    problem = EstimationProblem(step, [recording], free, ProblemOptions(path_cutoff=20.0))
    found = solve(problem, GaussNewton(max_iterations=25))
    values = dict(zip(found.unknown_names, found.x, strict=True))
    stds = {name: found.std[name] for name in effect.parameters.names}
    return {name: (entry.value, entry.std) for name, entry in effect.reported_parameters(values, stds).items()}


def agrees(found: tuple[float, float], true: float, rel: float = 0.0) -> bool:
    """Within three standard deviations, or a small part of the value that steps of different lengths make."""
    return abs(found[0] - true) <= max(3 * found[1], rel * abs(true))


@pytest.mark.parametrize(
    "values",
    [{"mass": 0.4, "mx": 0.02, "my": -0.03, "mz": 0.02}, {"mass": -0.3, "mx": 0.0, "my": -0.003, "mz": 0.03}],
    ids=["added", "taken away"],
)
def test_a_payload_is_found_with_its_place(values) -> None:
    found = fitted("payload", "hand", recorded([InjectedEffect("payload", "hand", values)]), "prescribed")
    for name, true in values.items():
        assert agrees(found[name], true, 2e-3), name
        assert found[name][1] < 0.01, name


def test_a_payload_that_cannot_be_is_refused() -> None:
    system = arm()
    for values, text in (({"mass": 0.01, "mx": 0.05}, "too far"), ({"mass": -0.9, "mz": 0.0}, "more is taken away")):
        model = compile_mjcf(mujoco_xml(system, {}))
        with pytest.raises(ModelError, match=text):
            _InjectedTerms(system, {}, [InjectedEffect("payload", "hand", values)]).edit_model(model)


def test_friction_that_holds_is_found() -> None:
    recording = recorded([InjectedEffect("joint_presliding", "elbow", {"tau_c": 0.5, "yield_angle": 0.01})])
    found = fitted("joint_presliding", "elbow", recording, "prescribed")
    assert agrees(found["tau_c"], 0.5, 5e-3)
    assert agrees(found["yield_angle"], 0.01, 0.02)


def test_torque_that_follows_its_command_late_is_found() -> None:
    """The other engine lets the torque creep at every inner step, the library in closed form from sample to sample."""
    recording = recorded([InjectedEffect("effort_lag", "elbow", {"time_constant": 0.02})])
    assert agrees(fitted("effort_lag", "elbow", recording, "driven")["time_constant"], 0.02, 3e-3)
    assert agrees(fitted("effort_lag", "elbow", recording, "prescribed")["time_constant"], 0.02, 0.1)


def test_a_sensor_that_follows_the_effort_late_is_found() -> None:
    """Of a prescribed joint a negative time constant; here the measured effort is filtered sample by sample."""
    recording = recorded([])
    true, decay = recording.joints.effort[:, 1], np.exp(-0.01 / 0.03)
    effort = recording.joints.effort.copy()
    for k in range(len(true) - 1):
        # the torque is held from sample to sample
        effort[k + 1, 1] = true[k] + (effort[k, 1] - true[k]) * decay
    late = replace(recording, joints=replace(recording.joints, effort=effort, effort_kind="sample"))
    found, there = (fitted("effort_lag", "elbow", r, "prescribed")["time_constant"] for r in (late, recording))
    assert agrees(found, -0.03, 0.1)
    assert found[0] < -3 * found[1]
    assert abs(there[0]) < 3 * there[1] + 0.003


def refitted(effect: InjectedEffect) -> tuple[RefittedModel, RefittedModel]:
    """The nominal fit of an arm that is moved as measured, and a refit from where its screening leads."""
    system = arm("prescribed")
    runs = [recorded([effect], seed, 1.0) for seed in (1, 2)]
    step = compile_step(system, 0.01, use_compiler=False)
    nominal = EstimationProblem(step, runs[:1], ("shoulder.damping", "elbow.damping"), ProblemOptions(path_cutoff=20.0))
    composed = AllCandidatesProblem.from_problem(nominal, [make_effect(effect.kind, effect.location, system)], runs[1:])
    start = fit_nominal_model(nominal, composed)
    [score] = screen_candidates(composed, (), start.values).candidate_scores
    found = refit_with_effects(composed, composed.candidate_effects, {**start.values, **score.predicted_values})
    assert found is not None
    return start, found


def test_a_flipped_sign_is_found_where_efforts_are_compared() -> None:
    """Downhill from 1 lies a gain without end; the refit of a diagnosis begins at -1 as well."""
    start, found = refitted(InjectedEffect("effort_gain", "elbow", {"scale": -1.0}))
    assert found.reported_parameters(found.effects[0])["scale"].value == pytest.approx(-1.0, abs=0.01)
    assert found.held_out_loss.chi2_per_sample < 0.01 * start.held_out_loss.chi2_per_sample


def test_a_load_far_out_is_not_found_as_one_that_is_missing() -> None:
    """Next to no mass it has no second moment: downhill lies a mass of -0.29 kg that leaves 160 times the error."""
    values = {"mass": 0.1, "mx": -0.03, "my": -0.05, "mz": 0.01}
    start, found = refitted(InjectedEffect("payload", "hand", values))
    for name, reported in found.reported_parameters(found.effects[0]).items():
        assert reported.value == pytest.approx(values[name], rel=0.05), name
    assert found.held_out_loss.chi2_per_sample < 0.01 * start.held_out_loss.chi2_per_sample
