"""The blind proof, rule by rule: what is drawn, how large, and how answers are marked and scored."""

from __future__ import annotations

import importlib
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
from factories import amplitude, effect, fit, loss, shape, signature

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.diagnosis.blind import Case, Ensemble, Label, answers, finer_values, mark, score, seal
from yid_ocp.diagnosis.blind import ensemble as module
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.virtual.experiment import PointCamera
from yid_ocp.virtual.injected import OUTSIDE, InjectedEffect
from yid_ocp.virtual.motion import Excitation

# the package's own name `score` is the function
scoring = importlib.import_module("yid_ocp.diagnosis.blind.score")
KV, DRY = InjectedEffect("kelvin_voigt", "T1", {"tau": 0.05}), InjectedEffect("joint_coulomb", "elbow", {"tau_c": 2.0})
GUST = InjectedEffect("gusts", "T3", {"size": 0.1})


def label(category, *injected, multiple=None):
    return Label("case_000", category, injected, multiple, {"T1.bend": 12.0})


def pair(text):
    kind, _, place = text.partition("@")
    return {"kind": kind, "location": place}


def said(verdict="effect", effects=(), which=None, where=(), confusable=(), closure=None, values=None):
    listed = effects if which is None else which
    return {
        "verdict": verdict,
        "effects": [pair(t) for t in effects],
        "which": [pair(t) | {"parameters": (values or {}).get(t, {})} for t in listed],
        "where": [{"location": p} for p in where],
        "confusable": [[pair(t) for t in group] for group in confusable],
        "gap": {"closure": closure},
    }


# -- marks ------------------------------------------------------------------------------------------------------------

RIGHT, WRONG = "kelvin_voigt@T1", "density@T2"


@pytest.mark.parametrize(
    ("case", "answer", "right"),
    [
        (label("null"), said("no_gap"), True),
        (label("null"), said("insufficient_data"), False),
        (label("null"), said("unknown"), False),
        (label("single", KV), said("effect", [RIGHT]), True),
        (label("single", KV), said("effect", [WRONG]), False),
        (label("single", KV), said("effect", [WRONG, RIGHT]), False),
        (label("single", KV), said("effect", [RIGHT, WRONG]), True),
        (label("single", KV), said("confusable", [WRONG], confusable=[[WRONG, RIGHT]]), True),
        (label("single", KV), said("confusable", [WRONG], confusable=[[WRONG, "a@b", RIGHT]]), True),
        (label("single", KV), said("confusable", [WRONG], confusable=[[WRONG, "a@b", "c@d", RIGHT]]), False),
        (label("single", KV), said("confusable", [WRONG, "a@b"], confusable=[["a@b", RIGHT]]), False),
        (label("single", KV), said("unknown", where=["T1"]), False),
        (label("finer_chain"), said("effect", [RIGHT]), False),
        (label("outside", GUST), said("unknown", where=["T3", "T1"]), True),
        (label("outside", GUST), said("unknown", where=["T1", "T3"]), False),
        (label("outside", GUST), said("unknown"), False),
        (label("outside", GUST), said("effect", [WRONG], where=["T3"]), False),
        (label("left_out", KV), said("unknown", where=["T1"]), True),
        (label("left_out", KV), said("effect", [RIGHT], where=["T1"]), False),
        (label("pair", KV, DRY), said("effect", [RIGHT, "joint_coulomb@elbow"]), True),
        (label("pair", KV, DRY), said("effect", ["joint_coulomb@elbow", "a@b", RIGHT]), True),
        (label("pair", KV, DRY), said("effect", [RIGHT]), False),
        (
            label("pair", KV, DRY),
            said("confusable", ["joint_coulomb@elbow"], confusable=[["joint_coulomb@elbow", RIGHT]]),
            True,
        ),
    ],
)
def test_what_is_right_depends_on_the_case(case, answer, right):
    assert mark(case, answer).right is right


@pytest.mark.parametrize(
    ("listed", "where", "first", "second", "located"),
    [
        ([RIGHT, WRONG], ["T1", "T2"], True, True, True),
        ([WRONG, RIGHT], ["T2", "T1"], False, True, False),
        ([WRONG, "a@b", RIGHT], ["T1"], False, False, True),
        ([], [], False, False, False),
    ],
)
def test_a_mark_says_what_comes_first(listed, where, first, second, located):
    found = mark(label("single", KV), said("unknown", [], which=listed, where=where))
    assert (found.kind_first, found.kind_second, found.location_first) == (first, second, located)


