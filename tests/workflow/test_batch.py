"""Many runs: a batch, in which a failing one stops no other and what is done is not done again; blind validation."""

import hashlib
import json

import pytest
from PIL import Image

from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording, write_recording
from yid_ocp.diagnosis.blind_scores import BlindCaseScore, blind_case_score_summary
from yid_ocp.errors import ConfigError, DataError, OutputError
from yid_ocp.files import to_json_types
from yid_ocp.parallel import InlineExecutor
from yid_ocp.report.diagnosis_summaries import blind_validation_markdown_lines
from yid_ocp.report.html import write_report
from yid_ocp.report.png_figures import draw_blind_validation_figures
from yid_ocp.report.sections import ReportData
from yid_ocp.report.terminal import summary_blocks
from yid_ocp.workflow import blind
from yid_ocp.workflow.batch import batch_runs_from_configs, run_batch
from yid_ocp.workflow.blind import EXPERIMENT_VARIATIONS, _blind_experiments_and_refinable_subset, run_blind

HERE = InlineExecutor()
SHORT = "problem.duration=0.6"
QUICK = ("output.write_report=false", "output.checked_discretisation=none", "recordings.held_out=[]", SHORT)


@pytest.fixture
def fleet(pendulum, pendulum_data, tmp_path):
    """The pendulum's configuration and a folder of three recordings, of which one is damaged."""
    folder = tmp_path / "fleet"
    folder.mkdir()
    for name, source in (("monday", "estimate"), ("tuesday", "held_out")):
        write_recording(read_recording(pendulum_data.folder / f"{source}.h5"), folder / f"{name}.h5")
    (folder / "spoiled.h5").write_bytes(b"not a recording")
    return folder


def names(outcome):
    return {entry["name"]: entry["status"] for entry in outcome.result["runs"]}


def test_a_failing_run_stops_no_other_and_is_tried_again(pendulum, pendulum_data, fleet, tmp_path):
    members = batch_runs_from_configs([pendulum], str(fleet / "*.h5"), QUICK)
    assert [member.name for member in members] == ["monday", "spoiled", "tuesday"]
    out = tmp_path / "batch"
    first = run_batch(members, out, workers=HERE)
    assert names(first) == {"monday": "converged", "spoiled": "error", "tuesday": "converged"}
    assert not first.is_successful
    told = {entry["name"]: entry for entry in first.result["runs"]}
    assert not told["spoiled"]["message"].startswith("DataError")
    for name in ("monday", "tuesday"):
        own = json.loads((out / "runs" / name / "result.json").read_text())
        for parameter, value in pendulum_data.truth.items():
            assert told[name]["parameters"][parameter]["value"] == own["parameters"][parameter]["value"]
            assert own["parameters"][parameter]["value"] == pytest.approx(value, rel=0.05)
    assert json.loads((out / "batch.json").read_text()) == first.result
    page = (out / "report.html").read_text()
    assert all(name in page for name in ("monday", "spoiled"))
    told["monday"]["parameters"]["elbow.damping"]["unit"] = "N"
    assert all(f"elbow.damping [{unit}]" in repr(summary_blocks(first.result)) for unit in ("N", "N m s/rad"))
    # both recordings are of one pendulum
    assert not any(entry["drifted"] for entry in first.result["history"]["parameters"].values())

    kept = (out / "runs" / "monday" / "result.json").stat().st_mtime_ns
    write_recording(read_recording(fleet / "monday.h5"), fleet / "spoiled.h5")
    assert run_batch(members, out, workers=HERE).is_successful
    assert (out / "runs" / "monday" / "result.json").stat().st_mtime_ns == kept
    write_recording(read_recording(fleet / "tuesday.h5"), fleet / "monday.h5")
    third = run_batch(members, out, workers=HERE)
    changed = {entry["name"]: entry["parameters"]["elbow.damping"]["value"] for entry in third.result["runs"]}
    assert (out / "runs" / "monday" / "result.json").stat().st_mtime_ns > kept
    assert changed["monday"] == changed["tuesday"] != told["monday"]["parameters"]["elbow.damping"]["value"]


def test_robots_are_configurations_and_what_differs_has_no_history(pendulum, written, pendulum_data, tmp_path):
    other = written(pendulum_data.text.replace("rest_position: 0.2", "rest_position: 0.25"), "other.yaml")
    broken = written(pendulum_data.text.replace("free: true", "fre: true"), "broken.yaml")
    members = batch_runs_from_configs([pendulum, other, broken], None, QUICK)
    outcome = run_batch(members, tmp_path / "batch", workers=HERE)
    assert names(outcome) == {"pendulum": "converged", "other": "converged", "broken": "error"}
    assert "fre" in outcome.result["runs"][2]["message"]
    assert outcome.result["history"] is None


def test_a_fleet_is_diagnosed(rubbing, tmp_path):
    outcome = run_batch(batch_runs_from_configs([rubbing]), tmp_path / "batch", "diagnose", HERE)
    (entry,) = outcome.result["runs"]
    assert (entry["effects"], entry["chi2_per_dof"] < 1.5) == (["joint_coulomb@elbow"], True)
    assert entry["status"] == json.loads((tmp_path / "batch/runs/rubbing/result.json").read_text())["verdict"]


