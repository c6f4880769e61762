"""Pages: of a result alone, of a solve and of a diagnosis; each says what the terminal says, in any browser."""

import base64
import gzip
import html
import importlib
import itertools
import json
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import plotly.offline
import pytest

from yid_ocp.cli import main
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.events import EventSet, ForceOrFaultEvent, _Overspeed
from yid_ocp.diagnosis.pulse_detection import DetectedForcePulse, ForceEstimate
from yid_ocp.diagnosis.sentences import diagnosis_summary_text
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.errors import OutputError
from yid_ocp.report import terminal
from yid_ocp.report.html import write_report, write_shared_plotly_script
from yid_ocp.report.sections import REPORT_SECTIONS, ReportData, rendered_section_dicts
from yid_ocp.report.terminal import summary_blocks
from yid_ocp.workflow.build_problem import load_problem
from yid_ocp.workflow.diagnose import _held_out_predictions, _scenes
from yid_ocp.workflow.solve import solution_to_result_dict

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
COMMANDS = {
    "solve": "",
    "check": "",
    "simulate": "--noise",
    "identifiability": "--what-if --intervals all",
    "inspect": "--entry p1[elbow]",
    "diagnose": "--set diagnosis.candidates=[joint_coulomb,effort_offset] --set diagnosis.max_effects=1",
    "compare": "--set 'compare.methods={gauss_newton: {}, single_shooting: {}}'",
    "friction": "",
    "plan": "--set model.measured_points=[tip] --set 'plan={point: tip, point_target_offset_from_start: [0, 0.1, 0]}'",
    "report": "",
}
LOOKS = list(itertools.product((1400, 400), ("light", "dark")))
needs_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open pages with")
PROBE = """
<script>
addEventListener("load", async () => {
  const boxes = [...document.querySelectorAll(".plot")];
  for (let i = 0; i < 400 && boxes.some((box) => !box.target); i++) await new Promise((go) => setTimeout(go, 50));
  await Promise.all(boxes.filter((box) => !box.drawn).map(draw));
  const wide = document.documentElement.clientWidth;
  const cut = [...document.querySelectorAll("body *")].filter(
    (e) => !e.closest(".scroll, svg") && e.getBoundingClientRect().right > wide + 1);
  const moments = [];
  for (const viewer of viewers) for (const part of [0, 0.5, 1]) {
    viewer.at(viewer.from + part * (viewer.to - viewer.from));
    let sum = 0;
    for (const letter of viewer.canvas.toDataURL()) sum = (31 * sum + letter.charCodeAt(0)) % 1000003;
    moments.push(sum);
  }
  // the browser's clock jumps, its frames come when the machine is free
  window.requestAnimationFrame = (act) => setTimeout(() => act(performance.now()), 16);
  viewers.forEach((viewer) => { viewer.at(viewer.from); viewer.play(); });
  const played = () => viewers.map((viewer) => viewer.time > viewer.from);
  for (let i = 0; i < 200 && played().includes(false); i++) await new Promise((go) => setTimeout(go, 20));
  const told = [...document.querySelectorAll(".said")].at(-1) ?? viewers[0].canvas;
  const below = told.getBoundingClientRect().bottom - innerHeight;
  const { style } = document.body;
  const fit = () => boxes.every((box) => box.querySelector(".main-svg").clientWidth <= box.clientWidth);
  style.width = "320px";
  for (let i = 0; i < 5000 && !fit(); i++) await new Promise((go) => setTimeout(go, 20));
  const narrowed = fit();
  style.width = "";
  parent.postMessage(JSON.stringify({
    width: innerWidth, wide, scroll: document.documentElement.scrollWidth,
    cut: cut.map((e) => e.outerHTML.slice(0, 80)), narrowed,
    boxes: boxes.length, drawn: document.querySelectorAll(".plot .main-svg").length, moments, played: played(), below,
    dark: matchMedia("(prefers-color-scheme: dark)").matches, ground: getComputedStyle(document.body).backgroundColor,
  }), "*");
});
</script>
"""


