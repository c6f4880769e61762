"""The code of docs/program.md runs as it stands, and does what the page says."""

from __future__ import annotations

import re
import subprocess
import sys

CHECKS = """
values = ca.Function("k", [mine.w], [k])(found["x"])
assert solver.stats()["success"]
assert abs(float(values[1] / values[0]) - 1.4) < 1e-6, values
plain = nlp.make_solver("ipopt", hessian="exact", ipopt={"print_level": 0, "sb": "yes"})
free = plain(**nlp.solver_arguments)
assert abs(float(free["x"][0]) - 199.459) < 0.01
assert float(found["f"]) > float(free["f"])
assert local.jacobian.size_out(0) == (len(step.residual_names), v.numel())
"""


def test_the_blocks_run(repository, tmp_path) -> None:
    text = (repository / "docs" / "program.md").read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    own = [line for line in blocks[1].splitlines() if line.strip()]
    assert len(own) <= 6, "five lines of one's own, and one to print"
    (tmp_path / "page.py").write_text("\n".join([*blocks, CHECKS]), encoding="utf-8")
    run = subprocess.run(
        [sys.executable, str(tmp_path / "page.py")], cwd=repository, capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "theta (2, 1) ('spring_1.stiffness', 'spring_2.stiffness')" in run.stdout
    assert "q[springs_series] (3, 401)" in run.stdout


def test_what_it_names_exists(repository) -> None:
    from yid_ocp.solvers.nonlinear_program import NonlinearProgram

    text = (repository / "docs" / "program.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`nlp\.(\w+)", text))
    assert {"w", "p", "f", "g", "hessian", "solver_arguments"} <= named
    fields = {*NonlinearProgram.__dataclass_fields__, *vars(NonlinearProgram)}
    assert named <= fields
