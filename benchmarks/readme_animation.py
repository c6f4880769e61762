"""Draw the README's animation: arm and object before and after the estimate, by the viewer of the reports.

CONFIG=configs/single_arm_vision.yaml; yid-ocp check $CONFIG --out BEFORE; yid-ocp solve $CONFIG --out AFTER
python benchmarks/readme_animation.py BEFORE AFTER docs/pictures/gap.gif

A headless Chromium draws all frames on one page, whose picture is cut into the frames of a GIF.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image

import yid_ocp

TEMPLATES = Path(yid_ocp.__file__).parent / "report" / "templates"
WIDTH, HEIGHT, FRAMES = 640, 420, 60
PERIOD = 84  # of a frame [ms]: the five seconds of the recording in real time
COLORS = 64
NAMES = "model with 3 N m/rad", "after yid-ocp solve"
NOTE = "red: measured points"

PAGE = """<!DOCTYPE html><meta charset="utf-8"><style>%(css)s
body { margin: 0; padding: 0; max-width: none; background: #fff; }
.scene { width: %(width)dpx; height: %(height)dpx; overflow: hidden; position: relative; }
.scene canvas { width: 100%%; height: 100%%; border: 0; background: #fff; display: block; aspect-ratio: auto; }
.scene .time, .scene select, .scene input, .scene label:last-child { display: none; }
.scene .bar, .scene p { position: absolute; margin: 0; bottom: 36px; left: 16px; font: 16px sans-serif; color: #222; }
.scene p { bottom: 12px; color: #b3261e; }
</style><body><template><div class="scene"><script type="application/json"></script><canvas></canvas><p>%(note)s</p>
<div class="time"><button class="play"></button><input type="range" max="1000"><output></output></div>
<div class="bar"></div></div></template><script>
const darkness = { matches: false, addEventListener() {} };
%(viewer)s
const scenes = %(scenes)s;
for (let k = 0; k < %(frames)d; k++) {
  const box = document.body.appendChild(document.querySelector("template").content.firstChild.cloneNode(true));
  box.querySelector("script").textContent = JSON.stringify(scenes);
  const viewer = new Viewer(box);
  Object.assign(viewer.turn, { yaw: -1.0, tilt: 0.15, zoom: 1.35 });
  viewer.at(viewer.from + ((viewer.to - viewer.from) * k) / %(frames)d);
}
</script>"""


def scene(run: Path, title: str = "") -> dict[str, Any]:
    """First scene of the report of a run whose title begins so."""
    report = (run / "report.html").read_text(encoding="utf-8")
    texts = re.findall(r'<div class="scene">\s*<script type="application/json">(.*?)</script>', report, re.DOTALL)
    return next(entry for text in texts for entry in json.loads(text)["scenes"] if entry["title"].startswith(title))


def both(before: dict[str, Any], after: dict[str, Any]) -> dict[str, Any]:
    """One scene with the predictions of both runs and the recording."""
    first, second = (entry["motions"][0] | {"name": name} for entry, name in zip((before, after), NAMES, strict=True))
    return after | {"motions": [first, second, *after["motions"][1:]]}


def frames(shown: dict[str, Any], browser: str) -> list[Image.Image]:
    """Pictures of a scene, evenly spaced in time."""
    texts = {name: (TEMPLATES / name).read_text(encoding="utf-8") for name in ("scene.js", "page.css")}
    viewer = texts["scene.js"].split("// a moment can be linked to")[0]
    scenes = json.dumps({"scenes": [shown], "meshes": {}})
    parts = {"css": texts["page.css"], "viewer": viewer, "scenes": scenes, "note": NOTE}
    with tempfile.TemporaryDirectory() as folder:
        page, picture = Path(folder) / "page.html", Path(folder) / "frames.png"
        page.write_text(PAGE % {"width": WIDTH, "height": HEIGHT, "frames": FRAMES, **parts}, encoding="utf-8")
        size = f"--window-size={WIDTH},{HEIGHT * FRAMES}"
        flags = ("--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--virtual-time-budget=5000", size)
        subprocess.run([browser, *flags, f"--screenshot={picture}", page.as_uri()], check=True, capture_output=True)
        sheet = Image.open(picture).convert("RGB")
    return [sheet.crop((0, HEIGHT * k, WIDTH, HEIGHT * (k + 1))) for k in range(FRAMES)]


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="run folder of `yid-ocp check`")
    parser.add_argument("after", type=Path, help="run folder of `yid-ocp solve` of the same recording")
    parser.add_argument("picture", type=Path, help="GIF to write")
    parser.add_argument("--browser", default=shutil.which("chromium") or shutil.which("google-chrome"), help="Chromium")
    arguments = parser.parse_args()
    if arguments.browser is None:
        parser.error("no Chromium was found; name one by --browser")
    before = scene(arguments.before)
    drawn = frames(both(before, scene(arguments.after, before["title"])), arguments.browser)
    palette = drawn[FRAMES // 2].quantize(COLORS)
    first, *others = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in drawn]
    first.save(arguments.picture, save_all=True, append_images=others, duration=PERIOD, loop=0, optimize=True)


if __name__ == "__main__":
    main()