@pytest.mark.parametrize(
    ("verdict", "gap"),
    [("no_gap", False), ("insufficient_data", False), ("unknown", True), ("effect", True), ("confusable", True)],
)
def test_a_gap_is_reported_by_the_verdict(verdict, gap):
    assert mark(label("null"), said(verdict)).gap is gap


def test_a_clean_case_has_no_truth_to_be_first():
    found = mark(label("null"), said("effect", [WRONG], where=["T2"]))
    assert (found.kind_first, found.kind_second, found.location_first) == (False, False, False)
    assert (found.truth, found.answer, found.confusable) == ("-", WRONG, ())
    assert mark(label("null"), said("no_gap")).answer == "-"
    assert math.isnan(found.multiple)


def test_a_mark_keeps_case_answer_and_figures():
    group = [WRONG, RIGHT]
    found = mark(
        label("pair", KV, DRY, multiple=3.0),
        said("confusable", [WRONG, "a@b"], confusable=[["a@b", "c@d"], group], closure=0.5),
        best=0.8,
        seconds=7.0,
    )
    assert (found.case, found.category, found.verdict) == ("case_000", "pair", "confusable")
    assert (found.truth, found.answer) == ("kelvin_voigt@T1 + joint_coulomb@elbow", f"{WRONG} + a@b")
    assert (found.multiple, found.closure, found.best, found.seconds) == (3.0, 0.5, 0.8, 7.0)
    assert found.confusable == tuple(group)
    assert math.isnan(mark(label("null"), said("no_gap")).closure)


@pytest.mark.parametrize(
    ("value", "std", "error", "inside"),
    [
        (0.06, 0.01, 0.2, True),
        (0.06, 0.0052, 0.2, True),
        (0.06, 0.005, 0.2, False),
        (0.04, 0.0052, 0.2, True),
        (0.04, 0.005, 0.2, False),
    ],
)
def test_a_parameter_is_within_95_percent_or_not(value, std, error, inside):
    values = {RIGHT: {"tau": {"value": value, "std": std, "unit": "s"}}}
    found = mark(label("single", KV), said("effect", [WRONG, RIGHT], which=[WRONG, RIGHT], values=values))
    assert found.errors == {f"{RIGHT}.tau": (pytest.approx(error), inside)}


@pytest.mark.parametrize(
    ("injected", "effects", "values"),
    [
        (KV, [WRONG], {}),
        (KV, [RIGHT], {}),
        (KV, [RIGHT], {"tau": {"value": None, "std": 0.1}}),
        (KV, [RIGHT], {"tau": {"value": 0.05, "std": None}}),
        (InjectedEffect("kelvin_voigt", "T1", {"tau": math.inf}), [RIGHT], {"tau": {"value": 0.05, "std": 0.1}}),
        (GUST, ["gusts@T3"], {"size": {"value": 0.1, "std": 0.1}}),
    ],
    ids=["not named", "no value", "infinite", "unknown deviation", "truth is infinite", "in no library"],
)
def test_parameters_that_cannot_be_compared_are_left_out(injected, effects, values):
    found = mark(label("single", injected), said("effect", effects, values=dict.fromkeys(effects, values)))
    assert found.errors == {}


def test_an_error_relative_to_nothing_is_large():
    zero = InjectedEffect("kelvin_voigt", "T1", {"tau": 0.0})
    values = {RIGHT: {"tau": {"value": 1e-3, "std": 1.0}}}
    assert mark(label("single", zero), said("effect", [RIGHT], values=values)).errors[f"{RIGHT}.tau"][0] == 1e6


# -- rates ------------------------------------------------------------------------------------------------------------


def marked(category, **changed):
    usual = {
        "case": "c",
        "category": category,
        "truth": RIGHT,
        "verdict": "effect",
        "answer": RIGHT,
        "multiple": 3.0,
        "gap": True,
        "kind_first": True,
        "kind_second": True,
        "location_first": True,
        "confusable": (),
        "right": True,
        "closure": 0.9,
        "best": 1.0,
    }
    return scoring.Mark(**(usual | changed))


