"""Changes of an experiment, rule by rule: which there are, which go together, what each tells, which are fewest."""

from __future__ import annotations

import itertools
import math
from types import SimpleNamespace

import numpy as np
import pytest

from yid_ocp.analysis import what_if as module
from yid_ocp.analysis.experiment_design import (
    _DEFAULT_ARM_POINT_STD,
    _DEFAULT_CAMERA_RATE,
    _DEFAULT_CAMERA_STD,
    ARM_GROUP,
    CAMERA_GROUP,
    MECHANICAL_CHANGES,
    FrameObservation,
    uniform_sample_times,
)
from yid_ocp.analysis.what_if import (
    _MIN_INFORMATION_EIGENVALUE,
    ChangedExperimentResult,
    ExperimentChange,
    WhatIfOptions,
    _are_compatible,
    _greedy,
    _Outcomes,
    _possible_changes,
    _rank_results,
    _relative_stds_and_gain,
    _smallest,
    what_if,
)
from yid_ocp.errors import SolverError
from yid_ocp.problem.measurements import TimeGrid
from yid_ocp.progress import NULL_PROGRESS


def change(name, **more):
    """A change by its name alone, its mechanics or rate read from it."""
    mechanics = name if name in MECHANICAL_CHANGES else ""
    rate = float(name.removeprefix("rate:")) if name.startswith("rate:") else None
    return ExperimentChange(name, f"words of {name}", mechanics, camera_rate=rate, **more)


def outcome(*names, found=0, gain=0.0, of=3, failed=False):
    """What some changes would tell: `found` of `of` parameters identifiable."""
    verdicts = {f"k{i}": "identifiable" if i < found else "weak" for i in range(of)}
    return ChangedExperimentResult(names, "", {}, {} if failed else verdicts, found, -math.inf if failed else gain)


# -- ranks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("made", "complete"),
    [(outcome(found=3), True), (outcome(found=2), False), (outcome(failed=True), False), (outcome(of=0), False)],
)
def test_complete_is_every_parameter(made, complete):
    assert made.is_fully_identifiable is complete


def test_most_identifiable_first_then_gain_and_what_failed_last():
    order = [
        outcome("d", found=2, gain=1.0),
        outcome("a", found=1, gain=9.0),
        outcome("c", found=1, gain=2.0),
        outcome("b", found=0, gain=50.0),
        outcome("e", found=0, failed=True),
    ]
    for shuffled in itertools.permutations(order):
        assert [entry.changes for entry in _rank_results(shuffled)] == [("d",), ("a",), ("c",), ("b",), ("e",)]


@pytest.mark.parametrize(
    ("names", "together"),
    [
        ((), True),
        (("motion",), True),
        (("travel", "weld", "second_arm", "torque", "rate:10"), True),
        (("motion", "travel"), False),
        (("rate:10", "rate:30"), False),
    ],
)
def test_one_rate_and_one_motion_go_together(names, together):
    assert _are_compatible([change(name) for name in names]) is together


# -- sets -------------------------------------------------------------------------------------------------------------


class Table:
    """Outcomes of sets of changes as a table says; those not in it tell nothing."""

    def __init__(self, **known):
        self.known = {frozenset(key.split("_")): entry for key, entry in known.items()}
        self.asked = []

    def of_all(self, sets):
        return [self._of(changes) for changes in sets]

    def _of(self, changes):
        names = tuple(entry.name for entry in changes)
        self.asked.append(names)
        found, gain = self.known.get(frozenset(names), (0, 0.0))
        return outcome(*names, found=found, gain=gain)


A, B, C, D = (change(name) for name in "abcd")
MOTION, TRAVEL = change("motion"), change("travel")


