"""The pendulum whose motion is known and whose joint efforts are measured."""

import sys

import pytest
from pendulum_bench import bench as bench


@pytest.fixture
def without_law(monkeypatch):
    """No law of what is left is sought, which costs more than all before it: for tests that ask for other things."""
    monkeypatch.setattr(sys.modules["yid_ocp.diagnosis.diagnose"], "find_gap_law", lambda *_: None)