def test_rates_are_over_the_cases_that_they_speak_of():
    found = score(
        [
            marked("null", gap=True),
            marked("null", gap=False),
            marked("null", gap=False, seconds=4.0),
            marked("null", gap=False, seconds=8.0),
            marked("single", kind_first=False, location_first=False, errors={"a": (0.5, True), "b": (0.1, False)}),
            marked("single", kind_first=False, kind_second=False, closure=0.3, best=0.5, errors={"a": (0.2, True)}),
            marked("single", confusable=(WRONG, RIGHT), closure=math.nan),
            marked("single", confusable=(WRONG, "a@b", "c@d"), right=False, best=math.nan),
            marked("single", gap=False, right=False, multiple=1.0, kind_first=False, best=-1.0),
            marked("single", multiple=math.nan, best=0.0),
            marked("outside", verdict="unknown", location_first=False),
            marked("left_out", verdict="effect"),
            marked("left_out", verdict="no_gap", gap=False, location_first=False),
            marked("pair", right=False),
            marked("finer_chain", right=False),
        ]
    )
    assert found["cases"] == 15
    assert found["false_alarms"] == 0.25
    assert found["detection"] == {
        "1": {"cases": 1, "gap": 0.0, "right": 0.0},
        "3": {"cases": 4, "gap": 1.0, "right": 0.75},
    }
    assert found["kind_first"] == pytest.approx(3 / 5)
    assert found["kind_in_two"] == pytest.approx(4 / 5)
    assert found["location_first"] == pytest.approx(4 / 5)
    assert (found["confusable_covers"], found["confusable_size"]) == (0.5, 2.5)
    assert found["unknown_recall"] == pytest.approx(1 / 3)
    assert found["unknown_location"] == 0.5
    assert found["pairs_right"] == 0.0
    assert found["closure_of_best"] == pytest.approx((0.9 + 0.6) / 2)
    assert found["parameter_error"] == pytest.approx(0.2)
    assert found["interval_coverage"] == pytest.approx(2 / 3)
    assert found["seconds"] == 6.0
    assert len(found["marks"]) == 15


def test_no_cases_of_a_sort_have_no_rate():
    found = score([])
    assert found["cases"] == 0
    assert {found[key] for key in found if key not in ("format", "cases", "detection", "marks")} == {None}


# -- seals ------------------------------------------------------------------------------------------------------------


def test_a_sealed_text_is_sorted_and_holds_all():
    text, digest = seal([label("single", KV, multiple=3.0)])
    assert json.loads(text) == [
        {
            "case": "case_000",
            "category": "single",
            "injected": [{"kind": "kelvin_voigt", "location": "T1", "values": {"tau": 0.05}}],
            "multiple": 3.0,
            "truth": {"T1.bend": 12.0},
        }
    ]
    assert text.index('"case"') < text.index('"injected"') < text.index('"truth"')
    assert len(digest) == 64
    with pytest.raises(ValueError, match="not JSON compliant"):
        seal([label("single", multiple=math.nan)])


# -- the ensemble -----------------------------------------------------------------------------------------------------

DAMPER = effect("kelvin_voigt@T1", amplitude("tau", expected=(0.0, 0.2), unit="s"))
FRICTION = effect("joint_coulomb@elbow", amplitude("tau_c", expected=(0.0, 3.0)))
TILT = effect("gravity_tilt@world", *(amplitude(n, lower=-1.0, expected=(-0.5, 0.5)) for n in ("rx", "ry")))
SOLID = effect("standard_linear_solid@T2", amplitude(neutral=1.0, expected=(1.0, 3.0)), shape())
ABROAD = effect("clock_scale@clock", amplitude())


def system(driven=("s0", "s1", "w0"), prescribed=(), segments=("T1", "T2")):
    parameters = SimpleNamespace(names=("T1.bend", "T2.bend", "T1.damping"))
    elastic = [SimpleNamespace(segment="T1", kind="bend"), SimpleNamespace(segment="T2", kind="twist")]
    named = tuple(SimpleNamespace(name=name, links=(("a",),)) for name in segments)
    return SimpleNamespace(
        driven=driven, prescribed=prescribed, segments=named, parameters=parameters, elastic=tuple(elastic)
    )


