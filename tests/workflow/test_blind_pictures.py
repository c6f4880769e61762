"""The table and the pictures of a blind proof, from marks that are made up."""

from __future__ import annotations

import pytest
from PIL import Image

from yid_ocp.diagnosis.blind import CaseScore, score_ensemble
from yid_ocp.errors import OutputError
from yid_ocp.files import to_json_types
from yid_ocp.report.html import write_report
from yid_ocp.report.png_figures import draw_blind_results
from yid_ocp.report.sections import ReportData
from yid_ocp.report.tables import blind_markdown


def made(
    category: str, gap: bool, right: bool, size: float = float("nan"), experiment: str = "one", **more
) -> CaseScore:
    answer = "kelvin_voigt@T1" if gap else "-"
    verdict = "effect" if gap else "no_gap"
    truth = "-" if category == "null" else "kelvin_voigt@T1"
    told = ("case_000", category, truth, verdict, answer, size)
    return CaseScore(*told, gap, gap, gap, gap, (), right, 0.9, 1.0, experiment=experiment, **more)


MARKS = [
    *(made("single", i % 4 > 0, i % 4 > 1, 3.0, z={"kelvin_voigt@T1.tau": 0.3 * i}) for i in range(8)),
    *(made("null", False, True, experiment="two", p_value=0.1 * i) for i in range(5)),
]


@pytest.mark.parametrize("marks", [MARKS, MARKS[8:], []], ids=["all", "clean ones", "none"])
def test_pictures_are_drawn_of_whatever_there_is(tmp_path, marks):
    draw_blind_results(tmp_path, to_json_types(score_ensemble(marks)))
    for name in ("detection", "confusion", "calibration"):
        with Image.open(tmp_path / f"{name}.png") as picture:
            assert min(picture.size) > 100


def test_the_table_has_rates_with_intervals_by_size_and_by_experiment():
    lines = blind_markdown(to_json_types(score_ensemble(MARKS)))
    assert "| false alarms on clean data | 0 % (0 of 5, 0 % to 52 %) |" in lines
    assert f"| 3 | 8 | {' | '.join([*2 * ['75 % (6 of 8, 35 % to 97 %)'], '50 % (4 of 8, 16 % to 84 %)'])} |" in lines
    assert "| two | 5 | 0 % (0 of 5, 0 % to 52 %) | - |" in lines


def test_a_folder_that_is_not_there_is_said(tmp_path):
    with pytest.raises(OutputError, match="cannot be written"):
        draw_blind_results(tmp_path / "nowhere", to_json_types(score_ensemble(MARKS)))


@pytest.mark.parametrize(("marks", "pictures"), [(MARKS, 3), ([], 0)], ids=["all", "none"])
def test_the_page_shows_what_was_detected_and_what_is_kept(tmp_path, marks, pictures):
    result = to_json_types(score_ensemble(marks)) | {"seed": 1, "purpose": "report", "versions": {}}
    assert write_report(tmp_path / "report.html", ReportData("blind", "", result))
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.count('<div class="plot"') == pictures
    assert f"{len(marks)} cases of seed 1" in page
    assert ("of 5 clean recordings, 0 gave a false alarm" in page) == bool(marks)
    assert page.count("case_000") >= len(marks)
