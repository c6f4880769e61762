"""Questions with a known answer on real recordings: what is said, how sure, how far off, at what cost.

    python benchmarks/real.py [QUESTION ...] [--json FILE] [--keep DIR]

The recordings stand in ../shared/recordings beside the repository; a question without them is skipped. Every question
is a command of a shipped configuration with the same thresholds as everything else. `z` is (said - true) over ±. With
`--json` answers are added to those that the file has, so that questions can be asked one by one. `--keep` stores what
`ablation.py` needs to judge them again.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from yid_ocp import DiagnosisResult, load_config
from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME
from yid_ocp.diagnosis.blind_scores import diagnosis_evidence_to_dict
from yid_ocp.workflow.command_runner import CommandOutcome
from yid_ocp.workflow.diagnose import run_diagnose
from yid_ocp.workflow.solve import run_solve

REPOSITORY = Path(__file__).resolve().parents[1]
RECORDINGS = REPOSITORY.parent / "shared" / "recordings"
_PANDA = ("diagnosis.max_effects=1", "model.frames={}")
_BARE_PANDA = (
    *("model.object=null", *_PANDA, "parameters={}"),
    "parameters={panda_*.damping: {free: true}, effort_offset@*: {free: true}}",
)
_PANDA_MOTIONS = [RECORDINGS / "panda_beam" / f"ocp_z_{name}" for name in ("15cm_0.42s", "25cm_0.50s", "35cm_0.61s")]
# friction that holds a joint differs from stop to stop: the estimate has every motion once, its repetition is held out
_PANDA_FRICTION = (
    "model.friction={law: presliding}",
    f"recordings.estimate=[{', '.join(f'{motion}_1.h5' for motion in _PANDA_MOTIONS)}]",
    f"recordings.held_out=[{', '.join(f'{motion}_2.h5' for motion in _PANDA_MOTIONS)}]",
)
_SERVO = RECORDINGS / "servo_pendulum"
_ROTOR_ESTIMATE = (
    *("sines_100", "sines_400", "sweep_100", "lift_100", "lift_400", "drop_400", "up_down_100", "up_down_400"),
)


@dataclass(frozen=True)
class Question:
    """A diagnosis of a configuration with settings, the quantity of interest, and its true value or range."""

    configuration: str
    needs: str  # folder of the recordings
    settings: tuple[str, ...] = ()
    asked: str = ""  # kind.parameter of a candidate; empty where nothing is to be named
    true: tuple[float, float] | None = None  # lowest and highest
    baseline: tuple[str, ...] | None = None  # settings of a `solve` that comes before


def _files(*names: str) -> str:
    return f"[{', '.join(str(_SERVO / f'{name}.h5') for name in names)}]"


QUESTIONS: Mapping[str, Question] = {
    "panda, weight withheld": Question(
        "panda_beam.yaml",
        "panda_beam",
        ("model.object.gravity_fraction=0", *_PANDA),
        "gravity_scale.fraction",
        (1.0, 1.0),
    ),
    "panda, weight withheld, friction": Question(
        "panda_beam.yaml",
        "panda_beam",
        ("model.object.gravity_fraction=0", *_PANDA, *_PANDA_FRICTION),
        "gravity_scale.fraction",
        (1.0, 1.0),
    ),
    "panda, beam left out": Question("panda_beam.yaml", "panda_beam", _BARE_PANDA, "payload.mass", (0.33, 0.33)),
    "panda, beam left out, friction": Question(
        "panda_beam.yaml", "panda_beam", (*_BARE_PANDA, *_PANDA_FRICTION), "payload.mass", (0.33, 0.33)
    ),
    "soft beam, load withheld": Question(
        "soft_beam.yaml",
        "soft_beam",
        (f"recordings.estimate=[{RECORDINGS / 'soft_beam' / 'beam_load52_a.h5'}]",),
        "point_mass.mass",
        (0.052, 0.052),
        (),
    ),
    "servo, friction withheld": Question(
        "servo_pendulum.yaml", "servo_pendulum", ("model.friction={law: viscous}",), "joint_load_friction.share"
    ),
    "servo, gain of 400 is 100": Question(
        "servo_pendulum.yaml",
        "servo_pendulum",
        (
            f"recordings.estimate={_files('sines_100', 'sweep_100', 'lift_100', 'drop_100')}",
            f"recordings.held_out={_files('up_down_100')}",
            'parameters={"*.servo_gain_factor": {initial: 400}}',
        ),
        "servo_gain.scale",
        (0.25, 0.25),
        (
            f"recordings.estimate={_files('sines_400', 'sweep_400', 'lift_400', 'drop_400')}",
            f"recordings.held_out={_files('up_down_400')}",
        ),
    ),
    "servo, 0.30 kg of 0.49": Question(
        "servo_pendulum.yaml",
        "servo_pendulum",
        (
            f"recordings.estimate={_files('sines_400', 'sweep_100', 'lift_400', 'drop_100')}",
            f"recordings.held_out={_files('up_down_100')}",
            'parameters={"joint.mass": {initial: 0.30}}',
        ),
        "payload.mass",
        (0.19, 0.19),
        (
            f"recordings.estimate={_files('sines_100', 'sweep_400', 'lift_100', 'drop_400', 'up_down_400')}",
            "recordings.held_out=[]",
        ),
    ),
    "servo, 0.30 kg of 0.49, no baseline": Question(
        "servo_pendulum.yaml",
        "servo_pendulum",
        ('parameters={"joint.mass": {initial: 0.30}}',),
        "payload.mass",
        (0.19, 0.19),
    ),
    "servo, rotor inertia withheld": Question(
        "servo_pendulum.yaml",
        "servo_pendulum",
        (
            "model.effects=[{kind: encoder_offset, location: joint}]",
            "parameters={}",
            "parameters={joint.servo_gain: {free: true}, joint.servo_damping: {free: true}}",
            "parameters={joint.servo_delay: {free: true}, joint.servo_torque_limit: {free: true}}",
            "parameters={encoder_offset@joint.offset: {free: true, initial: -0.03}}",
            f"recordings.estimate={_files(*_ROTOR_ESTIMATE)}",
            f"recordings.held_out={_files('sweep_400', 'drop_100')}",  # fast enough to feel the inertia
            "diagnosis.max_effects=1",
        ),
        "rotor_inertia.armature",
        (0.0015, 0.0022),
    ),
    "servo, nothing withheld": Question("servo_pendulum.yaml", "servo_pendulum"),
    "baxter": Question("baxter_arm.yaml", "baxter"),
    "double pendulum": Question("double_pendulum.yaml", "double_pendulum"),
}


def _diagnosed(question: Question, folder: Path) -> CommandOutcome[DiagnosisResult]:
    file, settings = REPOSITORY / "configs" / question.configuration, question.settings
    if question.baseline is not None:
        run_solve(load_config(file, question.baseline), folder / "baseline")
        settings = (*settings, f"diagnosis.baseline_run_folders=[{folder / 'baseline'}]")
    return run_diagnose(load_config(file, settings, SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME), folder / "run")


def asked(name: str, keep: Path | None) -> dict[str, Any]:
    """Answer to a question as a row of the table; numbers that the verdict depends on go into the folder `keep`."""
    question, begun = QUESTIONS[name], os.times()
    with tempfile.TemporaryDirectory() as folder:
        outcome = _diagnosed(question, Path(folder))
    found = outcome.result
    if keep is not None:
        keep.mkdir(parents=True, exist_ok=True)
        said = {key: found[key] for key in ("verdict", "effects", "confusable")}
        judged = {"value": {"said": said, "evidence": diagnosis_evidence_to_dict(outcome.output)}}
        (keep / f"{name}.json").write_text(json.dumps(judged), encoding="utf-8")
    ended = os.times()
    named = [f"{effect['kind']}@{effect['location']}" for effect in found["effects"]]
    kind, _, parameter = question.asked.partition(".")
    first = next((entry for entry in found["which"] if entry["kind"] == kind), None)
    value = None if first is None else first["parameters"][parameter]
    row: dict[str, Any] = {"question": name, "verdict": found["verdict"], "named": ", ".join(named) or "-"}
    ends = " to ".join(dict.fromkeys(f"{end:g}" for end in question.true or ()))
    row |= {"truth": f"{question.asked} = {ends}" if ends else "-"}
    row |= {"said": "-", "±": None, "z": None, "closes": None}
    if value is not None and first is not None:
        row |= {"said": value["value"], "±": value["std"], "closes": first["closure"]}
        if question.true is not None and value["std"]:
            low, high = question.true
            off = value["value"] - min(max(value["value"], low), high)
            row["z"] = off / value["std"]
    law = found["law"]
    row["law"] = "-" if law is None else f"{law['depends_on']}@{law['location']}, {100 * law['closure']:.0f} %"
    row["CPU [s]"] = round(sum(ended[:4]) - sum(begun[:4]))
    return row


def _cell(value: Any) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) and math.isfinite(value) else str(value)


def main() -> int:
    parser = argparse.ArgumentParser(description="Questions with a known answer on real recordings.")
    parser.add_argument("questions", nargs="*", default=list(QUESTIONS), help=", ".join(QUESTIONS))
    parser.add_argument("--json", type=Path, metavar="FILE", help="answers, added to those that it has")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="folder for the numbers behind the verdicts")
    arguments = parser.parse_args()
    if unknown := sorted({*arguments.questions} - {*QUESTIONS}):
        parser.error(f"unknown: {', '.join(unknown)}; allowed are {', '.join(QUESTIONS)}")
    file: Path | None = arguments.json
    rows: dict[str, Any] = json.loads(file.read_text()) if file is not None and file.exists() else {}
    for name in arguments.questions:
        if not (RECORDINGS / QUESTIONS[name].needs).is_dir():
            print(f"{name}: skipped, there is no {RECORDINGS / QUESTIONS[name].needs}", file=sys.stderr)
            continue
        rows[name] = row = asked(name, arguments.keep)
        row["date"] = time.strftime("%Y-%m-%d")
        if file is not None:
            file.write_text(json.dumps(rows, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for i, row in enumerate(rows.values()):
        if i == 0:
            print("| " + " | ".join(row) + " |")
            print("|" + "---|" * len(row))
        print("| " + " | ".join(map(_cell, row.values())) + " |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
