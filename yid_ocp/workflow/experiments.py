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
from yid_ocp.config.settings import Run
from yid_ocp.data.hdf5 import write_recording
from yid_ocp.diagnosis.blind import PURPOSES, Conditions, Ensemble, first_posture, recorded
from yid_ocp.diagnosis.blind.ensemble import DRAWS
from yid_ocp.errors import ConfigError, ModelError, YidError
from yid_ocp.virtual.engine import INNER_STEP, Simulation
from yid_ocp.virtual.experiment import ArmNoise
from yid_ocp.workflow.build import build_problem, build_system, read_recordings

log = logging.getLogger(__name__)
WHITE, OFFSET = 0.1, 0.3
"""Standard deviations of the torques' white noise and constant offsets where an experiment has any [N m]."""


@dataclass(frozen=True)
class Variation:
    """How an experiment of a blind validation differs from its configuration.

    Attributes
    ----------
    weight : float
        Part of a configuration's cases.
    words : str
    noisy : bool
        Torques with white noise and offsets, both stated.
    step : float
        Of the engine, over the usual one.
    recordings : int
        To estimate on.
    bare : bool
        The arms alone, without an object: their dampings are estimated.
    prescribed : bool
        The arms are moved as measured, and only their efforts are compared.
    """

    weight: float
    words: str
    noisy: bool = False
    step: float = 1.0
    recordings: int = 1
    bare: bool = False
    prescribed: bool = False

    def simulated(self) -> tuple[str, ...]:
        """Setting overrides of the model that simulates the recordings."""
        if not self.bare:
            return ()
        # what is said of the object and of what sees it means nothing here
        return ("model.object=null", "model.grasp={}", "model.points=null", "sensors={}", "parameters={}")

    def diagnosed(self, driven: Sequence[str]) -> tuple[str, ...]:
        """Setting overrides of the model that is diagnosed."""
        own = list(self.simulated())
        if self.bare:
            free = {f"{name}.damping": {"free": True, "bounds": [0.0, 50.0]} for name in driven}
            own += [f"parameters={json.dumps(free)}", "diagnosis.candidates=all"]
        if self.prescribed:
            own.append("model.arms.mode=prescribed")
        return tuple(own)


VARIATIONS: Mapping[str, Variation] = {
    "as_configured": Variation(0.4, "as the configuration has it, torques exact"),
    "torque_noise": Variation(0.2, "torques with noise and offsets", noisy=True),
    "several_recordings": Variation(0.1, "three recordings to estimate on", recordings=3),
    "finer_integration": Variation(0.1, "the other engine's step halved", step=0.5),
    "bare_arm": Variation(0.1, "the arms alone, driven", noisy=True, bare=True),
    "bare_arm_efforts": Variation(0.1, "the arms alone, moved as measured", noisy=True, bare=True, prescribed=True),
}
"""By name; an experiment is `CONFIGURATION.VARIATION`."""


