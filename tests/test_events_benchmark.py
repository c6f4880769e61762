"""Scores of `benchmarks/events.py`, and the real recordings that it is about."""

from __future__ import annotations

import json
from pathlib import Path
from types import ModuleType

import pytest
from test_coverage_benchmark import loaded

from yid_ocp.diagnosis.events import DisturbanceEvent


@pytest.fixture(scope="module")
def benchmark(repository: Path) -> ModuleType:
    """The module benchmarks/events.py."""
    return loaded(repository / "benchmarks", "events")


def event(begin: float, peak: float, joint: str = "elbow", recording: str = "run_pushed_01") -> DisturbanceEvent:
    return DisturbanceEvent(recording, joint, joint, "force", begin, begin + 0.5, peak, 0.25 * peak, 0.01, "N m")


LABEL = {"joint": "elbow", "t_from": 1.0, "t_to": 1.5, "peak": 0.6, "impulse": 0.12}


def test_joint_sign_and_window_must_be_right(benchmark: ModuleType) -> None:
    assert benchmark.matches(event(1.2, 0.4), LABEL)
    assert not benchmark.matches(event(1.2, -0.4), LABEL)
    assert not benchmark.matches(event(1.6, 0.4), LABEL)
    assert not benchmark.matches(event(1.2, 0.4, "shoulder"), LABEL)


def test_what_is_found_what_is_false_and_what_stands_apart(benchmark: ModuleType) -> None:
    late = LABEL | {"t_from": 7.0, "t_to": 7.5}
    labels = {"run_pushed_01": [LABEL, late]}
    found = [event(1.1, 0.4), event(2.5, 0.5), event(5.0, 0.5), event(2.5, 0.5, recording="run_calm_01")]
    score = benchmark.scored(found, {"run_pushed_01": 6.0}, labels, ("elbow", 2.3, 3.2))
    assert (score.labels, score.found, score.false, score.false_calm, score.apart) == (1, 1, 2, 1, 1)
    assert score.impulse == pytest.approx(0.1 / 0.12 - 1, abs=1e-9) or score.impulse == pytest.approx(1 - 0.1 / 0.12)
    assert (score.recall, score.precision) == (1.0, pytest.approx(1 / 3))
    assert score.shortcomings == ["precision 0.33"]
    assert benchmark.scored(found[:1], {}, labels).shortcomings == ["recall 0.50"]


@pytest.mark.slow
def test_injected_pushes_of_a_real_double_pendulum_are_found(benchmark: ModuleType) -> None:
    """Five pushed and three calm runs; about half a minute."""
    if not benchmark.RECORDINGS.is_dir():
        pytest.skip("the real recordings are not here (shared/recordings beside the project)")
    events = benchmark.diagnosed("acrobot", benchmark.RECORDINGS).events
    labels = json.loads((benchmark.RECORDINGS / "labels.json").read_text(encoding="utf-8"))
    own = {name: entry for name, entry in labels.items() if name.startswith("acrobot")}
    falls = {fall.recording: fall.time for fall in events.falls}
    score = benchmark.scored(events.found, falls, own, benchmark.UNLABELLED["acrobot"])
    assert score.shortcomings == []
    assert score.apart >= 3
