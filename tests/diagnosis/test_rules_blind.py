"""The blind proof, rule by rule: what is drawn, and how large."""

import itertools
import json
from collections import Counter
from dataclasses import asdict, replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from baxter import baxter_foam_y_system
from factories import amplitude, cases, effect, shape, signature

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.diagnosis import blind as module
from yid_ocp.diagnosis.blind import BlindCaseGenerator, PlannedBlindCase, SyntheticRecordingConditions, plan_blind_cases
from yid_ocp.diagnosis.hypotheses import AllCandidatesProblem
from yid_ocp.errors import ConfigError, ModelError
from yid_ocp.problem import ProblemOptions
from yid_ocp.virtual.injected import OUT_OF_LIBRARY_FORCE_BUILDERS, InjectedEffect
from yid_ocp.virtual.joint_motion import MultisineOptions, grasping_joint_angles, random_multisine_motion

KV = InjectedEffect("kelvin_voigt", "T1", {"tau": 0.05})


DAMPER = effect("kelvin_voigt@T1", amplitude("tau", expected=(0.0, 0.2), unit="s"))
FRICTION = effect("joint_coulomb@elbow", amplitude("tau_c", expected=(0.0, 3.0)))
TILT = effect("gravity_tilt@world", *(amplitude(n, lower=-1.0, expected=(-0.5, 0.5)) for n in ("rx", "ry")))
SOLID = effect("standard_linear_solid@T2", amplitude(neutral=1.0, expected=(1.0, 3.0)), shape())
ABROAD = effect("clock_scale@clock", amplitude())
LIBRARY = (DAMPER, FRICTION, TILT, SOLID)


def system(driven=("s0", "s1", "w0"), prescribed=()):
    springs = (("T1", "bend"), ("T2", "twist"))
    return SimpleNamespace(
        driven=driven,
        prescribed=prescribed,
        segment_layouts=tuple(SimpleNamespace(name=name, link_joints=(("a",),)) for name in ("T1", "T2")),
        parameters=SimpleNamespace(names=("T1.bend", "T2.bend", "T1.damping")),
        elastic_joints=tuple(SimpleNamespace(segment_name=name, deformation=way) for name, way in springs),
        grasps=(),
        effects=(),
        mechanism=SimpleNamespace(joint=lambda name: SimpleNamespace(effort_limit=20.0)),
    )


def problem(of=None):
    t = np.array([0.0, 0.1])
    joints = JointGroup(("w0", "s0", "s1", "more"), t, np.array([[0.3, 0.1, 0.2, 9.0], [1.0, 1.0, 1.0, 1.0]]))
    recording = Recording(joints, (PointGroup("points", ("tip",), t, np.zeros((2, 1, 3))),), name="first")
    return SimpleNamespace(
        system=of or system(),
        free=("T1.bend", "T2.bend"),
        theta=np.array([20.0, 5.0, 0.05]),
        episodes=(SimpleNamespace(recording=recording, known_parameters={"T1.damping": 0.07}),),
        step="step",
        options=ProblemOptions(),
    )


@pytest.fixture
def drawn(monkeypatch):
    """drawn(...): an ensemble whose recordings are made up; `made` remembers what was simulated."""
    made: list[dict] = []

    def experiment(of, truth, injected, settings, friction):
        made.append(vars(settings) | {"system": of, "truth": dict(truth), "injected": tuple(injected)})
        made[-1]["friction"] = friction
        if len(made) <= build.failures:
            raise ModelError("it flies away", hint="")
        return Recording(points=(PointGroup("p", ("tip",), np.array([0.0]), np.zeros((1, 1, 3))),), description="told")

    def multisine(of, truth, **settings):
        return {"of": of, "truth": dict(truth), **settings}

    def build(
        seed=3,
        candidates=(DAMPER, FRICTION, TILT, SOLID),
        finer=None,
        failures=0,
        conditions=None,
        columns=None,
        **given,
    ):
        build.failures = failures
        monkeypatch.setattr(module, "make_candidate_effects", lambda *_: list(candidates))
        ensemble = BlindCaseGenerator(problem(**given), seed, finer, conditions=conditions)
        columns = columns or {"kelvin_voigt": [[100.0]], "joint_coulomb": [[0.5]], "gravity_tilt": [[30.0, 40.0]]}
        shapes = [dict.fromkeys(of.shape_parameter_names, 0.25) for of in candidates]
        factors = [np.array(columns.get(of.kind, [[50.0]])) for of in candidates]
        known = list(zip(candidates, shapes, factors, strict=True))
        monkeypatch.setattr(ensemble, "_detectable_candidates", lambda *recordings: known)
        return ensemble

    monkeypatch.setattr(module, "run_experiment_with_injected_effects", experiment)
    monkeypatch.setattr(module, "random_multisine_motion", multisine)
    build.made = made
    return build


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"of": system(driven=())}, "driven joints alone"),
        ({"of": system(prescribed=("clamp",))}, "driven joints alone"),
        ({"candidates": (ABROAD,)}, "any of the candidates"),
        ({"candidates": ()}, "any of the candidates"),
    ],
)
def test_what_cannot_be_simulated_is_refused(drawn, given, words):
    with pytest.raises(ConfigError, match=words):
        drawn(**given)
    drawn(seed=0)