def text_of(page: str) -> str:
    body = re.sub(r"<script.*?</script>", "", re.sub("</?code>", "", page.split("<body>")[1]), flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", body)).split())


def written(findings: ReportData, folder: Path) -> str:
    assert write_report(folder / "r.html", findings)
    return (folder / "r.html").read_text(encoding="utf-8")


def findings(solved, **changes) -> ReportData:
    problem, solution, *_ = solved
    made = {"command": "yid-ocp solve p.yaml", "date": "2026-01-02 03:04:05+00:00"}
    result = (
        solution_to_result_dict(problem, solution, []) | made | {"inputs": {"a": "0" * 64}, "versions": {"python": "3"}}
    )
    return ReportData("run <one>", "A & B.", result | changes, problem, solution)


def test_a_whole_report_is_one_self_contained_page(solved_pendulum, tmp_path):
    page = written(findings(solved_pendulum), tmp_path)
    body = page[page.index("<body>") :]
    assert not re.search(r"<(script|link|img)[^>]+(src|href)=", page)
    problem, *others = solved_pendulum
    parts = (replace(problem.options.excess_residual_criteria, noise_fraction_of_stated_std=own) for own in (1.0, 0.5))
    options = (replace(problem.options, excess_residual_criteria=part) for part in parts)
    data = (findings((problem.with_options(own), *others)) for own in options)
    bands = [REPORT_SECTIONS["fit"].prepare_context(own)["figures"][0][1]["layout"]["shapes"][0]["y1"] for own in data]
    assert bands[1] == 0.5 * bands[0]
    packed = re.search(r'id="packed">([^<]+)</script>', page).group(1)
    assert gzip.decompress(base64.b64decode(packed)).decode() == plotly.offline.get_plotlyjs()
    assert len(page) < 2.5e6
    assert ("<title>run &lt;one&gt;</title>" in page, "A &amp; B." in body) == (True, True)
    order = ("verdict", "scene", "estimates", "fit", "search", "numbers", "inputs")
    assert tuple(re.findall(r'<section id="(\w+)">', body)) == order
    for known in ("yid-ocp solve p.yaml", "2026-01-02 03:04:05+00:00", "0" * 64, "python 3", "joints.effort.shoulder"):
        assert known in body
    assert '<p class="said">You can use these values: ' in body
    opened = []
    for end, tag in re.findall(r"<(/?)([a-z]\w*)", re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)):
        if end:
            assert opened.pop() == tag
        elif tag not in ("meta", "br", "img", "link", "input", "hr"):
            opened.append(tag)
    assert opened == []


def test_a_failed_solve_gets_no_verdicts(solved_pendulum, tmp_path):
    problem, solution, _ = solved_pendulum
    failed = replace(solution, evaluation=None, cost=float("nan"))
    data = findings((problem, failed), status="failed", message="step 3 did not converge")
    body = written(data, tmp_path).split("<body>")[1]
    assert '<p class="said">Do not use the values, because the fit failed: step 3 did not converge' in body
    assert not any(part in body for part in ('class="verdict', '<section id="fit">'))


def test_sections_may_have_nothing_to_say():
    assert rendered_section_dicts(ReportData("x", "", {"format": "other/1"}), environment=None) == []


def test_a_new_section_is_a_file_and_a_template(solved_pendulum, tmp_path, monkeypatch):
    (tmp_path / "weather_section.py").write_text(
        "from yid_ocp.report.sections import register_report_section\n\n\n"
        "@register_report_section('weather', 15, 'The weather')\n"
        "def prepare(findings):\n"
        "    return {'sky': 'blue & dry'} if 'parameters' in findings.result else None\n"
    )
    (tmp_path / "weather.html").write_text("<p>The sky was {{ sky }}.</p>")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(REPORT_SECTIONS, "data", dict(REPORT_SECTIONS.data))
    importlib.import_module("weather_section")
    monkeypatch.delitem(sys.modules, "weather_section")
    body = written(findings(solved_pendulum), tmp_path).split("<body>")[1]
    assert "<h2>The weather</h2>" in body
    assert "The sky was blue &amp; dry." in body
    assert body.index('id="verdict"') < body.index('id="weather"') < body.index('id="fit"')
    assert REPORT_SECTIONS["weather"].prepare_context(ReportData("x", "", {"format": "other/1"})) is None


