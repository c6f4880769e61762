"""The command `blind`: cases, answers, pictures."""

from __future__ import annotations

import hashlib
import json

import pytest
from PIL import Image

from yid_ocp.config.reader import load_config
from yid_ocp.diagnosis.blind_scores import BlindCaseScore, ensemble_success_rates
from yid_ocp.errors import ConfigError, DataError, OutputError
from yid_ocp.files import to_json_types
from yid_ocp.parallel import InlineExecutor
from yid_ocp.report.diagnosis_summaries import blind_tables_markdown
from yid_ocp.report.html import write_report
from yid_ocp.report.png_figures import draw_blind_results
from yid_ocp.report.sections import ReportData
from yid_ocp.workflow import blind
from yid_ocp.workflow.blind import EXPERIMENT_VARIATIONS, list_experiments, run_blind

SETTINGS = (
    "model.arms.mode=driven",
    "recordings.held_out=[]",
    "diagnosis.candidates=[joint_viscous, joint_coulomb]",
    "problem.use_compiler=true",
    "output.write_report=false",
)


@pytest.fixture
def driven(pendulum):
    pytest.importorskip("mujoco", reason="blind proofs need MuJoCo: pip install 'yid-ocp[blind]'")
    return load_config(pendulum, SETTINGS)


@pytest.mark.slow
def test_a_proof_is_sealed_answered_and_not_done_again(driven, tmp_path, monkeypatch):
    folder = tmp_path / "proof"
    sealed_at, first = [], blind.diagnose_case_task

    def watched(**arguments):
        """What a diagnosis is told, and whether the labels were committed to before."""
        sealed_at.append(json.loads((folder / "commitment.json").read_text())["sha256"])
        assert not {"label", "planned", "detectable", "category"} & set(arguments)
        return first(**arguments)

    watched.__module__, watched.__qualname__ = first.__module__, first.__qualname__
    monkeypatch.setattr(blind, "diagnose_case_task", watched)
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
    with pytest.raises(OutputError, match=r"another ensemble \(2 cases, seed 3, for report\)"):
        run_blind([driven], folder, 2, 3, workers=InlineExecutor(), purpose="calibration")
    (folder / "sealed" / "labels.json").write_bytes(text.replace(b"case_001", b"case_002"))
    with pytest.raises(DataError, match="committed"):
        run_blind([driven], folder, 2, 3, workers=InlineExecutor())


def test_what_cannot_be_proved_is_refused(driven, pendulum, tmp_path, cli, monkeypatch):
    prescribed = load_config(pendulum)
    with pytest.raises(ConfigError, match=r"moves driven arms(.|\n)*model.arms.mode"):
        run_blind([prescribed], tmp_path / "proof", 2, 3, workers=InlineExecutor())
    with pytest.raises(ConfigError, match="two configurations are called pendulum"):
        run_blind([driven, driven], tmp_path / "proof", 2, 3, workers=InlineExecutor())
    with pytest.raises(ConfigError, match="seed = -1"):
        run_blind([driven], tmp_path / "proof", 2, -1, workers=InlineExecutor())
    assert not (tmp_path / "proof").exists()
    monkeypatch.setattr("yid_ocp.parallel.resumable_tasks._CONNECT_TIMEOUT", 0.5)
    options = [part for setting in SETTINGS for part in ("--set", setting)]
    done = cli("blind", pendulum, *options, "--scheduler", "127.0.0.1:1", "--out", tmp_path / "proof")
    assert done.code == 2
    assert "no scheduler answers" in done.err


def test_an_experiment_is_varied_as_far_as_its_configuration_allows(repository, driven, pendulum):
    whole = repository / "configs" / "single_arm_vision.yaml"
    experiments, chains = list_experiments({"whole": whole, "pendulum": pendulum}, 1, "report")
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
    return BlindCaseScore(*told, gap, gap, gap, gap, (), right, 0.9, 1.0, experiment=experiment, **more)


MARKS = [
    *(made("single", i % 4 > 0, i % 4 > 1, 3.0, z={"kelvin_voigt@T1.tau": 0.3 * i}) for i in range(8)),
    *(made("null", False, True, experiment="two", p_value=0.1 * i) for i in range(5)),
]


@pytest.mark.parametrize(("marks", "plots"), [(MARKS, 3), (MARKS[8:], None), ([], 0)], ids=["all", "clean", "none"])
def test_pictures_and_page_show_whatever_there_is(tmp_path, marks, plots):
    result = to_json_types(ensemble_success_rates(marks)) | {"seed": 1, "purpose": "report", "versions": {}}
    draw_blind_results(tmp_path, result)
    for name in ("detection", "confusion", "calibration"):
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert min(picture.size) > 100
    assert write_report(tmp_path / "report.html", ReportData("blind", "", result))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert plots in (None, page.count('<div class="plot"'))
    assert f"{len(marks)} cases of seed 1" in page
    assert ("of 5 clean recordings, 0 gave a false alarm" in page) == bool(marks)
    assert page.count("case_000") >= len(marks)
    with pytest.raises(OutputError, match="cannot be written"):
        draw_blind_results(tmp_path / "nowhere", result)


def test_the_table_has_rates_with_intervals_by_size_and_by_experiment():
    lines = blind_tables_markdown(to_json_types(ensemble_success_rates(MARKS)))
    assert "| false alarms on clean data | 0 % (0 of 5, 0 % to 52 %) |" in lines
    assert f"| 3 | 8 | {' | '.join([*2 * ['75 % (6 of 8, 35 % to 97 %)'], '50 % (4 of 8, 16 % to 84 %)'])} |" in lines
    assert "| two | 5 | 0 % (0 of 5, 0 % to 52 %) | - |" in lines