@pytest.mark.parametrize(
    ("known", "base", "largest", "sets"),
    [
        ({"a": (3, 1.0), "b": (2, 5.0), "a_b": (3, 9.0)}, outcome(), 3, [("a",)]),
        ({"a": (2, 1.0), "a_b": (3, 9.0), "c_d": (3, 1.0), "a_b_c": (3, 20.0)}, outcome(), 3, [("a", "b"), ("c", "d")]),
        ({"b_c_d": (3, 9.0)}, outcome(), 3, [("b", "c", "d")]),
        ({"b_c_d": (3, 9.0)}, outcome(), 2, []),
        ({"b": (3, 9.0)}, outcome(), 0, []),
    ],
    ids=["one does", "two pairs do", "three do", "no pair does", "none may be tried"],
)
def test_the_fewest_changes_that_find_every_parameter(known, base, largest, sets):
    found = _smallest(Table(**known), [A, B, C, D], base, largest)
    assert [entry.changes for entry in found] == sets


def test_an_experiment_that_tells_all_needs_no_change():
    table = Table()
    table.known[frozenset()] = (3, 0.0)
    assert [entry.changes for entry in _smallest(table, [A, B], outcome(found=3), 3)] == [()]
    assert table.asked == [()]


def test_sets_that_do_not_go_together_are_not_tried():
    table = Table(motion_travel=(3, 1.0))
    assert _smallest(table, [MOTION, TRAVEL], outcome(), 3) == []
    assert table.asked == [("motion",), ("travel",)]
    assert _smallest(Table(), [], outcome(), 3) == []


@pytest.mark.parametrize(
    ("known", "base", "largest", "steps"),
    [
        ({"a": (1, 1.0), "b": (1, 2.0), "b_a": (2, 1.0), "b_c": (2, 3.0), "b_c_d": (3, 4.0)}, outcome(), 3, "b bc bcd"),
        ({"a": (1, 1.0), "b": (1, 2.0), "b_c": (2, 3.0), "b_c_d": (3, 4.0)}, outcome(), 2, "b bc"),
        ({"a": (3, 1.0), "a_b": (3, 2.0)}, outcome(), 3, "a"),
        ({"a": (1, 1.0), "a_b": (1, 1.0)}, outcome(), 3, "a"),
        ({"a": (1, 1.0), "a_b": (1, 1.5)}, outcome(), 2, "a ab"),
        ({"a": (1, 5.0)}, outcome(found=2, gain=1.0), 3, ""),
        ({"a": (3, 5.0)}, outcome(found=3, gain=1.0), 3, ""),
        ({"a": (3, 5.0)}, outcome(), 0, ""),
    ],
    ids=[
        "one after the other",
        "not more than wanted",
        "until all are found",
        "until nothing is gained",
        "gain counts where none is found",
        "never to the worse",
        "nothing to find",
        "none may be tried",
    ],
)
def test_greedy_adds_the_best_single_change(known, base, largest, steps):
    found = _greedy(Table(**known), [A, B, C, D], base, largest)
    assert ["".join(entry.changes) for entry in found] == steps.split()


def test_greedy_ends_where_nothing_more_goes_together():
    table = Table(motion=(1, 1.0), motion_travel=(3, 9.0))
    found = _greedy(table, [MOTION, TRAVEL], outcome(), 3)
    assert [entry.changes for entry in found] == [("motion",)]


# -- what an experiment tells -----------------------------------------------------------------------------------------


def layout(names, x, scales=None, free=None, notes=(), information=None, grasps=()):
    free = tuple(free or names)
    problem = SimpleNamespace(
        unknown_names=tuple(names),
        unknown_scales=np.array(scales or np.ones(len(names))),
        system=SimpleNamespace(grasps=grasps),
    )
    told = []

    def inform(views):
        told.append(views)
        return np.array(information, float)

    return SimpleNamespace(
        problem=problem,
        x=np.array(x),
        free_parameters=free,
        feasibility_notes=notes,
        fisher_information=inform,
        told=told,
    )


def gained(*values):
    return 0.5 * sum(math.log1p(16 * value) for value in values)


def test_the_limit_of_identifiability_is_four_hundred_percent():
    assert module.MAX_WEAK_RELATIVE_STD == 4


