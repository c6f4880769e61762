"""Held-out recordings that the nominal model cannot follow to their end, rule by rule."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import pytest
from factories import fit, loss
from heard import Heard

from yid_ocp.diagnosis import hypotheses
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem, TruncatedRecording
from yid_ocp.diagnosis.refit import RefitContext
from yid_ocp.diagnosis.thresholds import Thresholds

module = importlib.import_module("yid_ocp.diagnosis.diagnose")


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


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(hypotheses, "truncate_episode", lambda episode, steps: replace(episode, steps=steps))
    monkeypatch.setattr(hypotheses, "_in_blocks", lambda problem: replace(problem, held_out=("blocks",)))


def followed(*held, margin=0.9):
    return AllCandidatesProblem(Problem(held_out=held), (), False).truncate_held_out({}, margin)


def test_what_is_followed_to_its_end_stays():
    composed, cuts = followed(Held("a", 500))
    assert cuts == ()
    assert composed.problem.held_out == (Held("a", 500),)


def test_what_is_lost_on_the_way_is_compared_until_shortly_before():
    whole, lost = Held("a", 500), Held("b", 500, until=300)
    composed, [cut] = followed(whole, lost)
    kept, cut_short = composed.problem.held_out
    assert kept == whole
    # found to a sixty-fourth of 500 steps, less a tenth
    assert 0.9 * (300 - 8) - 1 <= cut_short.steps <= 0.9 * 300
    assert cut == TruncatedRecording("b", cut_short.steps * 0.01, 5.0)
    assert not composed.is_split_in_blocks


def test_too_short_a_beginning_is_left_out():
    composed, cuts = followed(Held("a", 500), Held("b", 500, until=100))
    assert composed.problem.held_out == (Held("a", 500),)
    assert cuts == (TruncatedRecording("b", 0.0, 5.0),)
    barely, _ = followed(Held("a", 500), Held("b", 500, until=130))
    assert len(barely.problem.held_out) == 2


def test_where_nothing_is_left_the_other_recordings_are_split():
    composed, cuts = followed(Held("b", 500, until=50))
    assert composed.is_split_in_blocks
    assert composed.problem.held_out == ("blocks",)
    assert cuts == (TruncatedRecording("b", 0.0, 5.0),)


def test_with_no_margin_nothing_of_it_is_kept():
    composed, [cut] = followed(Held("a", 500), Held("b", 500, until=450), margin=0.0)
    assert (composed.problem.held_out, cut.kept_duration) == ((Held("a", 500),), 0.0)


# -- in a diagnosis ---------------------------------------------------------------------------------------------------


def run(monkeypatch, *losses, before=()):
    """The nominal fit beside what is left of its held-out recordings, whose losses come one after the other."""
    margins, heard, todo = [], Heard(), list(losses)

    def cut(self, values, margin):
        margins.append(margin)
        return replace(self, problem=f"cut {margin}"), (TruncatedRecording("b", 5 * margin, 5.0),)

    monkeypatch.setattr(AllCandidatesProblem, "truncate_held_out", cut)
    monkeypatch.setattr(
        module, "_settled", lambda composed, *_: todo and fit(lost=loss(todo.pop(0)), problem=composed.problem)
    )
    search = RefitContext(AllCandidatesProblem("whole", (), False), Thresholds(), heard)
    first = fit(lost=loss(todo.pop(0)), problem="whole")
    return (*module._followed(search, first, before), margins, heard.stages)


def test_a_model_that_follows_everything_is_left_alone(monkeypatch):
    search, nominal, cuts, margins, said = run(monkeypatch, 3.0)
    assert (search.problem.problem, nominal.problem, cuts, margins, said) == ("whole", "whole", (), [], [])


def test_recordings_are_cut_until_the_model_follows(monkeypatch):
    search, nominal, cuts, margins, said = run(monkeypatch, math.inf, math.inf, 7.0)
    assert (search.problem.problem, nominal.held_out_loss.chi2_per_sample, margins) == ("cut 0.5", 7.0, [0.9, 0.5])
    assert cuts == (TruncatedRecording("b", 2.5, 5.0),), "the last cut of a recording counts"
    assert said[0] == "The nominal model follows b for 4.5 of 5 s only; the rest is left out."


def test_cuts_of_an_earlier_round_stay(monkeypatch):
    known = (TruncatedRecording("a", 1.0, 5.0), TruncatedRecording("b", 4.0, 5.0))
    *_, cuts, _, _ = run(monkeypatch, math.inf, 7.0, before=known)
    assert cuts == (TruncatedRecording("a", 1.0, 5.0), TruncatedRecording("b", 4.5, 5.0))
