"""A dataset as LeRobot stores it, for the import and for printed commands."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from yid_ocp.data import JointGroup


def lerobot_dataset(folder: Path, joints: JointGroup) -> Path:
    """A dataset of one episode as LeRobot makes it: angles in degrees as 32-bit numbers, the gripper in per cent."""
    pyarrow: Any = pytest.importorskip("pyarrow", reason="LeRobot needs pyarrow: pip install '.[lerobot]'")
    from pyarrow import parquet

    shape = {"dtype": "float32", "shape": [6], "names": [f"{name}.pos" for name in joints.names]}
    info = {"codebase_version": "v3.0", "fps": 50, "features": {"action": shape, "observation.state": shape}}
    (folder / "meta").mkdir(parents=True)
    (folder / "meta" / "info.json").write_text(json.dumps(info | {"total_episodes": 1, "robot_type": "so101_follower"}))
    (folder / "data" / "chunk-000").mkdir(parents=True)
    both = {"observation.state": joints.position, "action": joints.position_command}
    turned = {name: np.degrees(x).astype(np.float32) for name, x in both.items()}
    columns: dict[str, Any] = {name: np.hstack([x[:, :5], 50 + 0 * x[:, 5:]]).tolist() for name, x in turned.items()}
    columns |= {"frame_index": list(range(len(joints.t))), "episode_index": [0] * len(joints.t)}
    parquet.write_table(pyarrow.table(columns), folder / "data" / "chunk-000" / "file-000.parquet")
    return folder
