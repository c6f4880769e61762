"""Experiments of a blind validation: variations of a configuration and the ensemble of each."""

from __future__ import annotations

import functools
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from yid_ocp.config.reader import load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.data.recording_hdf5 import write_recording
from yid_ocp.diagnosis.blind import (
    ENSEMBLE_PURPOSES,
    CaseGenerator,
    RecordingConditions,
    initial_joint_positions,
    simulate_random_motion,
)
from yid_ocp.diagnosis.blind.ensemble import MAX_CASE_DRAWS
from yid_ocp.errors import ConfigError, ModelError, YidError
from yid_ocp.virtual.experiment import ArmSensorNoise
from yid_ocp.virtual.mujoco_simulation import DEFAULT_SIMULATOR_STEP, SimulationOptions
from yid_ocp.workflow.build import build_system
from yid_ocp.workflow.build_problem import build_problem
from yid_ocp.workflow.run_inputs import read_recordings

log = logging.getLogger(__name__)
_TORQUE_NOISE_STD, _TORQUE_OFFSET_STD = 0.1, 0.3
"""Standard deviations of the torques' white noise and constant offsets where an experiment has any [N m]."""


@dataclass(frozen=True)
class _ExperimentVariation:
    """How an experiment of a blind validation differs from its configuration."""

    case_fraction: float
    description: str
    has_torque_noise: bool = False
    time_step_factor: float = 1.0
    n_recordings: int = 1
    is_without_object: bool = False
    has_prescribed_arms: bool = False

    def simulation_overrides(self) -> tuple[str, ...]:
        """Setting overrides of the model that simulates the recordings."""
        if not self.is_without_object:
            return ()
        # what is said of the object and of what sees it means nothing here
        return ("model.object=null", "model.grasp={}", "model.points=null", "sensors={}", "parameters={}")

    def diagnosis_overrides(self, driven: Sequence[str]) -> tuple[str, ...]:
        """Setting overrides of the model that is diagnosed."""
        own = list(self.simulation_overrides())
        if self.is_without_object:
            free = {f"{name}.damping": {"free": True, "bounds": [0.0, 50.0]} for name in driven}
            own += [f"parameters={json.dumps(free)}", "diagnosis.candidates=all"]
        if self.has_prescribed_arms:
            own.append("model.arms.mode=prescribed")
        return tuple(own)


EXPERIMENT_VARIATIONS: Mapping[str, _ExperimentVariation] = {
    "as_configured": _ExperimentVariation(0.4, "as the configuration has it, torques exact"),
    "torque_noise": _ExperimentVariation(0.2, "torques with noise and offsets", has_torque_noise=True),
    "several_recordings": _ExperimentVariation(0.1, "three recordings to estimate on", n_recordings=3),
    "finer_integration": _ExperimentVariation(0.1, "the other engine's step halved", time_step_factor=0.5),
    "bare_arm": _ExperimentVariation(0.1, "the arms alone, driven", has_torque_noise=True, is_without_object=True),
    "bare_arm_efforts": _ExperimentVariation(
        0.1,
        "the arms alone, moved as measured",
        has_torque_noise=True,
        is_without_object=True,
        has_prescribed_arms=True,
    ),
}
"""By name; an experiment is `CONFIGURATION.VARIATION`."""


