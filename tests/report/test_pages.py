"""Every command's page: it says what the terminal says, and browsers draw it on any screen, in light and dark."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from yid_ocp.report import terminal
from yid_ocp.report.html import _script_name, _shared_script, write_shared_plotly_script
from yid_ocp.report.terminal import SUMMARY_BY_FORMAT

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
COMMANDS = {
    "solve": (),
    "check": (),
    "simulate": ("--noise",),
    "identifiability": ("--what-if", "--intervals", "all"),
    "inspect": ("--entry", "p1[elbow]"),
    "diagnose": ("--set", "diagnosis.candidates=[joint_coulomb, effort_offset]", "--set", "diagnosis.max_effects=1"),
    "compare": ("--set", "compare.methods={gauss_newton: {}, single_shooting: {}}"),
}
SIZES = [(1400, "light"), (400, "dark")]
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
  parent.postMessage(JSON.stringify({
    width: innerWidth, wide, scroll: document.documentElement.scrollWidth,
    cut: cut.map((e) => e.outerHTML.slice(0, 80)),
    boxes: boxes.length, drawn: document.querySelectorAll(".plot .main-svg").length, moments,
    played: played(),
    dark: matchMedia("(prefers-color-scheme: dark)").matches, ground: getComputedStyle(document.body).backgroundColor,
  }), "*");
});
</script>
"""


def text_of(page: str) -> str:
    body = re.sub(r"<script.*?</script>", "", page[page.index("<body>") :], flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", body)).split())


def opened(page: Path, width: int, scheme: str, folder: Path) -> dict:
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
        "--window-size=1500,1000", "--virtual-time-budget=60000", f"--user-data-dir={folder / 'profile'}",
        f"--blink-settings=preferredColorScheme={int(scheme == 'light')}", outer.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, check=False)
    probed.unlink()
    found = re.search(r"<pre>(.*?)</pre>", done.stdout, re.DOTALL)
    assert found, done.stderr[-2000:]
    assert found[1], done.stderr[-2000:]
    console = [line for line in done.stderr.splitlines() if ":CONSOLE" in line]
    return json.loads(html.unescape(found[1])) | {"console": console}


def check_in_browser(page: Path, width: int, scheme: str, folder: Path) -> None:
    seen = opened(page, width, scheme, folder)
    assert seen["console"] == []
    assert (seen["width"], seen["dark"]) == (width, scheme == "dark")
    assert seen["scroll"] <= seen["wide"]
    assert seen["cut"] == []
    assert seen["drawn"] >= seen["boxes"]
    assert seen["ground"] == ("rgb(21, 27, 32)" if scheme == "dark" else "rgb(255, 255, 255)")
    for i in range(0, len(seen["moments"]), 3):
        assert len(set(seen["moments"][i : i + 3])) == 3, "the picture does not move"
    assert all(seen["played"])


@pytest.fixture(scope="module")
def solved_page(tmp_path_factory, pendulum_data) -> Path:
    from yid_ocp.cli import main

    out = tmp_path_factory.mktemp("page") / "run"
    (pendulum_data.folder / "page.yaml").write_text(pendulum_data.text)
    assert main(["solve", str(pendulum_data.folder / "page.yaml"), "--out", str(out)]) == 0
    return out / "report.html"


def test_a_page_says_what_the_terminal_says(solved_page):
    result = json.loads((solved_page.parent / "result.json").read_text())
    said = terminal.summary_terminal_lines(SUMMARY_BY_FORMAT[result["format"]](result))
    assert_same_words("\n".join([*said, "run folder: x"]), text_of(solved_page.read_text(encoding="utf-8")))


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open pages with")
@pytest.mark.parametrize(("width", "scheme"), SIZES)
def test_a_browser_draws_a_page_without_a_complaint(solved_page, width, scheme, tmp_path):
    check_in_browser(solved_page, width, scheme, tmp_path)


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to open pages with")
def test_a_page_finds_the_script_that_its_folder_shares(solved_page, tmp_path):
    page = tmp_path / "runs" / "one" / "report.html"
    page.parent.mkdir(parents=True)
    write_shared_plotly_script(tmp_path)
    told = re.sub(r'<script type="text/plain" id="packed">[^<]+</script>',
                  f'<script src="../../{_script_name()}"></script>', solved_page.read_text())  # fmt: skip
    page.write_text(told)
    assert len(told) < 0.6e6
    check_in_browser(page, 1400, "light", tmp_path)


def test_a_page_takes_no_script_of_somebody_else(tmp_path):
    page = tmp_path / "runs" / "one" / "report.html"
    page.parent.mkdir(parents=True)
    (tmp_path / _script_name()).write_text("steal()")
    assert _shared_script(page) == ""
    write_shared_plotly_script(tmp_path)
    assert _shared_script(page) == f"../../{_script_name()}"


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_writes_a_page_that_says_what_the_terminal_says(command, cli, pendulum, tmp_path):
    done = cli(command, pendulum, "--out", "run", *COMMANDS[command])
    assert done.code == 0, done.err
    page = tmp_path / "run" / "report.html"
    told = text_of(page.read_text(encoding="utf-8"))
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["command"] in told
    assert result["date"] in told
    assert_same_words(done.out, told)
    if CHROMIUM is not None:
        for width, scheme in ((1400, "dark"), (400, "light")):
            check_in_browser(page, width, scheme, tmp_path)


def assert_same_words(out: str, page: str) -> None:
    """Every sentence and cell of a terminal stands on the page."""
    lines = out.splitlines()[:-1]  # the last one is the folder
    assert lines
    for line in lines:
        for cell in re.split(r"\s{2,}", line.strip()):
            if cell and set(cell) != {"-"}:
                assert " ".join(cell.split()) in page, cell