def test_what_is_detectable_counts_the_noise_of_torques(drawn, monkeypatch):
    ensemble, truth = drawn(), {"k": 1.0}
    whitened = AllCandidatesProblem("by all noise", (DAMPER,), False)
    composed = SimpleNamespace(with_whitening_linearized_at=lambda at: whitened if at is truth else None)

    def linearized(of, base, values):
        return None, [signature(DAMPER, [[2.0]])] if (of, values) == (whitened, truth) else []

    monkeypatch.setattr(module, "EstimationProblem", lambda *_: problem())
    monkeypatch.setattr(module, "AllCandidatesProblem", SimpleNamespace(from_problem=lambda *_: composed))
    monkeypatch.setattr(module, "linearize_candidates", linearized)
    [(of, _, factor)] = BlindCaseGenerator(ensemble.problem, 3, None)._detectable_candidates(truth, [], None)
    assert (of, np.abs(factor)) == (DAMPER, 2.0)


def test_a_recording_says_nothing_of_what_is_in_it(drawn):
    found = drawn().simulate_synthetic_recording({"T1.bend": 7.0}, (KV,), np.random.default_rng(1), "case_001")
    assert (found.name, found.description, found.source, found.true_parameters) == ("case_001", "", "", {})
    [made] = drawn.made
    assert (made["truth"], made["injected"]) == ({"T1.bend": 7.0}, (KV,))
    assert made["motion"]["excitation"] == MultisineOptions(gripper_travel=0.15)


def of_category(ensemble, category, multiple=None):
    return ensemble.draw_recordings_and_ground_truth(PlannedBlindCase(7, "one", category, multiple))


@pytest.mark.parametrize("category", ["null", "finer_chain"])
def test_clean_cases_have_nothing_injected(drawn, monkeypatch, category):
    ensemble = drawn(finer=lambda times: SimpleNamespace(fine=times))
    monkeypatch.setattr(module, "scale_parameters_to_more_links", lambda *_: {})
    case, told = of_category(ensemble, category)
    assert (told.injected, told.multiple, told.category, told.case) == ((), None, category, "case_007")
    names = [recording.name for recording in (*case.estimation_recordings, case.held_out_recording)]
    assert names == ["case_007_estimate_0", "case_007_held_out"]
    one, other = drawn.made
    assert one["injected"] == other["injected"] == ()
    assert one["seed"] != other["seed"]
    assert one["motion"]["seed"] != other["motion"]["seed"]
    assert (one["system"] is not ensemble.problem.system) is (category == "finer_chain")
    assert len(case.excluded_kinds) == 1


def test_a_single_effect_is_in_both_recordings_and_some_other_kind_is_left_out(drawn):
    case, told = of_category(drawn(), "single")
    [injected] = told.injected
    assert [made["injected"] for made in drawn.made] == [(), (), (injected,), (injected,)]
    assert [made["truth"] for made in drawn.made] == [told.truth | {"T1.damping": 0.07}] * 4  # as recordings state
    assert case.excluded_kinds[0] not in (injected.kind, "")
    assert told.multiple is not None


def test_a_pair_is_two_effects_of_the_largest_size(drawn):
    for seed in range(6):
        labels = [e.label for e in of_category(drawn(seed=seed), "pair")[1].injected]
        assert len(set(labels)) == len(labels) <= 2
    told = of_category(drawn(candidates=(DAMPER,)), "pair")[1]
    assert (len(told.injected), told.multiple) == (1, pytest.approx(0.2 * 100 / 3.858))