def problem(of=None, pose=None):
    t = np.array([0.0, 0.1])
    joints = JointGroup(("w0", "s0", "s1", "more"), t, np.array([[0.3, 0.1, 0.2, 9.0], [1.0, 1.0, 1.0, 1.0]]))
    group = PointGroup("points", ("tip",), t, np.zeros((2, 1, 3)), pose=pose)
    recording = Recording(joints, (group,), name="first")
    return SimpleNamespace(
        system=of or system(),
        free=("T1.bend", "T2.bend"),
        theta=np.array([20.0, 5.0, 0.05]),
        episodes=(SimpleNamespace(recording=recording),),
        step="step",
        options="options",
    )


@pytest.fixture
def drawn(monkeypatch):
    """drawn(...): an ensemble whose recordings are made up; `made` remembers what was simulated."""
    made: list[dict] = []

    def experiment(of, truth, injected, settings):
        made.append(vars(settings) | {"system": of, "truth": dict(truth), "injected": tuple(injected)})
        if len(made) <= build.failures:
            raise ModelError("it flies away")
        return Recording(points=(PointGroup("p", ("tip",), np.array([0.0]), np.zeros((1, 1, 3))),), description="told")

    def multisine(of, truth, **settings):
        return {"of": of, "truth": dict(truth), **settings}

    def build(seed=3, candidates=(DAMPER, FRICTION, TILT, SOLID), finer=None, failures=0, **given):
        build.failures = failures
        monkeypatch.setattr(module, "chosen_effects", lambda *_: list(candidates))
        ensemble = Ensemble(problem(**given), seed, finer)
        columns = {"kelvin_voigt": [[100.0]], "joint_coulomb": [[0.5]], "gravity_tilt": [[30.0, 40.0]]}
        signatures = [
            signature(of, columns.get(of.kind, [[50.0]]), **({"s": 0.25} if of.shapes else {})) for of in candidates
        ]
        ensemble._point = SimpleNamespace(signatures=tuple(signatures))
        return ensemble

    monkeypatch.setattr(module, "injected_experiment", experiment)
    monkeypatch.setattr(module, "multisine", multisine)
    build.made = made
    return build


def test_an_ensemble_starts_where_the_recording_does(drawn):
    ensemble = drawn()
    assert ensemble.posture == {"s0": 0.1, "s1": 0.2, "w0": 0.3}
    assert not ensemble.vision
    assert drawn(pose=np.eye(4)).vision


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"of": system(driven=())}, "driven arms"),
        ({"of": system(prescribed=("clamp",))}, "driven arms"),
        ({"seed": -1}, "seed = -1"),
        ({"candidates": (ABROAD,)}, "none of the candidates"),
        ({"candidates": ()}, "none of the candidates"),
    ],
)
def test_what_cannot_be_simulated_is_refused(drawn, given, words):
    with pytest.raises(ConfigError, match=words):
        drawn(**given)
    drawn(seed=0)


def test_the_truth_is_spread_about_the_start(drawn):
    ensemble = drawn()
    found = [ensemble.truth(np.random.default_rng(seed)) for seed in range(200)]
    for name, start in (("T1.bend", 20.0), ("T2.bend", 5.0)):
        ratio = np.log([truth[name] / start for truth in found]) / math.log(1.5)
        assert -1 <= ratio.min() < -0.9
        assert 0.9 < ratio.max() <= 1
        assert abs(np.mean(ratio)) < 0.15
    assert set(found[0]) == {"T1.bend", "T2.bend"}


def test_a_recording_says_nothing_of_what_is_in_it(drawn):
    ensemble = drawn()
    found = ensemble.record({"T1.bend": 7.0}, (KV,), np.random.default_rng(1), "case_001")
    assert (found.name, found.description, found.source, found.truth) == ("case_001", "", "", {})
    [made] = drawn.made
    assert made["system"] is ensemble.problem.system
    assert (made["truth"], made["injected"]) == ({"T1.bend": 7.0}, (KV,))
    assert (made["posture"], made["camera"]) == (ensemble.posture, None)
    motion = made["motion"]
    assert (motion["of"], motion["truth"]) == (ensemble.problem.system, {"T1.bend": 7.0})
    assert (motion["posture"], motion["excitation"]) == (ensemble.posture, Excitation(travel=0.15))
    rng = np.random.default_rng(1)
    assert [motion["seed"], made["seed"]] == [int(rng.integers(2**31)) for _ in range(2)]


def test_a_camera_looks_on_where_one_did(drawn):
    drawn(pose=np.eye(4)).record({}, (), np.random.default_rng(1), "case")
    assert drawn.made[0]["camera"] == PointCamera()