def test_relative_precision_of_known_parameters():
    made = layout("ab", [2.0, -5.0])
    std, gain = _relative_stds_and_gain(made, np.diag([100.0, 4.0]))
    assert std == pytest.approx({"a": 0.1 / 2.0, "b": 0.5 / 5.0})
    assert gain == pytest.approx(gained(400.0, 100.0))


def test_a_parameter_at_zero_has_its_scale():
    std, gain = _relative_stds_and_gain(layout("ab", [0.0, 5.0], [3.0, 7.0]), np.diag([1.0, 1.0]))
    assert std == pytest.approx({"a": 1 / 3, "b": 1 / 5})
    assert gain == pytest.approx(gained(9.0, 25.0))


def test_nuisances_take_their_part():
    """The information of three unknowns, of which the one in the middle is not asked for."""
    rng = np.random.default_rng(4)
    root = rng.standard_normal((6, 3))
    information = root.T @ root
    std, _ = _relative_stds_and_gain(layout(("a", "n", "b"), [2.0, 9.0, 4.0], [1.0, 0.1, 1.0], ("a", "b")), information)
    covariance = np.linalg.inv(information)
    assert std == pytest.approx({"a": math.sqrt(covariance[0, 0]) / 2, "b": math.sqrt(covariance[2, 2]) / 4})


def test_correlated_parameters_are_judged_together():
    information = np.array([[2.0, 1.0], [1.0, 1.0]])
    std, gain = _relative_stds_and_gain(layout("ab", [1.0, 1.0]), information)
    assert std == pytest.approx({"a": 1.0, "b": math.sqrt(2.0)})
    assert gain == pytest.approx(gained(*np.linalg.eigvalsh(information)))


def test_what_is_not_seen_is_unknown_up_to_a_floor():
    std, gain = _relative_stds_and_gain(layout("ab", [1.0, 1.0]), np.diag([4.0, 0.0]))
    assert std == pytest.approx({"a": 0.5, "b": 1 / math.sqrt(_MIN_INFORMATION_EIGENVALUE)})
    assert gain == pytest.approx(gained(4.0, 0.0))


# -- views ------------------------------------------------------------------------------------------------------------

GRID = TimeGrid(10.0, 0.1, 20)


class Recorded:
    """A setting with a camera that sees the tip and an arm that feels the hand; either may be missing."""

    def __init__(self, camera=True, arm=True, grasps=("hand",), episodes=1):
        self.t_camera, self.t_arm = np.array([0.0, 0.5, 1.0, 1.5]), np.array([0.0, 0.1, 0.2])
        self._camera = SimpleNamespace(name="points_camera_1", t=10.0 + self.t_camera) if camera else None
        self._arm = SimpleNamespace(name="points_arm_1", t=10.0 + self.t_arm) if arm else None
        self.grasps = [SimpleNamespace(held_frame=name) for name in grasps]
        made = [SimpleNamespace(grid=GRID, number=i) for i in range(episodes)]
        self.problem = SimpleNamespace(episodes=made, system=SimpleNamespace(grasps=self.grasps))

    def camera_sampling(self, episode):
        return (
            (self._camera, self.t_camera, 5e-3) if self._camera else (None, np.array([0.0, 1.0]), _DEFAULT_CAMERA_STD)
        )

    def arm_sampling(self, episode):
        return (self._arm, self.t_arm, 2e-3) if self._arm else (None, np.array([0.0, 0.1]), _DEFAULT_ARM_POINT_STD)

    def recorded_observations(self, episode):
        found = []
        if self._camera:
            found += [
                FrameObservation("points_camera_1", name, self.t_camera[1:], np.ones((3, 3)))
                for name in ("tip", "elbow")
            ]
        if self._arm:
            found.append(FrameObservation("points_arm_1", "hand", self.t_arm, np.ones((3, 3))))
        return found


def views(setting, changes, grasps=None):
    made = layout(
        "a", [1.0], grasps=setting.grasps if grasps is None else [SimpleNamespace(held_frame=g) for g in grasps]
    )
    return _Outcomes(setting, None, 1.0)._views(setting.problem.episodes[0], changes, made)