def test_every_template_has_its_section(repository):
    templates = {path.stem for path in (repository / "yid_ocp" / "report" / "templates").glob("*.html")}
    assert templates - {"page", "blocks", "figures"} < set(REPORT_SECTIONS)


def test_a_report_that_cannot_be_written(solved_pendulum, tmp_path):
    with pytest.raises(OutputError, match="does not exist"):
        write_report(tmp_path / "no" / "r.html", findings(solved_pendulum))


KNOWN = {"command": "yid-ocp diagnose 'a b.yaml'", "next_plan": None, "versions": {"python": "3"}, "date": "today"}
CHAPTERS = ("gap", "where", "which", "alike", "curves", "absorbed")


@pytest.fixture(scope="module")
def found(rubbing, solved_pendulum):
    """Findings on a pendulum: friction in the elbow that is named, that no candidate explains, and none at all."""
    problem, limits = load_problem(rubbing), Thresholds(max_effects=1)
    return {
        "effect": diagnose(problem, ["joint_coulomb", "effort_offset"], thresholds=limits),
        "unknown": diagnose(problem, ["effort_offset"], thresholds=limits),
        "no_gap": diagnose(solved_pendulum[0], ["joint_coulomb", "effort_offset"], thresholds=limits),
    }


def page_of(finding, folder) -> str:
    result = json.loads(json.dumps(finding.to_dict() | KNOWN))
    more = {"finding": finding, "predictions": _held_out_predictions(finding)}
    return written(ReportData("run", "", result, section_data=more), folder)


@pytest.mark.parametrize(
    ("verdict", "left_out"), [("effect", ()), ("unknown", ("absorbed",)), ("no_gap", ("where", "absorbed"))]
)
def test_every_verdict_has_its_chapters(found, verdict, left_out, tmp_path):
    finding, chapters = found[verdict], tuple(name for name in CHAPTERS if name not in left_out)
    assert finding.verdict == verdict
    scenes = _scenes(finding, _held_out_predictions(finding))
    acting = [{(label, unit, values.shape[1]) for label, _, unit, values in e.motions[-2].acting} for e in scenes]
    friction = {("joint_coulomb@elbow", "", 0)} if verdict == "effect" else set()
    assert acting[0] == friction
    assert [("force elbow", "N m", 1) in own for own in acting[1:]] == ([] if verdict == "no_gap" else [True])
    page = page_of(finding, tmp_path)
    assert tuple(re.findall(r'<h3 id="(\w+)">', page)) == chapters
    text = text_of(page)
    parts = finding.summary.replace("\n", " "), finding.next_steps[-1]
    ends = [text.index(" ".join(part.replace("`", "").split())) for part in parts]
    assert ends[0] < ends[1] < text.index("How large the gap is")
    assert text.index("How large the gap is") < text.index("yid-ocp diagnose 'a b.yaml'")
    assert page.count('<div class="plot"') >= len(chapters)
    assert "nan" not in text


def test_the_words_beside_the_pictures_say_what_is_seen(found, tmp_path):
    finding = found["effect"]
    fit, lost = finding.nominal_model, finding.nominal_model.held_out_loss
    quiet = replace(fit, held_out_loss=replace(lost, block_chi2=0 * lost.block_chi2, baseline_chi2=0.0))
    assert "Refitted: joint_coulomb@elbow" in text_of(page_of(replace(finding, nominal_model=quiet), tmp_path))
    text = text_of(page_of(finding, tmp_path))
    texts = "The recordings attribute the error beyond noise to ", "would have been detected", "the effort sensor (rec"
    texts += "No two signatures are similar in both directions", "The most significant value is that of elbow"
    assert [part for part in texts if part not in text] == []


