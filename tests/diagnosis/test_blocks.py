"""What is held out: blocks of one recording, and recordings as far as the nominal model can follow them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import pytest
from small_problems import swinging_pendulum

from yid_ocp.diagnosis import diagnose, hypotheses
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, TruncatedHeldOutRecording
from yid_ocp.problem import EstimationProblem, ProblemOptions


@pytest.fixture(scope="module")
def swinging(urdf_folder):
    """A pendulum let go, with dry friction in the elbow that the model does not know."""
    step, record = swinging_pendulum(urdf_folder, ("joint_coulomb", "elbow", {"tau_c": 0.02}))
    options = ProblemOptions(initial_state="estimated", start_configuration_std=0.5, start_velocity_std=2.0)
    return EstimationProblem(step, [record(1, 400, 0.4, 1e-3)], ("elbow.damping", "shoulder.damping"), options)


def test_the_held_out_blocks_begin_where_the_others_do(swinging):
    finding = diagnose(swinging, ["joint_coulomb", "joint_viscous"])
    assert finding.is_split_in_blocks
    assert finding.nominal_held_out_test.chi2_per_dof == pytest.approx(finding.nominal_test.chi2_per_dof, rel=0.3)
    assert finding.verdict == "effect"
    assert finding.accepted_effects[0].label == "joint_coulomb@elbow"
    assert finding.gap_locations[0].location == "elbow"


# -- recordings that are not followed to their end --------------------------------------------------------------------


@dataclass(frozen=True)
class Held:
    """A recording of so many steps of 10 ms, of which a model follows `until`."""

    name: str
    steps: int
    until: int = 10**9

    @property
    def grid(self):
        return SimpleNamespace(steps=self.steps, time_step=0.01)


@dataclass(frozen=True)
class Problem:
    episodes: tuple = ("own",)
    held_out: tuple = ()
    tried: list = field(default_factory=list)
    has_process_noise: bool = False

    def vector(self, values):
        return values

    def with_episodes(self, episodes, held_out):
        return replace(self, episodes=tuple(episodes), held_out=tuple(held_out))

    def predict_held_out(self, x):
        self.tried.extend((h.name, h.steps) for h in self.held_out)
        return [(h, "it snaps" if h.steps > h.until else object()) for h in self.held_out]


@pytest.fixture
def followed(monkeypatch):
    monkeypatch.setattr(hypotheses, "truncate_episode", lambda episode, steps: replace(episode, steps=steps))
    monkeypatch.setattr(hypotheses, "_in_blocks", lambda problem: replace(problem, held_out=("blocks",)))
    return lambda *held, margin=0.9: AllCandidatesProblem(
        Problem(held_out=held), (), False
    ).truncate_held_out_recordings({}, margin)


def test_what_is_followed_to_its_end_stays(followed):
    composed, cuts = followed(Held("a", 500))
    assert (cuts, composed.problem.held_out) == ((), (Held("a", 500),))


def test_what_is_lost_on_the_way_is_compared_until_shortly_before(followed):
    whole, lost = Held("a", 500), Held("b", 500, until=300)
    composed, [cut] = followed(whole, lost)
    kept, cut_short = composed.problem.held_out
    assert kept == whole
    # found to a sixty-fourth of 500 steps, less a tenth
    assert 0.9 * (300 - 8) - 1 <= cut_short.steps <= 0.9 * 300
    assert cut == TruncatedHeldOutRecording("b", cut_short.steps * 0.01, 5.0)
    assert not composed.is_split_in_blocks


def test_too_short_a_beginning_is_left_out(followed):
    composed, cuts = followed(Held("a", 500), Held("b", 500, until=100))
    assert composed.problem.held_out == (Held("a", 500),)
    assert cuts == (TruncatedHeldOutRecording("b", 0.0, 5.0),)
    barely, _ = followed(Held("a", 500), Held("b", 500, until=130))
    assert len(barely.problem.held_out) == 2


def test_where_nothing_is_left_the_other_recordings_are_split(followed):
    composed, cuts = followed(Held("b", 500, until=50))
    assert (composed.is_split_in_blocks, composed.problem.held_out) == (True, ("blocks",))
    assert cuts == (TruncatedHeldOutRecording("b", 0.0, 5.0),)


def test_with_no_margin_nothing_of_it_is_kept(followed):
    composed, [cut] = followed(Held("a", 500), Held("b", 500, until=450), margin=0.0)
    assert (composed.problem.held_out, cut.kept_duration) == ((Held("a", 500),), 0.0)