def test_a_finer_chain_moves_as_the_nominal_one_and_has_its_own_values(drawn, monkeypatch):
    asked = []
    monkeypatch.setattr(module, "finer_values", lambda nominal, finer, truth: {"finer": (nominal, finer, dict(truth))})
    ensemble = drawn(finer=lambda times: asked.append(times) or "fine")
    ensemble.record({"T1.bend": 7.0}, (), np.random.default_rng(1), "case", links=2)
    nominal = ensemble.problem.system
    assert asked == [2]
    assert drawn.made[0]["system"] == "fine"
    assert drawn.made[0]["truth"] == {"finer": (nominal, "fine", {"T1.bend": 7.0})}
    assert drawn.made[0]["motion"]["of"] is nominal


def test_every_share_of_an_ensemble_is_drawn(drawn):
    ensemble = drawn(finer=lambda times: "fine")
    categories = [ensemble._category(i, 100) for i in range(100)]
    counts = {name: categories.count(name) for name in set(categories)}
    assert counts == {"null": 20, "single": 50, "outside": 15, "left_out": 5, "pair": 5, "finer_chain": 5}
    without = [drawn()._category(i, 100) for i in range(100)]
    assert without.count("single") == 55
    assert [a for a, b in zip(categories, without, strict=True) if a != b] == ["finer_chain"] * 5
    assert categories != [drawn(seed=4, finer=lambda times: "fine")._category(i, 100) for i in range(100)]
    assert categories != sorted(categories)


def of_category(ensemble, monkeypatch, category):
    monkeypatch.setattr(ensemble, "_category", lambda number, count: category)
    return ensemble.draw(7, 100)


@pytest.mark.parametrize("category", ["null", "finer_chain"])
def test_clean_cases_have_nothing_injected(drawn, monkeypatch, category):
    ensemble = drawn(finer=lambda times: SimpleNamespace(fine=times))
    monkeypatch.setattr(module, "finer_values", lambda *_: {})
    case, told = of_category(ensemble, monkeypatch, category)
    assert (told.injected, told.multiple, told.category) == ((), None, category)
    assert (case.name, told.case) == ("case_007", "case_007")
    assert (case.estimate.name, case.held_out.name) == ("case_007_estimate", "case_007_held_out")
    assert len(drawn.made) == 2
    assert drawn.made[0]["injected"] == drawn.made[1]["injected"] == ()
    assert drawn.made[0]["seed"] != drawn.made[1]["seed"]
    assert drawn.made[0]["motion"]["seed"] != drawn.made[1]["motion"]["seed"]
    fine = category == "finer_chain"
    assert (drawn.made[0]["system"] is not ensemble.problem.system) is fine
    assert len(case.without) == 1


def test_a_single_effect_is_in_both_recordings_and_some_other_kind_is_left_out(drawn, monkeypatch):
    case, told = of_category(drawn(), monkeypatch, "single")
    [injected] = told.injected
    assert [made["injected"] for made in drawn.made] == [(injected,)] * 2
    assert [made["truth"] for made in drawn.made] == [told.truth] * 2
    assert case.without[0] not in (injected.kind, "")
    assert told.multiple is not None


def test_a_left_out_effect_is_the_one_at_work(drawn, monkeypatch):
    case, told = of_category(drawn(), monkeypatch, "left_out")
    assert case.without == (told.injected[0].kind,)


def test_with_one_other_kind_none_is_left_out(drawn, monkeypatch):
    ensemble = drawn(candidates=(DAMPER, FRICTION))
    assert of_category(ensemble, monkeypatch, "single")[0].without == ()
    assert of_category(ensemble, monkeypatch, "null")[0].without[0] in ("kelvin_voigt", "joint_coulomb")


def test_a_pair_is_two_effects_of_the_largest_size(drawn, monkeypatch):
    for seed in range(6):
        ensemble = drawn(seed=seed)
        _, told = of_category(ensemble, monkeypatch, "pair")
        labels = [e.label for e in told.injected]
        assert len(set(labels)) == len(labels) <= 2
    same, size = drawn(candidates=(DAMPER,))._injected("pair", np.random.default_rng(1))
    assert (len(same), size) == (1, pytest.approx(0.2 * 100 / 3.858))