def test_a_map_without_a_sure_value_shows_what_was_expected_beforehand(found, tmp_path):
    finding = found["effect"]
    smoothed = finding.smoother_result
    trace = smoothed.smoothed_unknowns[0]
    prior = np.sqrt([smoothed.group_variance[source] for source in trace.unknown_groups])
    vague = replace(trace, posterior_std=np.broadcast_to(0.9 * prior, trace.posterior_std.shape))
    page = page_of(replace(finding, smoother_result=replace(smoothed, smoothed_unknowns=(vague,))), tmp_path)
    assert "value in standard deviations of its prior" in page
    assert "The map is only a hint." in text_of(page)


def test_a_result_alone_gives_words_and_tables(found, tmp_path):
    result = found["effect"].to_dict() | KNOWN
    page = written(ReportData("run", "", result), tmp_path).split("<body>")[1]
    assert "joint_coulomb@elbow" in page
    assert '<div class="plot"' not in page


def test_events_are_marked_on_the_time_axis_told_and_listed(found, tmp_path):
    t = np.linspace(0, 2, 21)
    pulse = DetectedForcePulse(0.5, 1.0, 0.7, False, 0.05, 1e-9)
    event = ForceOrFaultEvent("run", "elbow", "elbow", "force", 0.5, 1.0, 0.7, pulse.impulse, 0.0125, "N m", pulse)
    events = EventSet(
        (event,),
        (_Overspeed("run", "elbow", 1.5),),
        (ForceEstimate("run", "elbow", "elbow", "N m", t, pulse.filtered_force_at(t), np.eye(21), 0.1 + 0 * t, 0 * t),),
    )
    finding = replace(found["no_gap"], events=events)
    page = page_of(replace(finding, summary=diagnosis_summary_text(finding)), tmp_path)
    assert 'id="events"' in page
    text = text_of(page)
    assert f"{pulse.impulse:.3g} ± {0.0125:.2g}" in text
    assert "Data of 'run' after 1.5 s are ignored" in text
    assert 'id="events"' not in page_of(found["no_gap"], tmp_path)


