"""A pendulum whose shoulder is moved and whose elbow is a spring, within limits."""

import pytest
from small_problems import pendulum_step

PENDULUM = """\
model:
  robot: {urdf}
  joint_springs:
    elbow: {{stiffness: 3.0, rest_position: 0.1}}
  arms: {{mode: prescribed, passive_joints: [elbow]}}
  damping: 0.2
  measured_points: [{points}]
parameters:
  elbow.stiffness: {{free: true}}
"""
LIMITS = '<limit lower="-1.2" upper="1.2" effort="40" velocity="6"/>'


@pytest.fixture(scope="session")
def limited_urdf(urdf_folder, tmp_path_factory):
    text = (urdf_folder / "double_pendulum.urdf").read_text()
    head, tail = text.split('<joint name="shoulder" type="continuous">')
    tail = tail.replace('<axis xyz="1 0 0"/>', f'<axis xyz="1 0 0"/>{LIMITS}', 1)
    file = tmp_path_factory.mktemp("limited") / "double_pendulum.urdf"
    file.write_text(f'{head}<joint name="shoulder" type="revolute">{tail}')
    return file


@pytest.fixture(scope="session")
def moved(limited_urdf):
    return pendulum_step(limited_urdf.parent, prescribed=("shoulder",))


@pytest.fixture
def pendulum(limited_urdf, written):
    """Write a configuration of the pendulum with more lines."""
    return lambda more, points="tip": written(PENDULUM.format(urdf=limited_urdf, points=points) + more, "pendulum.yaml")


@pytest.fixture
def refused(tmp_path, printed):
    """Check that `plan` refuses some settings with some words and leaves nothing."""

    def check(config, settings, words):
        told = printed("plan", config, "--out", tmp_path / "out", settings=settings, code=2)
        assert all(word in told for word in words), told
        assert not (tmp_path / "out").exists()

    return check