@dataclass(frozen=True)
class Experiment:
    """One experiment of an ensemble, as plain data and paths.

    Attributes
    ----------
    config : Path
    variation : str
    seed : int
    purpose : str
    """

    config: Path
    variation: str
    seed: int
    purpose: str

    @property
    def told(self) -> dict[str, Any]:
        """The experiment as task arguments."""
        return {"config": self.config, "variation": self.variation, "seed": self.seed, "purpose": self.purpose}

    @property
    def conditions(self) -> Conditions:
        """Conditions under which the recordings are simulated, without the camera."""
        varied = VARIATIONS[self.variation]
        noise = ArmNoise(effort=WHITE, effort_bias=OFFSET) if varied.noisy else ArmNoise()
        simulation = Simulation(time_step=INNER_STEP * varied.step)
        return Conditions(varied.recordings, noise, simulation, purpose=self.purpose)

    def simulated(self) -> Run:
        """Settings of the model that simulates the recordings."""
        return load_config(self.config, VARIATIONS[self.variation].simulated())

    def begin(self, file: Path) -> None:
        """Write the first recording, which fixes initial configuration and sensors.

        Raises
        ------
        ConfigError, DataError, ModelError
        """
        varied, run = VARIATIONS[self.variation], load_config(self.config)
        first = read_recordings(run, "estimate")
        if not first:
            raise run.refuse(
                "there is no recording that says where the arms begin", "recordings", "estimate", hint="list one"
            )
        system = build_system(self.simulated())
        vision = not varied.bare and any(group.pose is not None for group in first[0].points)
        values = dict(zip(system.parameters.names, map(float, system.parameters.vector()), strict=True))
        conditions = replace(self.conditions, vision=vision)
        posture = first_posture(system, first[0])
        for attempt in range(DRAWS):
            rng = np.random.default_rng([self.seed, PURPOSES.index(self.purpose), 3, attempt])
            try:
                made = recorded(system, system, posture, values, values, (), rng, conditions)
            except ModelError:
                continue  # the motion throws the object about; draw another
            write_recording(replace(made, name="first", description="", source="", truth={}), file)
            return
        raise ModelError(
            f"none of {DRAWS} motions can be simulated",
            where=f"{self.config.name}, {varied.words}",
            hint="an object that is thrown about needs more damping, or a start of its arms in which it hangs calm",
        )

    def ensemble(self, first: Path) -> tuple[Run, Ensemble]:
        """Settings of the diagnosed model and the ensemble, built from the first recording.

        Raises
        ------
        ConfigError, DataError, ModelError
        """
        return _ensemble(self, first, first.stat().st_mtime_ns)


@functools.lru_cache(maxsize=1)
def _ensemble(experiment: Experiment, first: Path, written: int) -> tuple[Run, Ensemble]:
    """See `Experiment.ensemble`; kept with its compiled step for the next task of the same experiment."""
    varied, simulated_run = VARIATIONS[experiment.variation], experiment.simulated()
    simulated = build_system(simulated_run)
    begun = (f"recordings.estimate=[{json.dumps(str(first))}]", "recordings.held_out=[]")
    run = load_config(experiment.config, (*varied.diagnosed(simulated.driven), *begun))
    problem = build_problem(run)
    finer = (lambda times: build_system(simulated_run, times)) if simulated.segments else None
    ensemble = Ensemble(
        problem,
        experiment.seed,
        finer,
        run.diagnosis.candidates,
        run.diagnosis,
        simulated=simulated,
        conditions=experiment.conditions,
    )
    return run, ensemble


def refuse_unfit(run: Run) -> None:
    """Raise an error for configurations that a blind validation does not support.

    Raises
    ------
    ConfigError
    """
    if run.diagnosis.noise_fraction < 1 or any(entry.std is not None for entry in run.sensors.values()):
        raise run.refuse(
            "virtual recordings have the noise of `virtual_experiment`, not that of these settings",
            "sensors",
            hint="leave sensors.*.std and diagnosis.noise_fraction out",
        )
    system = build_system(run)
    if not system.driven or system.prescribed or system.servos:
        raise ConfigError(
            "a blind proof moves driven arms",
            where=run.where("model", "arms", "mode"),
            allowed="a robot whose arms are driven by torques, nothing prescribed",
        )


def experiments_of(
    configs: Mapping[str, Path], seed: int, purpose: str
) -> tuple[dict[str, Experiment], frozenset[str]]:
    """All experiments by name, and the names of those whose object has divisible links.

    Variations that a configuration does not allow, as one whose frames sit on the object that is taken away, are left
    out.
    """
    found: dict[str, Experiment] = {}
    chains = set()
    for name, config in configs.items():
        whole = load_config(config).model.object is not None
        for variation, varied in VARIATIONS.items():
            if varied.bare and not whole:
                continue  # as the others are
            experiment = Experiment(config, variation, seed, purpose)
            try:
                system = build_system(experiment.simulated())
            except YidError as error:
                log.info("%s.%s is left out: %s", name, variation, error.what)
                continue
            found[f"{name}.{variation}"] = experiment
            if system.segments:
                chains.add(f"{name}.{variation}")
    return found, frozenset(chains)