def said(view):
    return view.point_group, view.frame, len(view.times), float(view.std[0, 0])


def test_without_changes_everything_is_seen_as_it_was():
    setting = Recorded()
    found = views(setting, [])
    assert [said(view) for view in found] == [said(view) for view in setting.recorded_observations(None)]


@pytest.mark.parametrize(
    ("has", "group", "times", "std"),
    [(True, "points_camera_1", [0.0, 0.5, 1.0, 1.5], 5e-3), (False, CAMERA_GROUP, [0.0, 1.0], _DEFAULT_CAMERA_STD)],
    ids=["a camera", "none so far"],
)
def test_a_camera_sees_more(has, group, times, std):
    found = views(
        Recorded(camera=has),
        [change("x", added_camera_frames=("w_T3", "w_T2")), change("y", added_camera_frames=("w_T1",))],
    )
    new = [view for view in found if view.frame.startswith("w_")]
    assert [view.frame for view in new] == ["w_T3", "w_T2", "w_T1"]
    for view in new:
        assert view.point_group == group
        np.testing.assert_array_equal(view.times, times)
        np.testing.assert_array_equal(view.std, np.full((len(times), 3), std))


@pytest.mark.parametrize(
    ("has", "group", "times", "std"),
    [(True, "points_arm_1", [0.0, 0.1, 0.2], 2e-3), (False, ARM_GROUP, [0.0, 0.1], _DEFAULT_ARM_POINT_STD)],
    ids=["an arm", "none so far"],
)
def test_an_arm_feels_more(has, group, times, std):
    found = views(Recorded(arm=has), [change("x", added_arm_frames=("w_T3",))])
    assert found[-1].point_group == group
    assert found[-1].frame == "w_T3"
    np.testing.assert_array_equal(found[-1].times, times)
    np.testing.assert_array_equal(found[-1].std, np.full((len(times), 3), std))


def test_another_rate_is_the_cameras_alone():
    found = views(
        Recorded(), [change("rate:4"), change("x", added_camera_frames=("w_T3",), added_arm_frames=("w_T1",))]
    )
    even = uniform_sample_times(GRID, 4.0)
    assert [view.frame for view in found] == ["tip", "elbow", "hand", "w_T3", "w_T1"]
    for view in found:
        if view.point_group == "points_camera_1":
            np.testing.assert_array_equal(view.times, even)
            np.testing.assert_array_equal(view.std, np.full((len(even), 3), 5e-3))
        else:
            assert len(view.times) == 3


def test_what_a_second_arm_holds_is_that_arms_to_measure():
    found = views(Recorded(), [], grasps=("hand", "tip"))
    assert [(view.point_group, view.frame) for view in found] == [
        ("points_camera_1", "elbow"),
        ("points_arm_1", "hand"),
        ("points_arm_1", "tip"),
    ]
    assert said(found[-1]) == ("points_arm_1", "tip", 3, 2e-3)


# -- outcomes ---------------------------------------------------------------------------------------------------------


class Builder:
    def __init__(self, **layouts):
        self.layouts = layouts
        self.asked = []

    def build_experiment(self, mechanics):
        self.asked.append(mechanics)
        return self.layouts["_".join(sorted(mechanics)) or "base"]

    def applicable_changes(self):
        return ["weld", "motion"]


def test_an_outcome_counts_what_is_identifiable_and_is_worked_out_once():
    base = layout("abcd", [1.0, 2.0, 1.0, 1.0], information=np.diag([100.0, 1.0, 1.0, 0.01]), notes=("one", "two"))
    builder = Builder(base=base)
    outcomes = _Outcomes(Recorded(episodes=2), builder, 1.0)
    (found,) = outcomes.of_all([()])
    assert (found.changes, found.words, found.message) == ((), "as it is", "one; two")
    assert found.std_relative == pytest.approx({"a": 0.1, "b": 0.5, "c": 1.0, "d": 10.0})
    assert found.verdicts == {"a": "identifiable", "b": "weak", "c": "weak", "d": "not_identifiable"}
    assert found.identifiable == 1
    assert found.gain == pytest.approx(gained(100.0, 4.0, 1.0, 0.01))
    assert len(base.told[0]) == 2
    assert outcomes.of_all([()])[0] is found
    assert outcomes.count == 1
    assert builder.asked == [frozenset()]


