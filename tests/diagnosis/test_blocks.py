"""What is held out: blocks of one recording, and recordings as far as the nominal model can follow them."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import pytest
from factories import cases
from small_problems import swinging_pendulum

from yid_ocp.diagnosis import hypotheses
from yid_ocp.diagnosis.diagnose import diagnose
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, HeldOutTruncation
from yid_ocp.problem import EstimationProblem, ProblemOptions


@pytest.fixture(scope="module")
def swinging(urdf_folder):
    """A pendulum let go, with dry friction in the elbow that the model does not know."""
    step, record = swinging_pendulum(urdf_folder, ("joint_coulomb", "elbow", {"tau_c": 0.02}))
    options = ProblemOptions(
        initial_state="estimated", initial_configuration_prior_std=0.5, initial_velocity_prior_std=2.0
    )
    return EstimationProblem(step, [record(1, 400, 0.4, 1e-3)], ("elbow.damping", "shoulder.damping"), options)


def test_the_held_out_blocks_begin_where_the_others_do(swinging):
    finding = diagnose(swinging, ["joint_coulomb", "joint_viscous"])
    assert finding.is_split_in_blocks
    assert "Every second block of time is held out" in finding.summary
    assert finding.nominal_held_out_test.chi2_per_dof == pytest.approx(finding.nominal_test.chi2_per_dof, rel=0.3)
    assert finding.verdict == "effect"
    assert finding.accepted_effects[0].label == "joint_coulomb@elbow"
    assert finding.gap_locations[0].location == "elbow"


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

    def pack_unknowns(self, values):
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
    ).truncate_failing_held_out_recordings({}, margin)


WHOLE, NOTHING_OF_IT = Held("a", 500), HeldOutTruncation("b", 0.0, 5.0)


@cases(
    "held, margin, kept, cuts",
    {
        "followed to its end": ([WHOLE], 0.9, (WHOLE,), ()),
        "too short a beginning": ([WHOLE, Held("b", 500, until=100)], 0.9, (WHOLE,), (NOTHING_OF_IT,)),
        "no margin": ([WHOLE, Held("b", 500, until=450)], 0.0, (WHOLE,), (NOTHING_OF_IT,)),
        "nothing is left but blocks of others": ([Held("b", 500, until=50)], 0.9, ("blocks",), (NOTHING_OF_IT,)),
    },
)
def test_what_is_followed_stays_and_too_little_is_left_out(followed, held, margin, kept, cuts):
    composed, found = followed(*held, margin=margin)
    assert (composed.problem.held_out, found) == (kept, cuts)
    assert composed.is_split_in_blocks is (kept == ("blocks",))


def test_what_is_lost_on_the_way_is_compared_until_shortly_before(followed):
    composed, [cut] = followed(WHOLE, Held("b", 500, until=300))
    kept, cut_short = composed.problem.held_out
    assert kept == WHOLE
    # found to a sixty-fourth of 500 steps, less a tenth
    assert 0.9 * (300 - 8) - 1 <= cut_short.steps <= 0.9 * 300
    assert cut == HeldOutTruncation("b", cut_short.steps * 0.01, 5.0)
    barely, _ = followed(WHOLE, Held("b", 500, until=130))
    assert len(barely.problem.held_out) == 2