@dataclass(frozen=True)
class BlindExperiment:
    """One experiment of an ensemble, as plain data and paths."""

    config_file: Path
    variation: str
    seed: int
    purpose: str

    @property
    def task_arguments(self) -> dict[str, Any]:
        """The experiment as task arguments."""
        return {"config": self.config_file, "variation": self.variation, "seed": self.seed, "purpose": self.purpose}

    @property
    def recording_conditions(self) -> RecordingConditions:
        """Conditions under which the recordings are simulated, without the camera."""
        varied = EXPERIMENT_VARIATIONS[self.variation]
        noise = (
            ArmSensorNoise(effort_std=_TORQUE_NOISE_STD, effort_bias_std=_TORQUE_OFFSET_STD)
            if varied.has_torque_noise
            else ArmSensorNoise()
        )
        simulation = SimulationOptions(time_step=DEFAULT_SIMULATOR_STEP * varied.time_step_factor)
        return RecordingConditions(varied.n_recordings, noise, simulation, purpose=self.purpose)

    def simulation_settings(self) -> RunSettings:
        """Settings of the model that simulates the recordings."""
        return load_config(self.config_file, EXPERIMENT_VARIATIONS[self.variation].simulation_overrides())

    def write_first_recording(self, file: Path) -> None:
        """Write the first recording, which fixes initial configuration and sensors.

        Raises
        ------
        ConfigError, DataError, ModelError
        """
        varied, run = EXPERIMENT_VARIATIONS[self.variation], load_config(self.config_file)
        first = read_recordings(run, "estimate")
        if not first:
            raise run.config_error(
                "there is no recording that says where the arms begin", "recordings", "estimate", hint="list one"
            )
        system = build_system(self.simulation_settings())
        vision = not varied.is_without_object and any(group.pose is not None for group in first[0].points)
        values = dict(zip(system.parameters.names, map(float, system.parameters.vector()), strict=True))
        conditions = replace(self.recording_conditions, has_camera=vision)
        posture = initial_joint_positions(system, first[0])
        for attempt in range(MAX_CASE_DRAWS):
            rng = np.random.default_rng([self.seed, ENSEMBLE_PURPOSES.index(self.purpose), 3, attempt])
            try:
                made = simulate_random_motion(system, system, posture, values, values, (), rng, conditions)
            except ModelError:
                continue  # the motion throws the object about; draw another
            write_recording(replace(made, name="first", description="", source="", true_parameters={}), file)
            return
        hint = "an object that is thrown about needs more damping, or a start of its arms in which it hangs calm"
        what = f"none of {MAX_CASE_DRAWS} motions can be simulated"
        raise ModelError(what, where=f"{self.config_file.name}, {varied.description}", hint=hint)

    def build_ensemble(self, first: Path) -> tuple[RunSettings, CaseGenerator]:
        """Settings of the diagnosed model and the ensemble, built from the first recording.

        Raises
        ------
        ConfigError, DataError, ModelError
        """
        return _ensemble(self, first, first.stat().st_mtime_ns)


@functools.lru_cache(maxsize=1)
def _ensemble(experiment: BlindExperiment, first: Path, written: int) -> tuple[RunSettings, CaseGenerator]:
    """See `BlindExperiment.build_ensemble`; kept with its compiled step for the next task of the same experiment."""
    varied, simulated_run = EXPERIMENT_VARIATIONS[experiment.variation], experiment.simulation_settings()
    simulated = build_system(simulated_run)
    begun = (f"recordings.estimate=[{json.dumps(str(first))}]", "recordings.held_out=[]")
    run = load_config(experiment.config_file, (*varied.diagnosis_overrides(simulated.driven), *begun))
    problem = build_problem(run)
    finer = (lambda times: build_system(simulated_run, times)) if simulated.segment_layouts else None
    ensemble = CaseGenerator(
        problem,
        experiment.seed,
        finer,
        run.diagnosis.candidates,
        run.diagnosis,
        simulated_system=simulated,
        conditions=experiment.recording_conditions,
    )
    return run, ensemble


def require_blind_compatible(run: RunSettings) -> None:
    """Raise an error for configurations that a blind validation does not support.

    Raises
    ------
    ConfigError
    """
    if run.diagnosis.noise_fraction < 1 or any(entry.std is not None for entry in run.sensors.values()):
        what = "virtual recordings have the noise of `run_virtual_experiment`, not that of these settings"
        raise run.config_error(what, "sensors", hint="leave sensors.*.std and diagnosis.noise_fraction out")
    system = build_system(run)
    if not system.driven or system.prescribed or system.servos:
        allowed = "a robot whose arms are driven by torques, nothing prescribed"
        where = run.describe_location("model", "arms", "mode")
        raise ConfigError("a blind proof moves driven arms", where=where, allowed=allowed)


def list_experiments(
    configs: Mapping[str, Path], seed: int, purpose: str
) -> tuple[dict[str, BlindExperiment], frozenset[str]]:
    """All experiments by name, and the names of those whose object has divisible links.

    Variations that a configuration does not allow, as one whose frames sit on the object that is taken away, are left
    out.
    """
    found: dict[str, BlindExperiment] = {}
    chains = set()
    for name, config in configs.items():
        whole = load_config(config).model.object is not None
        for variation, varied in EXPERIMENT_VARIATIONS.items():
            if varied.is_without_object and not whole:
                continue  # as the others are
            experiment = BlindExperiment(config, variation, seed, purpose)
            try:
                system = build_system(experiment.simulation_settings())
            except YidError as error:
                log.info("%s.%s is left out: %s", name, variation, error.what)
                continue
            found[f"{name}.{variation}"] = experiment
            if system.segment_layouts:
                chains.add(f"{name}.{variation}")
    return found, frozenset(chains)