def test_a_fit_that_is_worse_than_its_noise_informs_less():
    base = layout("a", [1.0], information=[[100.0]])
    assert _Outcomes(Recorded(), Builder(base=base), 4.0).of_all([()])[0].std_relative == pytest.approx({"a": 0.2})


def test_the_order_of_changes_does_not_matter():
    both = layout("a", [1.0], information=[[100.0]])
    builder = Builder(motion_weld=both)
    outcomes = _Outcomes(Recorded(), builder, 1.0)
    weld, motion, rate = change("weld"), change("motion"), change("rate:5")
    (found,) = outcomes.of_all([(weld, motion, rate)])
    assert found.changes == ("weld", "motion", "rate:5")
    assert found.words == "words of weld; words of motion; words of rate:5"
    assert builder.asked == [frozenset({"weld", "motion"})]
    assert outcomes.of_all([(rate, motion, weld)])[0] is found


def test_what_cannot_be_built_tells_nothing():
    (found,) = _Outcomes(Recorded(), Builder(weld="it snaps"), 1.0).of_all([(change("weld"),)])
    assert (found.verdicts, found.std_relative, found.identifiable, found.gain) == ({}, {}, 0, -math.inf)
    assert found.message == "it snaps"


# -- which changes there are ------------------------------------------------------------------------------------------


def sight(name, arm=False):
    return SimpleNamespace(name=name, description=f"the {name}", is_arm_measurable=arm)


@pytest.fixture
def seen(monkeypatch):
    made = [sight("tip"), sight("middle"), sight("hand", arm=True), sight("marker", arm=True)]
    monkeypatch.setattr(module, "observable_frames", lambda system: made)


@pytest.mark.usefixtures("seen")
@pytest.mark.parametrize(
    ("setting", "names"),
    [
        (Recorded(), "camera:middle camera:marker arm:marker rate:10 rate:30"),
        (Recorded(camera=False), "camera:tip camera:middle camera:marker arm:marker"),
        (Recorded(arm=False), "camera:middle camera:hand arm:hand camera:marker arm:marker rate:10 rate:30"),
        (Recorded(camera=False, arm=False), "camera:tip camera:middle camera:hand arm:hand camera:marker arm:marker"),
    ],
    ids=["both", "no camera", "no arm", "neither"],
)
def test_what_is_not_seen_could_be_seen(setting, names):
    found = _possible_changes(setting, Builder())
    assert [entry.name for entry in found] == ["weld", "motion", *names.split()]
    assert [entry.mechanical_change for entry in found] == ["weld", "motion", *[""] * len(names.split())]
    assert found[0].description == MECHANICAL_CHANGES["weld"]
    for entry in found[2:]:
        kind, what = entry.name.split(":")
        assert entry.added_camera_frames == ((what,) if kind == "camera" else ())
        assert entry.added_arm_frames == ((what,) if kind == "arm" else ())
        assert entry.camera_rate == (float(what) if kind == "rate" else None)
    words = {entry.name: entry.description for entry in found}
    assert words["camera:middle"] == "the middle, seen by the camera"
    assert words["arm:marker"] == "the marker, seen by the arm"


@pytest.mark.usefixtures("seen")
@pytest.mark.parametrize(
    ("times", "rates"),
    [
        ([0.0, 0.2, 0.4], ["rate:10", "rate:30"]),
        ([0.0, 0.09, 0.18, 5.0], ["rate:30"]),
        ([0.0, 0.1, 0.2], ["rate:30"]),
        ([0.0, 0.01, 0.02], []),
        ([0.0], ["rate:10", "rate:30"]),
    ],
    ids=["5 Hz", "11 Hz with a gap", "10 Hz", "100 Hz", "one frame"],
)
def test_faster_cameras_than_there_was(times, rates):
    setting = Recorded()
    setting._camera.t = np.array(times) + 1e-12
    found = [entry for entry in _possible_changes(setting, Builder()) if entry.camera_rate is not None]
    assert [entry.name for entry in found] == rates
    if found:
        assert found[-1].description == "the camera at 30 Hz without gaps"