def check_in_browser(page: Path, width: int, scheme: str, folder: Path) -> None:
    """What a browser makes of a page: `PROBE`'s findings and the messages on its console."""
    probed = page.with_name("probed.html")
    probed.write_text(page.read_text(encoding="utf-8").replace("</body>", f"{PROBE}</body>"), encoding="utf-8")
    outer = folder / "outer.html"
    # a window is never narrower than 500 pixels, a frame is as narrow as it is told
    outer.write_text(
        f'<iframe src="{probed.as_uri()}" style="width:{width}px;height:900px;border:0"></iframe><pre></pre><script>'
        'addEventListener("message", (event) => (document.querySelector("pre").textContent = event.data));</script>'
    )
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
        "--window-size=1500,1000", "--virtual-time-budget=240000", f"--user-data-dir={folder / 'profile'}",
        f"--blink-settings=preferredColorScheme={int(scheme == 'light')}", outer.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    probed.unlink()
    found = re.search(r"<pre>(.*?)</pre>", done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    assert found[1], done.stderr[-2000:]
    assert ":CONSOLE" not in done.stderr
    seen = json.loads(html.unescape(found[1]))
    assert (seen["width"], seen["dark"], seen["cut"]) == (width, scheme == "dark", [])
    assert seen["scroll"] <= seen["wide"]
    assert seen["drawn"] >= seen["boxes"]
    assert seen["narrowed"]
    assert seen["below"] <= 0, "the verdict is not on the first screen"
    assert seen["ground"] == ("rgb(21, 27, 32)" if scheme == "dark" else "rgb(255, 255, 255)")
    for i in range(0, len(seen["moments"]), 3):
        assert len(set(seen["moments"][i : i + 3])) == 3, "the picture does not move"
    assert all(seen["played"])


@pytest.fixture(scope="module")
def solved_page(tmp_path_factory, pendulum_data) -> Path:
    out = tmp_path_factory.mktemp("page") / "run"
    (pendulum_data.folder / "page.yaml").write_text(pendulum_data.text)
    assert main(["solve", str(pendulum_data.folder / "page.yaml"), "--out", str(out)]) == 0
    return out / "report.html"


def test_a_page_says_what_the_terminal_says(solved_page):
    result = json.loads((solved_page.parent / "result.json").read_text())
    said = terminal.summary_terminal_lines(summary_blocks(result))
    assert_same_words("\n".join([*said, "run folder: x"]), text_of(solved_page.read_text(encoding="utf-8")))


@needs_browser
def test_a_browser_draws_pages_with_their_script_in_them_or_beside_them(solved_page, tmp_path):
    check_in_browser(solved_page, 1400, "light", tmp_path)
    page = tmp_path / "runs" / "one" / "report.html"
    page.parent.mkdir(parents=True)
    write_shared_plotly_script(tmp_path)
    [script] = tmp_path.glob("plotly-*.js")
    told = re.sub(r'<script type="text/plain" id="packed">[^<]+</script>',
                  f'<script src="../../{script.name}"></script>', solved_page.read_text())  # fmt: skip
    page.write_text(told)
    assert len(told) < 0.6e6
    check_in_browser(page, 400, "dark", tmp_path)


def test_a_page_takes_no_script_of_somebody_else(tmp_path):
    data, folder = ReportData("run", "", KNOWN), tmp_path / "runs" / "one"
    folder.mkdir(parents=True)
    write_shared_plotly_script(tmp_path)
    [script] = tmp_path.glob("plotly-*.js")
    script.write_text("steal()")
    assert "<script src=" not in written(data, folder)
    write_shared_plotly_script(tmp_path)
    assert f'<script src="../../{script.name}">' in written(data, folder)


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_the_page_of_a_command_says_what_the_terminal_says(command, printed, pendulum, solved_page, tmp_path):
    given = [pendulum]
    if command == "report":
        given = [solved_page.parent, "other"]
        printed("solve", pendulum, "--out", "other", "--set", "parameters.elbow.damping.free=false")
    out = printed(command, *given, "--out", "run", *shlex.split(COMMANDS[command]))
    page = tmp_path / "run" / "report.html"
    told = text_of(page.read_text(encoding="utf-8"))
    result = json.loads((tmp_path / "run" / ("overlay.json" if command == "report" else "result.json")).read_text())
    assert result["command"] in told
    assert result["date"] in told
    assert_same_words(out, told)
    for look in LOOKS if CHROMIUM else ():
        check_in_browser(page, *look, tmp_path)


@needs_browser
@pytest.mark.slow
def test_a_browser_draws_the_picture_of_a_guess(printed, pendulum_data, urdf_folder, tmp_path):
    recording = pendulum_data.folder / "estimate.h5"
    printed("init", urdf_folder / "double_pendulum.urdf", recording, "--out", tmp_path / "run.yaml")
    for look in LOOKS:
        check_in_browser(tmp_path / "run.html", *look, tmp_path)


@needs_browser
@pytest.mark.slow
@pytest.mark.parametrize("command", ["batch", "blind"])
def test_a_browser_draws_the_page_of_many_runs(command, printed, pendulum, repository, tmp_path):
    slices = repository / "benchmarks" / "blind_slices" / "seed_63017.json"
    printed(command, *([pendulum] if command == "batch" else ["--join", slices]), "--out", "many")
    for look in LOOKS:
        check_in_browser(tmp_path / "many" / "report.html", *look, tmp_path)


def assert_same_words(out: str, page: str) -> None:
    """Every sentence and cell of a terminal stands on the page."""
    *lines, _ = out.splitlines()  # the last one is the folder
    assert lines
    for line in lines:
        for cell in re.split(r"\s{2,}", line.strip()):
            if cell and set(cell) != {"-"}:
                assert " ".join(cell.split()).replace("`", "").removesuffix(":") in page, cell