def test_a_motion_that_cannot_be_simulated_is_drawn_anew(drawn):
    told = of_category(drawn(failures=0), "null")[1]
    drawn.made.clear()
    assert of_category(drawn(failures=3), "null")[1].truth != told.truth
    drawn.made.clear()
    of_category(drawn(failures=module.MAX_DRAWS_PER_CASE - 1), "null")
    drawn.made.clear()
    with pytest.raises(ModelError, match=r"none of 64 random motions(.|\n)*case_\d+ of experiment one(.|\n)*--seed"):
        of_category(drawn(failures=module.MAX_DRAWS_PER_CASE), "null")


def test_a_case_is_the_same_whatever_was_drawn_before(drawn):
    ensemble = drawn()
    wanted = [PlannedBlindCase(i, "one", "single", 3.0) for i in range(4)]
    first = [ensemble.draw_recordings_and_ground_truth(entry)[1] for entry in wanted]
    made = list(drawn.made)
    assert drawn().draw_recordings_and_ground_truth(wanted[3])[1] == first[3]
    assert module.CaseGroundTruth.from_dict(json.loads(json.dumps(asdict(first[3])))) == first[3]
    assert first[3].experiment == "one"
    assert len({json.dumps(entry.truth) for entry in first}) == 4
    # the effect is detectable in the motion and noise of the case; no two other recordings share them
    seeds = [[own["motion"]["seed"], own["seed"]] for own in made]
    assert (seeds[::4], seeds[1::4]) == (seeds[2::4], seeds[3::4])
    assert len({seed for own in seeds for seed in own}) == 16
    assert np.max(seeds) > 2**24
    assert drawn(seed=9).draw_recordings_and_ground_truth(wanted[3])[1].truth != first[3].truth
    # an ensemble to calibrate by shares no case with the one that is reported
    calibrating = drawn(conditions=SyntheticRecordingConditions(purpose="calibration"))
    assert calibrating.draw_recordings_and_ground_truth(wanted[3])[1].truth != first[3].truth


WEIGHTS = {"a": 0.4, "b": 0.2, "bare": 0.1}
WHOLE = frozenset({"a", "b"})


def counted(plan, key):
    return dict(Counter(map(key, plan)))


def test_every_sort_and_size_is_planned_and_spread_over_the_experiments():
    plan = plan_blind_cases(300, 3, WEIGHTS, WHOLE)
    assert [entry.number for entry in plan] == list(range(300))
    assert counted(plan, lambda e: e.category) == {
        "null": 60, "single": 144, "pair": 30, "outside": 30, "left_out": 18, "finer_chain": 18
    }  # fmt: skip
    singles = [entry for entry in plan if entry.category == "single"]
    assert counted(singles, lambda e: e.multiple) == {1.0: 48, 3.0: 48, 10.0: 48}
    by_experiment = counted(plan, lambda e: e.experiment)
    assert all(abs(by_experiment[name] - 300 * part / 0.7) <= 1 for name, part in WEIGHTS.items())
    for of in (lambda e: e.category == "null", lambda e: e.multiple == 3.0, lambda e: e.category == "outside"):
        own = counted([entry for entry in plan if of(entry)], lambda e: e.experiment)
        total = sum(own.values())
        assert all(abs(own[name] / total - part / 0.7) < 0.1 for name, part in WEIGHTS.items())
    assert {entry.experiment for entry in plan if entry.category == "finer_chain"} == WHOLE
    assert [entry.category for entry in plan] != sorted(entry.category for entry in plan)
    assert plan == plan_blind_cases(300, 3, WEIGHTS, WHOLE)
    assert plan != plan_blind_cases(300, 4, WEIGHTS, WHOLE)
    assert plan != plan_blind_cases(300, 3, WEIGHTS, WHOLE, "calibration")


def test_one_clean_case_in_three_is_brisk():
    plan = plan_blind_cases(300, 3, WEIGHTS, WHOLE)
    assert counted([e for e in plan if e.is_brisk], lambda e: e.category) == {"null": 20}
    assert len({e.experiment for e in plan if e.is_brisk}) == len(WEIGHTS)
    assert [e.is_brisk for e in plan] == [e.is_brisk for e in plan_blind_cases(300, 3, WEIGHTS, WHOLE)]