def test_outside_effects_are_in_no_library(drawn, monkeypatch):
    _, told = of_category(drawn(), monkeypatch, "outside")
    assert told.injected[0].kind in OUTSIDE
    assert told.multiple is None


def test_a_motion_that_cannot_be_simulated_is_drawn_anew(drawn, monkeypatch):
    case, told = of_category(drawn(failures=0), monkeypatch, "null")
    drawn.made.clear()
    again, other = of_category(drawn(failures=3), monkeypatch, "null")
    assert other.truth != told.truth
    assert case.name == again.name
    drawn.made.clear()
    of_category(drawn(failures=7), monkeypatch, "null")
    drawn.made.clear()
    with pytest.raises(ModelError, match="no motion of this experiment"):
        of_category(drawn(failures=8), monkeypatch, "null")


def test_a_case_is_the_same_whatever_was_drawn_before(drawn):
    ensemble = drawn()
    first = [ensemble.draw(i, 20)[1] for i in range(4)]
    assert drawn().draw(3, 20)[1] == first[3]
    assert len({json.dumps(entry.truth) for entry in first}) == 4
    assert drawn(seed=9).draw(3, 20)[1].truth != first[3].truth


# -- sizes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("of", "column", "wanted", "largest"),
    [(DAMPER, 100.0, 3.0, 0.2), (DAMPER, 100.0, 10.0, 0.2), (FRICTION, 0.5, 1.0, 3.0), (TILT, 50.0, 3.0, 0.5)],
    ids=["within the range", "beyond the range", "hardly detectable", "two amplitudes"],
)
def test_an_effect_is_so_many_times_its_detectable_size_or_as_large_as_expected(drawn, of, column, wanted, largest):
    ensemble = drawn()
    columns = [[column]] if len(of.amplitudes) == 1 else [[0.6 * column, 0.8 * column]]
    for seed in range(5):
        found, multiple = ensemble._sized(signature(of, columns), np.random.default_rng(seed), wanted)
        values = np.array(list(found.values.values()))
        assert found.label == of.label
        seen = abs(float(np.array(columns[0]) @ values))
        assert multiple == pytest.approx(seen / 3.858)
        assert multiple <= wanted * (1 + 1e-12)
        assert np.all(np.abs(values) <= largest * (1 + 1e-12))
        if multiple < wanted * (1 - 1e-9):
            assert np.max(np.abs(values)) == pytest.approx(largest)


def test_sizes_count_from_the_neutral_value_in_the_range_and_keep_the_shape(drawn):
    found, multiple = drawn()._sized(signature(SOLID, [[50.0]], s=0.25), np.random.default_rng(2), 3.0)
    assert found.values == {"a": pytest.approx(1 + 3 * 3.858 / 50), "s": 0.25}
    assert multiple == pytest.approx(3.0)
    far, less = drawn()._sized(signature(SOLID, [[1.0]], s=0.25), np.random.default_rng(2), 3.0)
    assert far.values["a"] == pytest.approx(3.0)
    assert less == pytest.approx(2.0 / 3.858)


def test_amplitudes_go_either_way(drawn):
    ensemble = drawn()
    made = [ensemble._sized(signature(TILT, [[30.0, 40.0]]), np.random.default_rng(s), 1.0)[0] for s in range(20)]
    signs = {(found.values["rx"] > 0, found.values["ry"] > 0) for found in made}
    assert len(signs) == 4


def test_an_effect_that_nothing_sees_has_no_size(drawn):
    assert drawn()._sized(signature(DAMPER, [[0.0]]), np.random.default_rng(1), 1.0) is None


def test_what_is_detectable_is_a_threshold(monkeypatch, drawn):
    monkeypatch.setattr(module, "chosen_effects", lambda *_: [DAMPER])
    ensemble = Ensemble(problem(), 1, limits=Thresholds(detection=2.0))
    found, multiple = ensemble._sized(signature(DAMPER, [[100.0]]), np.random.default_rng(1), 3.0)
    assert found.values["tau"] == pytest.approx(0.06)
    assert multiple == pytest.approx(3.0)


