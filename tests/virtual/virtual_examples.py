"""Systems and values that the tests of this folder share."""

import pytest
from baxter import baxter_foam_y_system

mujoco = pytest.importorskip("mujoco", reason="virtual experiments need MuJoCo: pip install '.[blind]'")

TRUTH = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}
SYSTEMS = {arms: baxter_foam_y_system(arms) for arms in (1, 2)}
