"""The tutorial runs as it stands."""

from __future__ import annotations

import re
import subprocess
import sys


def test_the_tutorial_runs(repository) -> None:
    text = (repository / "docs" / "tutorial.md").read_text(encoding="utf-8")
    script = "\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL))
    command = [sys.executable, "-c", f"import sys\nsys.path[:0] = [{str(repository)!r}]\n{script}"]
    run = subprocess.run(command, cwd=repository, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr


def test_its_commands_exist(repository) -> None:
    from yid_ocp.cli import build_argument_parser

    text = (repository / "docs" / "tutorial.md").read_text(encoding="utf-8")
    [block] = re.findall(r"```sh\n(.*?)```", text, re.DOTALL)
    for line in block.strip().splitlines():
        name, *arguments = line.split()
        assert name == "yid-ocp"
        build_argument_parser().parse_args(arguments)