def test_the_wanted_size_or_the_nearest_that_any_effect_reaches(drawn):
    found, size = drawn()._inside(np.random.default_rng(1), 3.0)
    assert (found.kind in ("kelvin_voigt", "gravity_tilt", "standard_linear_solid"), size) == (True, 3.0)
    weak, most = drawn(candidates=(FRICTION,))._inside(np.random.default_rng(1), 3.0)
    assert weak.values["tau_c"] == pytest.approx(3.0)
    assert most == pytest.approx(1.5 / 3.858)
    # nine tenths of it count as reached
    near, reached = drawn(candidates=(DAMPER,))._inside(np.random.default_rng(1), 0.2 * 100 / 3.858 / 0.91)
    assert reached == pytest.approx(0.2 * 100 / 3.858 / 0.91)
    short, not_reached = drawn(candidates=(DAMPER,))._inside(np.random.default_rng(1), 0.2 * 100 / 3.858 / 0.89)
    assert not_reached == pytest.approx(0.2 * 100 / 3.858)
    assert near.values == short.values


def test_the_largest_of_several_tries_is_kept(drawn):
    other = effect("rotor_inertia@elbow", amplitude(expected=(0.0, 1.0)))
    ensemble = drawn(candidates=(FRICTION, other))
    found, size = ensemble._inside(np.random.default_rng(1), 30.0)
    assert (found.kind, size) == ("rotor_inertia", pytest.approx(50.0 / 3.858))


def test_only_kinds_that_the_other_engine_can_do_are_injected(drawn):
    ensemble = drawn(candidates=(DAMPER, ABROAD))
    kinds = {ensemble._inside(np.random.default_rng(seed), 1.0)[0].kind for seed in range(12)}
    assert kinds == {"kelvin_voigt"}


def test_kinds_come_before_places(drawn):
    """A kind with many places is drawn no more often than one with few."""
    many = [effect(f"joint_coulomb@j{i}", amplitude(expected=(0.0, 99.0))) for i in range(9)]
    ensemble = drawn(candidates=(DAMPER, *many))
    kinds = [ensemble._inside(np.random.default_rng(seed), 1.0)[0].kind for seed in range(60)]
    assert 18 <= kinds.count("kelvin_voigt") <= 42
    places = {ensemble._inside(np.random.default_rng(seed), 1.0)[0].location for seed in range(60)}
    assert len(places) > 6


def test_single_effects_come_in_three_sizes(drawn):
    ensemble = drawn(candidates=(SOLID, TILT))
    sizes = [ensemble._injected("single", np.random.default_rng(seed))[1] for seed in range(30)]
    assert {1.0, 3.0, 10.0} <= set(sizes)
    assert ensemble._injected("left_out", np.random.default_rng(1))[1] >= 3.0


# -- outside the library ----------------------------------------------------------------------------------------------


def test_effects_outside_the_library_have_the_size_of_what_they_act_on(drawn):
    ensemble = drawn()
    found = [ensemble._outside(np.random.default_rng(seed)) for seed in range(120)]
    by_kind = {kind: [f for f in found if f.kind == kind] for kind in OUTSIDE}
    assert all(len(group) > 10 for group in by_kind.values())
    ripples = by_kind["torque_ripple"]
    assert {f.location for f in ripples} == {"s0"}, "the first half of the joints, rounded down"
    assert all(0.5 <= f.values["size"] <= 2.0 for f in ripples)
    # T1 bends with 20 N m/rad, T2 has no bending spring and counts as one of 10
    stiffness = {"T1": 20.0, "T2": 10.0}
    for kind, (low, high) in {"cross_stiffness": (0.3, 0.6), "quadratic_stiffness": (2.0, 5.0)}.items():
        ratios = [f.values["size"] / stiffness[f.location] for f in by_kind[kind]]
        assert low <= min(ratios) < max(ratios) <= high
        assert {f.location for f in by_kind[kind]} == {"T1", "T2"}
    assert all(0.05 <= f.values["size"] <= 0.15 for f in by_kind["gusts"])


def test_without_an_object_only_torques_ripple(drawn):
    ensemble = drawn(of=system(segments=(), driven=("s0",)))
    found = {ensemble._outside(np.random.default_rng(seed)).label for seed in range(10)}
    assert found == {"torque_ripple@s0"}


# -- finer chains -----------------------------------------------------------------------------------------------------


def chain(links, **values):
    vector = np.array(list(values.values()))
    parameters = SimpleNamespace(names=tuple(name.replace("_", ".", 1) for name in values), vector=lambda: vector)
    named = {name: SimpleNamespace(name=name, links=((),) * count) for name, count in links.items()}
    return SimpleNamespace(segments=tuple(named.values()), parameters=parameters, segment=named.__getitem__)


