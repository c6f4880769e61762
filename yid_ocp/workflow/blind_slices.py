"""Functions that write slices (parts) of a blind validation with hashes, and that join, score or rejudge them."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from yid_ocp.config.reader import SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME, load_config
from yid_ocp.config.settings import RunSettings
from yid_ocp.diagnosis import blind, blind_scores
from yid_ocp.display import NULL_PROGRESS, Progress
from yid_ocp.errors import DataError
from yid_ocp.files import make_folder, read_input_json, read_input_text, to_json_types, write_strict_json, write_text
from yid_ocp.report.diagnosis_summaries import blind_validation_markdown_lines
from yid_ocp.report.html import write_report
from yid_ocp.report.png_figures import draw_blind_validation_figures
from yid_ocp.report.sections import ReportData
from yid_ocp.version import package_source_hash
from yid_ocp.workflow.command_runner import CommandOutcome
from yid_ocp.workflow.run_folder import current_local_time_text

_SLICE_FORMAT = "yid-blind-slice/1"
_COMMON_KEYS = ("cases", "seed", "purpose", "configs", "code", "code_of_cases")  # the same in all slices of an ensemble


def write_slice_results(found: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Write a slice of a blind validation (labels, answers, hashes) to `slice.json`, and return what was written."""
    written: dict[str, Any] = to_json_types({"format": _SLICE_FORMAT, **found})
    written["ensemble_sha256"] = _ensemble_sha256(written)
    write_strict_json(folder / "slice.json", written)
    return written