def test_names_are_told_apart(pendulum, written, pendulum_data, tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "run.h5").write_bytes(b"")
    (tmp_path / "a" / "run.yaml").write_text(pendulum_data.text)
    found = batch_runs_from_configs([pendulum], str(tmp_path / "*" / "run.h5"))
    assert [member.name for member in found] == ["run", "run-2"]
    found = batch_runs_from_configs([pendulum, tmp_path / "a" / "run.yaml"], str(tmp_path / "**" / "run.h5"))
    assert [member.name for member in found] == ["pendulum-run", "pendulum-run-2", "run-run", "run-run-2"]


def test_what_cannot_be_a_batch_is_refused(pendulum, tmp_path):
    with pytest.raises(ConfigError, match=r"no recording matches(.|\n)*nowhere/\*\.h5(.|\n)*in quotes"):
        batch_runs_from_configs([pendulum], "nowhere/*.h5")
    with pytest.raises(ConfigError, match=r"no such configuration(.|\n)*did you mean 'pendulum.yaml'"):
        batch_runs_from_configs(["pendulun.yaml"])
    with pytest.raises(ConfigError, match="given twice"):
        batch_runs_from_configs([pendulum, pendulum])
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes").write_text("")
    with pytest.raises(OutputError, match="not those of a batch"):
        run_batch(batch_runs_from_configs([pendulum]), tmp_path / "full", workers=HERE)


def test_the_command_runs_the_fleet_in_processes(cli, printed, pendulum, fleet, tmp_path):
    (fleet / "spoiled.h5").unlink()
    given = (pendulum, "--recordings", fleet / "*.h5", "--out", "fleet_runs")
    done = cli("batch", *given, "--workers", 1, settings=QUICK)
    assert done.code == 0, done.err
    assert all(text in done.out for text in ("2 runs: 2 converged.", "shoulder.stiffness"))
    assert "2 of 2" in done.err
    printed("batch", pendulum, "--recordings", "nowhere*.h5", code=2)
    printed("batch", *given, "--workers", 0, code=2)
    assert "one of the two" in printed("batch", *given, "--workers", 2, "--scheduler", "localhost:8786", code=2)


SETTINGS = (
    "model.arms.mode=driven",
    "recordings.held_out=[]",
    "diagnosis.candidates=[joint_viscous, joint_spring]",
    "problem.use_compiler=true",
    "output.write_report=false",
)


@pytest.fixture
def driven(pendulum):
    pytest.importorskip("mujoco", reason="blind proofs need MuJoCo: pip install '.[blind]'")
    return load_config(pendulum, SETTINGS)


@pytest.mark.slow
def test_a_proof_is_sealed_answered_and_not_done_again(driven, tmp_path, monkeypatch):
    folder = tmp_path / "proof"
    sealed_at, first = [], blind._diagnose_case_from_recordings_task

    def watched(**arguments):
        """What a diagnosis is told, and whether the labels were committed to before."""
        sealed_at.append(json.loads((folder / "commitment.json").read_text())["sha256"])
        assert not {"label", "planned", "detectable", "category"} & set(arguments)
        return first(**arguments)

    watched.__module__, watched.__qualname__ = first.__module__, first.__qualname__
    monkeypatch.setattr(blind, "_diagnose_case_from_recordings_task", watched)
    outcome = run_blind([driven], folder, 2, 3, workers=InlineExecutor())
    text = (folder / "sealed" / "labels.json").read_bytes()
    assert sealed_at == [hashlib.sha256(text).hexdigest()] * 2
    labels = json.loads(text)
    assert [entry["case"] for entry in labels] == ["case_000", "case_001"]
    assert {entry["experiment"] for entry in labels} == {"pendulum.as_configured"}
    for path in (folder / "cases").glob("*.h5"):
        assert not any(word in path.read_bytes() for word in (b"joint_", b"single", b"multiple"))
    marks = outcome.result["marks"]
    assert [entry["category"] for entry in marks] == [entry["category"] for entry in labels]
    assert outcome.result["code"] == outcome.result["code_of_cases"]
    assert {"detection.png", "confusion.png", "calibration.png", "table.md"} <= {p.name for p in folder.iterdir()}

    again = run_blind([driven], folder, 2, 3, workers=InlineExecutor())
    assert len(sealed_at) == 2
    assert again.result | {"date": ""} == outcome.result | {"date": ""}
    judged = blind.rescore_blind(folder, tmp_path / "judged").result
    told = ("verdict", "answer", "confusable", "right", "location_first")
    assert [[own[key] for key in told] for own in judged["marks"]] == [[own[key] for key in told] for own in marks]
    with pytest.raises(OutputError, match=r"another blind test \(2 cases, seed 3, for report\).*in: purpose"):
        run_blind([driven], folder, 2, 3, workers=InlineExecutor(), purpose="calibration")
    (folder / "sealed" / "labels.json").write_bytes(text.replace(b"case_001", b"case_002"))
    with pytest.raises(DataError, match="changed after the diagnosis began"):
        run_blind([driven], folder, 2, 3, workers=InlineExecutor())