def test_a_finer_chain_has_springs_and_dampers_as_many_times_as_strong():
    nominal = chain(
        {"T1": 4, "T2": 3},
        T1_bend=10.0,
        T1_twist=0.0,
        T1_damping=0.5,
        T1_twist_damping=0.25,
        T2_bend=6.0,
        T2_damping=1.0,
    )
    finer = chain({"T1": 8, "T2": 3}, T1_bend=20.0, T1_twist=5.0, T2_bend=6.0)
    found = finer_values(nominal, finer, {"T1.bend": 12.0, "T1.twist": 3.0, "T2.bend": 7.0, "T2.damping": 2.0})
    assert found == {
        "T1.bend": 24.0,
        "T1.twist": 3.0,
        "T2.bend": 7.0,
        "T1.damping": 1.0,
        "T1.twist_damping": 0.5,
        "T2.damping": 2.0,
    }


# -- answers ----------------------------------------------------------------------------------------------------------


def case(without=("density",)):
    return Case("case_000", "estimate", "held out", without)


def test_an_answer_is_given_from_the_recordings_without_what_was_left_out(monkeypatch):
    asked = {}
    heavy = effect("density@T1")
    monkeypatch.setattr(answers, "chosen_effects", lambda of, recordings, choice: [DAMPER, heavy, FRICTION])

    def diagnose(problem, choice, held_out, **more):
        asked.update(problem=problem, choice=choice, held_out=held_out, **more)
        return "finding"

    monkeypatch.setattr(answers, "diagnose", diagnose)
    ensemble = SimpleNamespace(of=lambda recording: SimpleNamespace(system="system", recording=recording))
    assert answers.answer(ensemble, case(), "all", "thresholds", "progress") == "finding"
    assert asked["problem"].recording == "estimate"
    assert asked["choice"] == ["kelvin_voigt@T1", "joint_coulomb@elbow"]
    assert (asked["held_out"], asked["thresholds"], asked["progress"]) == (["held out"], "thresholds", "progress")


@pytest.mark.parametrize(
    ("injected", "refitted", "expected"),
    [
        ((KV,), True, 0.75),
        ((KV,), False, math.nan),
        ((KV, GUST), True, math.nan),
        ((), True, 0.75),
    ],
    ids=["the true effect", "cannot be fitted", "one is in no library", "none"],
)
def test_the_best_that_could_be_closed_is_that_of_the_true_effects(monkeypatch, injected, refitted, expected):
    asked = []
    stiff = effect("kelvin_voigt@T1", amplitude("tau", unit="s"), amplitude("other"))
    made = SimpleNamespace(of=lambda problem, effects, held_out: ("composed", effects, held_out))
    monkeypatch.setattr(answers, "chosen_effects", lambda *_: [stiff, FRICTION])
    monkeypatch.setattr(answers, "CandidateProblem", made)
    monkeypatch.setattr(answers, "nominal_fit", lambda *_: fit(lost=loss(2.0, 2.0), values={"k": 3.0}))

    def refit(composed, chosen, start):
        asked.append((composed[0], [e.kind for e in chosen], dict(start)))
        return fit(chosen, loss(1.25, 1.25)) if refitted else None

    monkeypatch.setattr(answers, "refit", refit)
    ensemble = SimpleNamespace(of=lambda recording: SimpleNamespace(system="system"))
    found = answers.best_closure(ensemble, case(), Label("c", "single", injected, 1.0, {}))
    assert found == pytest.approx(expected, nan_ok=True)
    at_truth = {"kelvin_voigt@T1.tau": 0.05} if injected else {}
    assert asked == [("composed", ["kelvin_voigt"] if injected else [], {"k": 3.0} | at_truth)]


def test_reported_values_are_turned_back_into_parameters():
    quantities = [
        SimpleNamespace(name="compliance", reported=("stiffness", "N/m"), reciprocal="stiffness N/m"),
        SimpleNamespace(name="tau", reported=("tau", "s"), reciprocal=""),
        SimpleNamespace(name="other", reported=("other", "s"), reciprocal=""),
    ]
    found = answers._internal("a@b", {"stiffness": 4.0, "tau": 0.5}, quantities)
    assert found == {"a@b.compliance": 0.25, "a@b.tau": 0.5}