def _ensemble_sha256(part: Mapping[str, Any]) -> str:
    """Return a hash of what all slices of one ensemble share: cases, seed, settings, sources, number of slices."""
    text = json.dumps([*[part[key] for key in _COMMON_KEYS], str(part["slice"]).partition("/")[2]], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def score_joined_slices(
    files: Sequence[str | Path], out: str | Path, progress: Progress = NULL_PROGRESS
) -> CommandOutcome[None]:
    """Join slices (separately computed parts) of a blind validation, given as files or folders, and score all cases.

    `out` receives the files of a whole ensemble without recordings, so that the ensemble can be judged again. Raises
    `DataError` if a slice belongs to another ensemble or is given twice, or if labels were changed.
    """
    found: list[dict[str, Any]] = []
    for file in files:
        path = Path(file) / "slice.json" if Path(file).is_dir() else Path(file)
        part = {} if Path(file).is_dir() and not path.exists() else read_input_json(path)
        if part.get("format") != _SLICE_FORMAT:
            what, hint = "this is no slice of a blind test", "give a folder of `yid-ocp blind`, or its slice.json"
            raise DataError(what, where=str(file), allowed=f"a file of the format {_SLICE_FORMAT}", hint=hint)
        _, digest = blind.labels_json_and_sha256(_labels(part))
        if digest != part["labels_sha256"] or _ensemble_sha256(part) != part["ensemble_sha256"]:
            what, hint = "the labels or settings do not match the hashes in the file", "copy the original file again"
            raise DataError(what, where=str(path), allowed="slice.json as `yid-ocp blind` wrote it", hint=hint)
        if found and part["ensemble_sha256"] != found[0]["ensemble_sha256"]:
            differing = [key for key in _COMMON_KEYS if part[key] != found[0][key]] or ["the number of parts"]
            what = f"{file} and {files[0]} are parts of different blind tests; what differs: {', '.join(differing)}"
            allowed, hint = "parts of one blind test", "join parts of one command, which differ in --slice only"
            raise DataError(what, where=str(path), allowed=allowed, hint=hint)
        if part["slice"] in [own["slice"] for own in found]:
            what, allowed = f"part {part['slice']} of the blind test is given twice", "every part once"
            raise DataError(what, where=str(path), allowed=allowed, hint=f"leave {file} out")
        found.append(part)
    folder, first = make_folder(out), found[0]
    for name in ("configs", "sealed", "answers", "best"):
        make_folder(folder / name)
    for name, config in first["configs"].items():
        write_text(folder / "configs" / f"{name}.yaml", config)
    text, digest = blind.labels_json_and_sha256([label for part in found for label in _labels(part)])
    write_text(folder / "sealed/labels.json", text)
    told = {key: first[key] for key in ("cases", "seed", "purpose", "configs")} | {"code": first["code_of_cases"]}
    write_strict_json(folder / "commitment.json", {**told, "sha256": digest, "slice": "joined"})
    for part in found:
        cases = [label["case"] for label in part["labels"]]
        for name, values in (("answers", dict(zip(cases, part["answers"], strict=True))), ("best", part["best"])):
            for case, value in values.items():
                write_strict_json(folder / name / f"{case}.json", {"name": case, "value": value})
    # only a calibration needs its settings, whose keys may be those of an earlier version
    needed = first["configs"] if first["purpose"] == blind.BLIND_ENSEMBLE_PURPOSES[1] else ()
    runs = [load_config(folder / "configs" / f"{name}.yaml") for name in needed]
    return score_whole_ensemble(found, folder, runs, progress)


def _labels(part: Mapping[str, Any]) -> list[blind.CaseGroundTruth]:
    return [blind.CaseGroundTruth.from_dict(own) for own in part["labels"]]


def score_whole_ensemble(
    parts: Sequence[Mapping[str, Any]], folder: Path, runs: Sequence[RunSettings], progress: Progress
) -> CommandOutcome[None]:
    """Score all diagnoses in `parts` (contents of slices) against their labels, and write the results to `folder`."""
    first, pairs = parts[0], [pair for part in parts for pair in zip(_labels(part), part["answers"], strict=True)]
    best = {case: value for part in parts for case, value in part["best"].items()}
    pairs.sort(key=lambda pair: pair[0].case)
    labels, answers = [label for label, _ in pairs], [found for _, found in pairs]
    marks = [
        blind_scores.score_blind_case(label, found["result"], best.get(label.case, math.nan), float(found["seconds"]))
        for label, found in pairs
    ]
    own = "seed", "purpose", "code", "code_of_cases", "command", "versions"
    result = blind_scores.blind_case_score_summary(marks) | {
        **{key: first[key] for key in (*own, "ensemble_sha256")},
        "slices": [part["slice"] for part in parts],
        "date": current_local_time_text(),
    }
    if first["purpose"] == blind.BLIND_ENSEMBLE_PURPOSES[1]:
        found = blind_scores.calibrate_thresholds(labels, marks, answers, runs[0].diagnosis)
        result["calibration_of_thresholds"] = found
        made = {key: result[key] for key in ("cases", "seed", "code", "code_of_cases", "command", "date", "versions")}
        write_strict_json(folder / "thresholds.json", to_json_types(found | made))
    written, pictures = _write_result(folder, result)
    if all(entry.output.write_report for entry in runs):
        progress.begin_stage("writing the report")
        said = f"{written['cases']} synthetic cases, diagnosed without their labels, which were opened afterwards."
        data = ReportData(folder.name, said, written, section_data={"pictures": pictures})
        write_report(folder / "report.html", data)
    return CommandOutcome(folder, written, None)


def _write_result(folder: Path, result: Mapping[str, Any]) -> tuple[dict[str, Any], list[Path]]:
    written: dict[str, Any] = to_json_types(result)
    write_strict_json(folder / "result.json", written)
    write_text(folder / "table.md", "\n".join(blind_validation_markdown_lines(written)) + "\n")
    return written, draw_blind_validation_figures(folder, written)


def rescore_blind(
    folder: str | Path, out: str | Path, overrides: Sequence[str] = (), progress: Progress = NULL_PROGRESS
) -> CommandOutcome[None]:
    """Judge finished cases of a blind validation again, with the present rules and the thresholds in `overrides`.

    Nothing is refitted. `out` receives `result.json` (`yid-blind/1`): `rescored` lists the cases whose verdict or
    effects change, `not_judged` counts the cases that need a refit that the original diagnosis did not make.
    """
    made, target = Path(folder), make_folder(out)
    if not (made / "commitment.json").is_file():
        what, allowed = f"{made} has no cases of a blind test", "a folder with commitment.json"
        raise DataError(what, where="--rescore", allowed=allowed, hint="give the folder that `yid-ocp blind` printed")
    commitment = read_input_json(made / "commitment.json")
    opened = blind.read_labels_checking_sha256(read_input_text(made / "sealed/labels.json"), commitment["sha256"])
    labels = {label.case: label for label in opened}
    wanted = load_config(None, overrides, SHIPPED_DIAGNOSIS_CONFIG_FILE_NAME).diagnosis
    names = [text.partition("=")[0].removeprefix("diagnosis.") for text in overrides]
    changes = {name: getattr(wanted, name) for name in names if hasattr(wanted, name)}
    marks, changed = [], []
    answers, best = _stored_values(made / "answers"), _stored_values(made / "best")
    progress.begin_stage(f"comparing with the labels {len(answers)} of {commitment['cases']} cases")
    for case, found in sorted(answers.items()):
        label, then, now = labels[case], found["result"], found["result"]
        if found.get("evidence") is not None:
            now = blind_scores.rejudge_diagnosis_evidence(found["evidence"], changes)
        shares = (math.nan if best.get(case) is None else float(best[case]), float(found["seconds"]))
        before, mark = (blind_scores.score_blind_case(label, told, *shares) for told in (then, now))
        marks.append(mark)
        if (before.verdict, before.answer, before.confusable) != (mark.verdict, mark.answer, mark.confusable):
            told = {"case": case, "truth": mark.truth, "then": f"{before.verdict} {before.answer}"}
            changed.append({**told, "now": f"{mark.verdict} {mark.answer}", "right": [before.right, mark.right]})
    kept = {key: commitment[key] for key in ("seed", "purpose")}
    rescored = {"settings": list(overrides), "changed": changed, "of": str(made)}
    result = blind_scores.blind_case_score_summary(marks) | {**kept, "rescored": rescored}
    return CommandOutcome(target, _write_result(target, result | {"code": package_source_hash()})[0], None)


def _stored_values(folder: Path) -> dict[str, Any]:
    """Return the stored task results of a folder by name: the newest of each, from any version of the package."""
    files = sorted(folder.glob("*.json"), key=lambda file: file.stat().st_mtime)
    entries = [read_input_json(file) for file in files if not file.name.endswith(".error.json")]
    return {str(entry["name"]): entry["value"] for entry in entries}