def test_what_cannot_be_proved_is_refused(driven, pendulum, repository, tmp_path, printed, monkeypatch):
    springs = load_config(repository / "configs" / "springs_series_joint.yaml")
    with pytest.raises(ConfigError, match=r"cannot simulate 'points_camera'(.|\n)*springs_series_joint.yaml, line"):
        run_blind([springs], tmp_path / "proof", 2, 3, workers=InlineExecutor())
    for prescribed in (load_config(pendulum), load_config(springs.config_file, ["sensors.points_camera.use=false"])):
        with pytest.raises(ConfigError, match=r"joints are all driven(.|\n)*model.arms.mode"):
            run_blind([prescribed], tmp_path / "proof", 2, 3, workers=InlineExecutor())
    with pytest.raises(ConfigError, match="two configurations have the name pendulum"):
        run_blind([driven, driven], tmp_path / "proof", 2, 3, workers=InlineExecutor())
    with pytest.raises(ConfigError, match="seed is -1, but must be at least 0"):
        run_blind([driven], tmp_path / "proof", 2, -1, workers=InlineExecutor())
    assert not (tmp_path / "proof").exists()
    monkeypatch.setattr("yid_ocp.parallel.resumable_tasks._CONNECT_TIMEOUT", 0.5)
    asked = (pendulum, "--scheduler", "127.0.0.1:1", "--out", tmp_path / "proof")
    assert "no scheduler answers" in printed("blind", *asked, settings=SETTINGS, code=2)


def test_an_experiment_is_varied_as_far_as_its_configuration_allows(repository, driven, pendulum):
    whole = repository / "configs" / "single_arm_vision.yaml"
    experiments, chains = _blind_experiments_and_refinable_subset({"whole": whole, "pendulum": pendulum}, 1, "report")
    with_object = {name for name, varied in EXPERIMENT_VARIATIONS.items() if not varied.is_without_object}
    # from the pendulum there is nothing to take out of its hands
    assert set(experiments) == {
        *(f"whole.{name}" for name in EXPERIMENT_VARIATIONS), *(f"pendulum.{name}" for name in with_object)
    }  # fmt: skip
    assert chains == {f"whole.{name}" for name in with_object}
    bare = experiments["whole.bare_arm_efforts"].simulation_settings()
    assert bare.model.object is None
    assert bare.model.arms.mode == "driven"


def made(
    category: str, gap: bool, right: bool, size: float = float("nan"), experiment: str = "one", **more
) -> BlindCaseScore:
    answer = "kelvin_voigt@T1" if gap else "-"
    verdict = "effect" if gap else "no_gap"
    truth = "-" if category == "null" else "kelvin_voigt@T1"
    told = ("case_000", category, truth, verdict, answer, size)
    return BlindCaseScore(*told, gap, gap, gap, (), right, 0.9, 1.0, experiment=experiment, **more)


MARKS = [
    *(made("single", i % 4 > 0, i % 4 > 1, 3.0, z={"kelvin_voigt@T1.tau": 0.3 * i}) for i in range(8)),
    *(made("null", False, True, experiment="two", p_value=0.1 * i) for i in range(5)),
]


@pytest.mark.parametrize("marks", [MARKS, MARKS[8:], []], ids=["all", "clean", "none"])
def test_pictures_and_page_show_whatever_there_is(tmp_path, marks):
    result = to_json_types(blind_case_score_summary(marks)) | {"seed": 1, "purpose": "report", "versions": {}}
    files = draw_blind_validation_figures(tmp_path, result)
    assert [file.name for file in files] == ["detection.png", "confusion.png", "calibration.png"]
    for file in files:
        with Image.open(file) as picture:
            assert min(picture.size) > 100
    assert write_report(tmp_path / "report.html", ReportData("blind", "", result, section_data={"pictures": files}))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/png') == 3
    assert f"The blind test has {len(marks)} synthetic cases (seed 1" in page
    assert ("False alarms: 0 of 5 cases without an effect." in page) == bool(marks)
    assert page.count("case_000") >= len(marks)
    with pytest.raises(OutputError, match="folder to write to does not exist"):
        draw_blind_validation_figures(tmp_path / "nowhere", result)


def test_the_table_has_rates_with_intervals_by_size_and_by_experiment():
    lines = blind_validation_markdown_lines(to_json_types(blind_case_score_summary(MARKS)))
    assert "| no effect: false alarms (a gap is reported) | 0 % (0 of 5, 0 % to 52 %) | 0 % |" in lines
    assert f"| 3 | 8 | {' | '.join([*2 * ['75 % (6 of 8, 35 % to 97 %)'], '50 % (4 of 8, 16 % to 84 %)'])} |" in lines
    assert "| two | 5 |  | 0 % (0 of 5, 0 % to 52 %) | - |" in lines