# -- all of it --------------------------------------------------------------------------------------------------------


@pytest.fixture
def pieces(monkeypatch, seen):
    """what_if with its builder and analysis replaced: remembers settings and asks."""
    kept = SimpleNamespace(
        settings=[], judged=[], chi2=2.25, base=layout("ab", [1.0, 1.0], information=np.diag([100.0, 1.0]))
    )

    class Setting(Recorded):
        def __init__(self, *arguments):
            super().__init__()
            kept.settings.append(arguments)

    def build(setting, progress):
        kept.progress = progress
        weld = layout("ab", [1.0, 1.0], information=np.diag([100.0, 100.0]))
        kept.builder = Builder(base=kept.base, weld=weld, motion="no", motion_weld=weld)
        return kept.builder

    def judge(problem, x, start, grasp_std):
        kept.judged.append((problem, x, start, grasp_std))
        return SimpleNamespace(chi2_per_dof=kept.chi2)

    monkeypatch.setattr(module, "BaseExperiment", Setting)
    monkeypatch.setattr(module, "CandidateExperimentBuilder", build)
    monkeypatch.setattr(module, "identifiability", judge)
    monkeypatch.setattr(module, "unknowns_from_solution", lambda problem, solution: (problem, solution))
    return kept


def test_all_single_changes_the_smallest_sets_and_the_greedy_ones(pieces):
    found = what_if("problem", progress=NULL_PROGRESS)
    assert pieces.settings == [("problem", ("problem", None), "assumed", None, None, 0.1, 11)]
    assert pieces.progress is NULL_PROGRESS
    assert pieces.judged == []
    assert found.unchanged_experiment.std_relative == pytest.approx({"a": 0.1, "b": 1.0})
    assert [entry.changes for entry in found.smallest_sufficient_sets] == [("weld",)]
    assert [entry.changes for entry in found.greedy_sequence] == [("weld",)]
    assert found.single_changes[0].changes == ("weld",)
    assert found.single_changes[-1].changes == ("motion",)
    assert len(found.single_changes) == 7
    assert found.n_evaluated_sets == 8


def test_the_smallest_sets_are_ranked(pieces):
    found = what_if("problem", options=WhatIfOptions(considered_changes=("motion", "weld"), max_set_size=1))
    assert [entry.changes for entry in found.single_changes] == [("weld",), ("motion",)]
    assert found.n_evaluated_sets == 3


@pytest.mark.parametrize(("chi2", "std"), [(2.25, 0.15), (0.5, 0.1)])
def test_at_a_solution_its_fit_counts_unless_better_than_the_noise(pieces, chi2, std):
    pieces.chi2 = chi2
    options = WhatIfOptions(torque_std=0.7, motion_seed=5, considered_changes=())
    found = what_if("problem", "fit", start="known", grasp_std=None, two_arm_system="arm", options=options)
    assert pieces.settings == [("problem", ("problem", "fit"), "known", None, "arm", 0.7, 5)]
    assert pieces.judged == [("problem", ("problem", "fit"), "known", None)]
    assert found.unchanged_experiment.std_relative["a"] == pytest.approx(std)
    assert (found.single_changes, found.smallest_sufficient_sets, found.greedy_sequence) == ((), (), ())


def test_an_experiment_that_cannot_be_worked_out_is_an_error(pieces):
    pieces.base = "it snaps at once"
    with pytest.raises(SolverError, match="it snaps at once"):
        what_if("problem")


def test_a_camera_that_nobody_had(pieces):
    assert (_DEFAULT_CAMERA_RATE, _DEFAULT_CAMERA_STD, _DEFAULT_ARM_POINT_STD) == (3.0, 5e-3, 1e-3)
