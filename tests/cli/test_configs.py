"""Every file in configs/ runs, on a shortened horizon and with coarse objects so that this stays quick."""

import pytest

from yid_ocp.config.reader import load_config
from yid_ocp.data import read_recording
from yid_ocp.workflow.run_inputs import resolve_recording_path

PAPER = ("single_arm_no_vision", "single_arm_vision", "dual_arm_no_vision", "dual_arm_vision")
# settings that make each run quick: fewer links and a short horizon
COARSE = (
    "model.object.links=1",
    # so short that the first fit is good: no other start is tried
    "problem.duration=0.1",
    "solver.max_iterations=2",
    # one stiffness: the others are hardly seen in so short a time, and their profile likelihoods take many refits
    "parameters={}",
    # near the truth for one joint a tube, where the data have four springs in series
    "parameters={T*.bend: {initial: 2.8}, T1.bend: {free: true, initial: 5.5}, T*.twist: {initial: 2.5}}",
)
# one of the paper's experiments is run with half the time step as well
UNREFINED = ("output.checked_discretisation=none",)
FEW = ("solver.max_iterations=2", "problem.use_compiler=false")
DEFT = "../../shared/recordings/deft/bdlo1_train_{}.h5"
QUICK = {
    **dict.fromkeys(PAPER, (*COARSE, *FEW, *UNREFINED)),
    "single_arm_vision": COARSE,
    "baxter_arm": ("problem.duration=1.6", *UNREFINED),
    "double_pendulum": ("problem.duration=3.0",),
    "servo_arm": ("problem.duration=0.2", "model.object.named_segments.rod.links=1", *FEW, *UNREFINED),
    "servo_pendulum": ("problem.duration=0.5", FEW[0], *UNREFINED),
    "so101_servo": UNREFINED,
    "panda_beam": ("problem.duration=0.8", "model.object.named_segments.beam.links=1", FEW[0], *UNREFINED),
    **dict.fromkeys(("springs_series_ends", "springs_series_joint", "springs_torsion"), ()),
    "soft_beam": (
        *("problem.duration=0.3", "model.object.named_segments.beam.links=2", *FEW, "model.effects=[]"),
        "parameters={}",
        "parameters={beam.bend: {free: true, initial: 0.018}, beam.damping: {free: true, initial: 4.0e-5}}",
        *UNREFINED,
    ),
    "deft_bdlo1": (
        *("problem.duration=0.1", *FEW, "problem.initial_state_fit_parameters=[]", *UNREFINED),
        f"recordings.estimate=[{DEFT.format('007')}]",
        f"recordings.held_out=[{DEFT.format('014')}]",
    ),
}


def configurations(repository):
    files = (repository / "configs").glob("*.yaml")
    # tests/vision and tests/planning run the others
    return {path.stem: path for path in files if not path.stem.startswith(("track_", "plan_"))}


def recorded(repository, name):
    """The file of a configuration whose recordings are here."""
    file = configurations(repository)[name]
    recordings = load_config(file).recordings
    for path in (*recordings.estimate, *recordings.held_out):
        if not resolve_recording_path(path).is_file():
            pytest.skip(f"its recordings are not here: {path}")
    return file


def test_every_configuration_has_its_row(repository):
    assert set(configurations(repository)) == set(QUICK), "a new configuration needs a row in QUICK"


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow) if n in ("deft_bdlo1", "so101_servo") else n for n in sorted(QUICK)],
)
def test_configuration_runs(carried_out, repository, name):
    settings = (*QUICK[name], "output.write_report=false")
    result = carried_out("solve", recorded(repository, name), settings=settings, codes=(0, 1)).result
    assert result["status"] in ("converged", "iteration_limit"), result["message"]
    assert result["residuals"]
    assert all(entry["rmse"] for entry in result["held_out"])
    if name == "deft_bdlo1":
        assert set(result["held_out"][0]["baselines"]) == {"stays", "moves_with_clamps", "linear_carry"}
        assert result["held_out"][0]["rmse"]["points"] < 0.05
    if name == "so101_servo":  # made in MuJoCo, whose friction holds at rest
        truth = read_recording(repository / "configs" / "recordings" / "so101_1.h5").true_parameters
        wanted = [key for key in truth if key.startswith(("payload@", "joint_coulomb@", "joint_load_friction@"))]
        free = {key: result["parameters"][key] for key in wanted if result["parameters"].get(key, {}).get("free")}
        assert len(free) == 14
        assert result["fit"]["explains"]
        for key, entry in free.items():
            assert abs(entry["value"] - truth[key]) < 2 * entry["std"], key
    if name in ("baxter_arm", "panda_beam"):
        assert len([channel for channel in result["residuals"] if channel.startswith("joints.effort.")]) == 7


RIGID = "parameters={panda_*.damping: {free: true}, effort_offset@*: {free: true}}"
WITHHELD = [
    (("model.object.gravity_fraction=0",), {"kind": "gravity_scale", "location": "object"}),
    (("model.object=null", "parameters={}", RIGID), {"kind": "point_mass", "location": "gripper"}),
]


@pytest.mark.slow
@pytest.mark.parametrize(("settings", "truth"), WITHHELD, ids=["its weight", "the beam"])
def test_what_is_withheld_from_the_beams_model_is_named(carried_out, repository, settings, truth):
    settings = (*settings, "diagnosis.max_effects=1", "output.write_report=false")
    result = carried_out("diagnose", recorded(repository, "panda_beam"), settings=settings).result
    assert result["verdict"] == "effect"
    assert result["effects"] == [truth]
    assert result["gap"]["closure_ci"][0] > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("exact", [False, True], ids=["as embedded", "exact torques"])
@pytest.mark.parametrize("name", PAPER)
def test_the_papers_experiments_in_full(carried_out, repository, clean, name, exact):
    files = [f"recordings.{purpose}=[{clean / name}_{purpose}.h5]" for purpose in ("estimate", "held_out")]
    result = carried_out("solve", configurations(repository)[name], settings=files if exact else ()).result
    assert result["fit"]["explains"]
    truth = {"T1.bend": 22.0, "T1.twist": 13.6, "T2.bend": 10.7, "T2.twist": 8.2, "T3.bend": 11.5, "T3.twist": 9.7}
    told = {parameter: result["parameters"][parameter] for parameter in truth}
    found = {parameter: entry for parameter, entry in told.items() if entry["verdict"] == "identifiable"}
    assert set(found) >= {"T1.bend", "T2.bend", *(("T1.twist", "T3.bend") if name.startswith("dual") else ())}
    for parameter, entry in found.items():
        slack = 0.05 * truth[parameter] if exact else 0.0
        assert abs(entry["value"] - truth[parameter]) < max(slack, 2 * entry["std"]), parameter
    for parameter, entry in told.items():
        lower, upper = entry["interval"] or (None, None)
        if entry["verdict"] == "weak":
            assert (lower or 0.0) < truth[parameter] < (upper or 1e9), parameter
    assert told["T2.twist"]["verdict"] == told["T3.twist"]["verdict"] == "not_identifiable"