def test_a_brisk_motion_has_three_times_the_acceleration(drawn):
    ensemble, ratios, arm = drawn(), [], baxter_foam_y_system(1)
    for brisk in (False, True):
        ensemble.draw_recordings_and_ground_truth(PlannedBlindCase(7, "one", "null", None, brisk))
    start = grasping_joint_angles(arm)
    for seed in range(2):
        sizes = []
        for made in (drawn.made[0], drawn.made[-1]):
            how = {"initial_joint_angles": start, "excitation": made["motion"]["excitation"]}
            motion = random_multisine_motion(arm, seed=seed, **how)
            sizes.append(np.std([motion.offset_and_derivatives(t)[2] for t in np.linspace(1.0, 5.0, 200)]))
        ratios.append(sizes[1] / sizes[0])
    assert 2.6 < np.mean(ratios) < 3.4


def test_truth_has_ordinary_friction_and_parameters_as_uncertain_as_their_priors(drawn):
    ensemble = drawn(conditions=SyntheticRecordingConditions(ordinary_friction=()))
    known = ensemble.problem
    known.system.effects = (FRICTION,)
    known.system.parameters.names += ("joint_coulomb@elbow.tau_c",)
    known.theta = np.append(known.theta, 0.0)
    ensemble.simulated_system = system()
    known.options = ProblemOptions(prior_stds={"T2.bend": 0.05})
    for number in range(8):
        case = PlannedBlindCase(number, "one", "null", None)
        truth = ensemble.draw_recordings_and_ground_truth(case)[1].truth
        assert 0.03 <= abs(truth["T2.bend"] - 5.0) <= 0.05
        [held] = drawn.made[-1]["friction"]
        assert held == InjectedEffect("joint_coulomb", "elbow", {"tau_c": truth["joint_coulomb@elbow.tau_c"]})
        assert 0.08 <= held.values["tau_c"] <= 0.32


def test_parameters_with_priors_are_drawn_in_their_order_so_that_a_seed_draws_the_same_everywhere(drawn, monkeypatch):
    ensemble, names = drawn(), tuple(f"joint_{i}.mass_scale" for i in range(12))
    known = ensemble.problem
    known.free, known.theta, known.system.parameters.names = names, np.ones(12), names
    known.options, draws = ProblemOptions(prior_stds=dict.fromkeys(names, 0.05)), itertools.count()
    counted = Mock(uniform=lambda *_: next(draws), choice=lambda _: 1.0, integers=lambda _: 0)
    monkeypatch.setattr(np.random, "default_rng", lambda seed: counted)
    truth = of_category(ensemble, "null")[1].truth
    assert [truth[name] for name in names] == sorted(truth[name] for name in names)


def test_what_a_plan_cannot_divide_goes_to_the_largest_remainders():
    found = counted(plan_blind_cases(7, 1, WEIGHTS, WHOLE), lambda e: e.category)
    assert found == {"null": 1, "single": 3, "pair": 1, "outside": 1, "left_out": 1}


def test_recordings_are_seen_by_a_camera_where_the_real_ones_are(drawn):
    assert not drawn().conditions.has_camera
    real = problem()
    [group] = real.episodes[0].recording.points
    real.episodes[0].recording = replace(real.episodes[0].recording, points=(replace(group, camera_pose=np.eye(4)),))
    assert BlindCaseGenerator(real, 3, None).conditions.has_camera


def test_an_object_without_links_has_single_effects_instead_of_finer_chains():
    found = counted(plan_blind_cases(100, 1, {"bare": 1.0}), lambda e: e.category)
    assert found == {"null": 20, "single": 54, "pair": 10, "outside": 10, "left_out": 6}


@cases(
    "of, column, wanted, largest",
    {
        "within the range": (DAMPER, 100.0, 3.0, 0.2),
        "beyond the range": (DAMPER, 100.0, 10.0, 0.2),
        "hardly detectable": (FRICTION, 0.5, 1.0, 3.0),
        "two amplitudes": (TILT, 50.0, 3.0, 0.5),
    },
)
def test_an_effect_is_so_many_times_its_detectable_size_or_as_large_as_expected(drawn, of, column, wanted, largest):
    columns = [[column]] if len(of.amplitude_parameter_names) == 1 else [[0.6 * column, 0.8 * column]]
    ensemble = drawn(candidates=(of,), columns={of.kind: columns})
    for number in range(5):
        told = ensemble.draw_recordings_and_ground_truth(PlannedBlindCase(number, "one", "single", wanted))[1]
        [found], values = told.injected, np.array(list(told.injected[0].values.values()))
        assert found.label == of.label
        seen = abs(float(np.array(columns[0]) @ values)) / 3.858
        # nine tenths of the wanted size count as reached
        assert told.multiple == pytest.approx(seen, rel=0.1 if told.multiple == wanted else 1e-9)
        assert seen <= wanted * (1 + 1e-12)
        assert np.all(np.abs(values) <= largest * (1 + 1e-12))
        if seen < wanted * (1 - 1e-9):
            assert np.max(np.abs(values)) == pytest.approx(largest)


def test_the_wanted_size_or_the_nearest_that_any_effect_reaches(drawn):
    def single(wanted, **given):
        told = of_category(drawn(**given), "single", wanted)[1]
        return told.injected[0], told.multiple

    found, size = single(3.0)
    assert (found.kind in ("kelvin_voigt", "gravity_tilt", "standard_linear_solid"), size) == (True, 3.0)
    weak, most = single(3.0, candidates=(FRICTION,))
    assert weak.values["tau_c"] == pytest.approx(3.0)
    assert most == pytest.approx(1.5 / 3.858)
    near, reached = single(0.2 * 100 / 3.858 / 0.91, candidates=(DAMPER,))
    assert reached == pytest.approx(0.2 * 100 / 3.858 / 0.91)
    for seed in range(4):
        short, not_reached = single(0.2 * 100 / 3.858 / 0.89, seed=seed, candidates=(DAMPER, FRICTION))
        assert not_reached == pytest.approx(0.2 * 100 / 3.858)
        assert near.values == short.values


def test_only_kinds_that_the_other_engine_can_do_are_injected(drawn):
    for seed in range(12):
        [injected] = of_category(drawn(seed, candidates=(DAMPER, ABROAD)), "single", 1.0)[1].injected
        assert injected.kind == "kelvin_voigt"


def test_effects_outside_the_library_have_the_size_of_what_they_act_on(drawn):
    ensemble = drawn()
    ensemble.simulated_system.grasps = (SimpleNamespace(name="left"),)
    wanted = [PlannedBlindCase(number, "one", "outside", None) for number in range(600)]
    found = [f for entry in wanted for f in ensemble.draw_recordings_and_ground_truth(entry)[1].injected]
    by_kind = {kind: [f for f in found if f.kind == kind] for kind in OUT_OF_LIBRARY_FORCE_BUILDERS}
    assert all(len(group) > 10 for group in by_kind.values())
    assert all(
        0 < min(sizes) < max(sizes) for group in by_kind.values() for sizes in [[f.values["size"] for f in group]]
    )
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


def chain(links, **values):
    parameters = SimpleNamespace(names=tuple(values), vector=lambda: np.array(list(values.values())))
    named = {name: SimpleNamespace(name=name, link_joints=((),) * count) for name, count in links.items()}
    layouts = {"segment_layouts": tuple(named.values()), "find_segment_layout": named.__getitem__}
    return SimpleNamespace(parameters=parameters, **layouts)


def test_a_finer_chain_has_springs_and_dampers_as_many_times_as_strong():
    first = {"T1.bend": 10.0, "T1.twist": 0.0, "T1.damping": 0.5, "T1.twist_damping": 0.25}
    nominal = chain({"T1": 4, "T2": 3}, **first, **{"T2.bend": 6.0, "T2.damping": 1.0})
    finer = chain({"T1": 8, "T2": 3}, **{"T1.bend": 20.0, "T1.twist": 5.0, "T2.bend": 6.0})
    truth = {"T1.bend": 12.0, "T1.twist": 3.0, "T2.bend": 7.0, "T2.damping": 2.0}
    scaled = {"T1.bend": 24.0, "T1.damping": 1.0, "T1.twist_damping": 0.5}
    assert module.scale_parameters_to_more_links(nominal, finer, truth) == truth | scaled
