"""Settings of a run, with one frozen dataclass for each section of a configuration file.

Options of solvers, problem, sensors, cables, tracking and diagnosis are classes in other modules; the sections here
contain them. `yid_ocp.options` describes how an option is declared.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from annotated_types import Ge, Gt, Le, Lt
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedSeq

from yid_ocp.arrays import Vector3
from yid_ocp.data.recording import TimestampKind
from yid_ocp.diagnosis.thresholds import Thresholds
from yid_ocp.effects.friction import FrictionLawName
from yid_ocp.effects.law import TorqueLawQuantitiesName
from yid_ocp.errors import ConfigError
from yid_ocp.integrator.discrete import ConstraintForcePlacement, ForceSplit
from yid_ocp.model.objects import OBJECT_KINDS, ObjectBuilder
from yid_ocp.model.objects.base import MountSettings
from yid_ocp.model.servos_and_springs import ServoModelOptions
from yid_ocp.options import OptionInfo, RegistryChoice, class_options_by_key, split_annotated
from yid_ocp.planning.joint_paths import PlanOptions
from yid_ocp.problem.options import ExcessResidualCriteria, ProblemOptions, SensorOptions
from yid_ocp.solvers import SOLVERS, GaussNewton, MultipleShooting, SingleShooting, SteepestDescent
from yid_ocp.solvers.base import Solver
from yid_ocp.virtual.experiment import VirtualArmImperfections
from yid_ocp.vision.frame_selection import TrackOptions
from yid_ocp.vision.surface_meshes import ExtraMesh

_Names = tuple[str, ...]
_Texts = Mapping[str, str] | None
_Numbers = Mapping[str, float] | None
_Vector4 = tuple[float, float, float, float]
_FilePath = Annotated[str, OptionInfo("a file, relative to the configuration", is_path=True)]
_Recording = Annotated[str, OptionInfo("a recording, relative to the configuration, or default:NAME.h5", is_path=True)]
_Recordings = tuple[_Recording, ...]
_GraspKind = Literal["point", "axis", "weld"]


@dataclass(frozen=True, kw_only=True)
class _FrameSettings(MountSettings):
    """An additional named frame on the robot, the object or in the world, such as a tool tip or a marker."""

    use_recorded_straight_position: Annotated[
        bool,
        OptionInfo(
            "whether recordings give its position, instead of xyz: the point of this name in their dataset `straight` "
            "(see recordings.md); for markers on an object whose root is fixed in the world"
        ),
    ] = False
    position_std: Annotated[
        float,
        Ge(0),
        OptionInfo("standard deviation of its position; above 0, NAME.x, NAME.y and NAME.z are estimated", "m"),
    ] = 0.0


@dataclass(frozen=True, kw_only=True)
class _GraspSettings:
    """A grasp, which connects a frame of the object to a frame of the robot by a constraint."""

    holder_frame: Annotated[str, OptionInfo("frame of the robot")]
    held_frame: Annotated[str, OptionInfo("frame of the object, or a point along a segment such as T1:40%")]
    kind: Annotated[_GraspKind, OptionInfo("point (position), axis (plus z axis) or weld (plus orientation)")] = "point"
    held_frame_rpy: Annotated[Vector3, OptionInfo("orientation in holder_frame", "rad")] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, kw_only=True)
class _JointSpringSettings:
    """A spring and damper on one joint of the robot."""

    stiffness: Annotated[float, Ge(0), OptionInfo("stiffness", "N m/rad or N/m")]
    rest_position: Annotated[float, OptionInfo("coordinate at which the spring has no torque", "rad or m")] = 0.0
    damping: Annotated[float | None, Ge(0), OptionInfo("damping; default: model.damping", "N m s/rad or N s/m")] = None


@dataclass(frozen=True, kw_only=True)
class EffectSettings:
    """An effect (such as friction) added to the nominal model. Its parameters are named kind@location.quantity."""

    kind: Annotated[str, OptionInfo("kind of effect: kelvin_voigt, joint_coulomb, ..., or law")]
    location: Annotated[str, OptionInfo("a segment, point, joint, grasp, arm, base, object, world, camera or clock")]
    values: Annotated[Mapping[str, float], OptionInfo("values; the others are neutral")] = field(default_factory=dict)
    depends_on: Annotated[TorqueLawQuantitiesName | None, OptionInfo("quantities on which a law depends")] = None
    law_csv: Annotated[_FilePath | None, OptionInfo("table of a law, in the format of a diagnosis' law.csv")] = None

    @property
    def label(self) -> str:
        """The label of the effect, `kind@location`."""
        return f"{self.kind}@{self.location}"


@dataclass(frozen=True, kw_only=True)
class _JointActuationSettings:
    """Moving joints of the robot, and how each is driven."""

    joints: Annotated[_Names | None, OptionInfo("moving joints, in order; default: all movable")] = None
    mode: Annotated[
        Literal["driven", "prescribed", "servo", "passive"],
        OptionInfo(
            "driven: measured efforts move the joints; prescribed: they move as measured; servo: position servos "
            "follow recorded commands; passive: no drive"
        ),
    ] = "driven"
    servo: Annotated[ServoModelOptions, OptionInfo("position servos of the mode servo")] = field(
        default_factory=ServoModelOptions
    )
    passive_joints: Annotated[_Names, OptionInfo("moving joints without a drive, in any mode")] = ()
    locked_joints: Annotated[Mapping[str, float], OptionInfo("position of joints that do not move", "rad or m")] = (
        field(default_factory=dict)
    )
    exclude_links: Annotated[
        _Names, OptionInfo("links of the URDF to remove with their subtrees, such as a hand that is not mounted")
    ] = ()
    relative_link_mass_std: Annotated[
        float,
        Ge(0),
        Lt(0.3),
        OptionInfo(
            "relative standard deviation of every link's mass and inertia in the URDF; above 0, "
            "JOINT.mass_scale is estimated as well"
        ),
    ] = 0.0


@dataclass(frozen=True, kw_only=True)
class FrictionLawSettings:
    """The friction law of the robot's joints. The amount of friction is estimated."""

    law: Annotated[
        FrictionLawName,
        OptionInfo(
            "viscous; coulomb: also viscous; stribeck: coulomb, higher at low speed; presliding: Dahl's law, with "
            "stiction; load: coulomb, and grows with the torque through the gear; load_stribeck: load and stribeck"
        ),
    ]
    joints: Annotated[_Names | None, OptionInfo("joints with this friction; default: all that move")] = None
    sign_smoothing_speed: Annotated[
        float | None,
        Gt(0),
        OptionInfo(
            "speed below which the sign of Coulomb and Stribeck friction is smoothed, so that a loaded joint "
            "creeps; default: 0.001 for joints driven by torques, otherwise 0.02",
            "rad/s",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class _ModelSettings:
    """Mechanical model of robot and flexible object: grasps, clamps, frames and effects."""

    robot: Annotated[
        _FilePath | None,
        OptionInfo(
            "URDF or MJCF file, package:NAME of example-robot-data, or default:NAME.urdf of this package; "
            "null for an object held by the world or by clamps"
        ),
    ] = None
    arms: Annotated[_JointActuationSettings, OptionInfo("robot joints and their drive")] = _JointActuationSettings()
    frames: Annotated[
        Mapping[str, _FrameSettings],
        OptionInfo("additional frames on robot, object or world, by name, such as a tool tip or a marker"),
    ] = field(default_factory=dict)
    object: Annotated[
        ObjectBuilder | None, RegistryChoice(OBJECT_KINDS, selector_key="kind"), OptionInfo("the flexible object")
    ] = None
    grasp: Annotated[Mapping[str, _GraspSettings], OptionInfo("grasps by name: left, right, gripper")] = field(
        default_factory=dict
    )
    joint_springs: Annotated[Mapping[str, _JointSpringSettings], OptionInfo("springs by joint of the robot")] = field(
        default_factory=dict
    )
    damping: Annotated[
        Annotated[float, Ge(0)] | Mapping[str, Annotated[float, Ge(0)]],
        OptionInfo(
            "viscous damping: one number for all, or one per robot joint (default 0.05) and one for all of `object`",
            "N m s/rad",
        ),
    ] = 0.05
    friction: Annotated[
        FrictionLawSettings | None, OptionInfo("friction law of the joints; amplitudes and damping become free")
    ] = None
    gravity: Annotated[Vector3, OptionInfo("gravity in the world frame", "m/s^2")] = (0.0, 0.0, -9.81)
    measured_points: Annotated[_Names | None, OptionInfo("measured frames; T1:40%: at 40 % of T1; else tips")] = None
    surfaces_missing_from_urdf: Annotated[
        tuple[ExtraMesh, ...],
        OptionInfo("bodies that a camera sees and the URDF lacks, such as a table; `track` removes their points"),
    ] = ()
    effects: Annotated[tuple[EffectSettings, ...], OptionInfo("effects added to the nominal model, in this order")] = ()


@dataclass(frozen=True, kw_only=True)
class RecordingsSettings:
    """The recordings for estimation, for held-out prediction and for reference."""

    estimate: Annotated[_Recordings, OptionInfo("recordings for the estimation")] = ()
    held_out: Annotated[_Recordings, OptionInfo("recordings that are predicted only")] = ()
    without_effect: Annotated[
        _Recordings,
        OptionInfo("recordings made without the diagnosed effect, predicted as a test; default: those of the baseline"),
    ] = ()
    stop_on_any_issue: Annotated[
        bool, OptionInfo("whether any issue of a recording stops the run (--strict on the command line)")
    ] = False


@dataclass(frozen=True, kw_only=True)
class ImportSettings:
    """Settings of `import`, which converts files of other tools. A command-line flag overrides its key here."""

    joint_topics: Annotated[_Names | None, OptionInfo("bag: topics of joint states to merge; default: all")] = None
    command_topic: Annotated[
        str | None, OptionInfo("bag: topic of joint states whose positions are commands, not measurements")
    ] = None
    message_fields: Annotated[_Texts, OptionInfo("bag: /TOPIC.FIELD of an array in a message, by joint channel")] = None
    joints: Annotated[_Names | None, OptionInfo("joints to keep, NAME or RECORDED=NAME, in order; default: all")] = None
    point_names: Annotated[
        _Texts, OptionInfo("point, such as cable:40%, by its source: topic, TOPIC:FRAME of /tf, marker or column stem")
    ] = None
    pose_axis_point_distance: Annotated[
        float | None,
        Gt(0),
        Le(10),
        OptionInfo("distance of the points NAME_x, NAME_y, NAME_z along the axes of a pose", "m"),
    ] = None
    column_meanings: Annotated[
        _Texts, OptionInfo("table: t, CHANNEL:JOINT, AXIS:POINT or skip, by column or pattern such as *_pos")
    ] = None
    has_header: Annotated[bool | None, OptionInfo("table: whether the first row has names (else 1, 2, ...)")] = None
    skip_bad_lines: Annotated[bool | None, OptionInfo("table: whether lines that are not numbers are skipped")] = None
    delimiter: Annotated[str | None, OptionInfo("table: character between cells; default: from the first line")] = None
    units: Annotated[
        _Texts,
        OptionInfo(
            "units that are not SI, by quantity: t (s, ms, us, ns), position (rad, deg, rev), velocity "
            "(rad/s, deg/s, rpm), effort (N m, N mm, A, mA), points (m, cm, mm) and so on"
        ),
    ] = None
    torque_constants: Annotated[
        _Numbers, OptionInfo("torque per current by joint or pattern, if efforts are motor currents", "N m/A")
    ] = None
    gear_ratios: Annotated[_Numbers, OptionInfo("motor turns per joint turn, if efforts are currents; default: 1")] = (
        None
    )
    file_clock_offsets: Annotated[_Numbers, OptionInfo("several files: added to each one's times, by stem", "s")] = None
    episode: Annotated[int | None, Ge(0), OptionInfo("LeRobot dataset: episode; default: the first")] = None
    timestamp_kind: Annotated[TimestampKind | None, OptionInfo("table: are its times measured or nominal?")] = None
    point_sensor_name: Annotated[str | None, OptionInfo("name of the sensor that measured the points")] = None
    point_frame: Annotated[str | None, OptionInfo("table or C3D file: frame of the points")] = None


@dataclass(frozen=True, kw_only=True)
class ParameterSettings:
    """The initial value, bounds and prior of one parameter, or of all that match a pattern such as T*.bend."""

    initial: Annotated[float | None, OptionInfo("value; initial value if free", "the parameter's unit")] = None
    bounds: Annotated[tuple[float, float] | None, OptionInfo("lower and upper bound", "the parameter's unit")] = None
    free: Annotated[bool | None, OptionInfo("whether it is estimated")] = None
    prior_std: Annotated[
        float | None, Gt(0), OptionInfo("standard deviation of a Gaussian prior", "the parameter's unit")
    ] = None
    per_recording: Annotated[bool | None, OptionInfo("whether it has a separate value in every recording")] = None


@dataclass(frozen=True, kw_only=True)
class _ProblemSettings(ProblemOptions):
    """Settings of the estimation problem: residuals, initial state and time discretisation."""

    time_step: Annotated[
        Annotated[float, Gt(0), Le(0.1)] | Literal["auto"],
        OptionInfo("time step; auto halves 20 ms until halving it again hardly changes the prediction", "s"),
    ] = 0.01
    force_split: Annotated[ForceSplit, OptionInfo("split of a step's forces; left: Caldwell et al.")] = "symmetric"
    constraint_force_at: Annotated[
        ConstraintForcePlacement, OptionInfo("where in a step grasp forces act; node: Caldwell et al.")
    ] = "midpoint"
    use_compiler: Annotated[bool, OptionInfo("whether to compile the step if there is a C compiler")] = True

    @property
    def time_step_or_10_ms(self) -> float:
        """The configured time step [s]; 0.01 if it is `auto`, which needs a recording to choose the step."""
        return 0.01 if self.time_step == "auto" else self.time_step


@dataclass(frozen=True, kw_only=True)
class _DiagnosisSettings(Thresholds):
    """The candidate effects and thresholds for the diagnosis of the sim-to-real gap."""

    candidates: Annotated[
        Literal["all"] | _Names, OptionInfo("effects to try: all, or a list of kind or kind@location")
    ] = "all"
    excluded_candidates: Annotated[_Names, OptionInfo("candidates not to try, by kind or kind@location")] = ()
    noise_fraction_of_stated_std: Annotated[
        float,
        Gt(0),
        Le(1),
        OptionInfo("fraction of all stated standard deviations that is noise; the rest represents model error"),
    ] = 1.0
    baseline_run_folders: Annotated[
        tuple[_FilePath, ...],
        OptionInfo("run folders of `solve` or `diagnose` with the same model; a diagnosis reports what changed since"),
    ] = ()

    @property
    def fit_excess_residual_criteria(self) -> ExcessResidualCriteria:
        """The criteria by which the residual after a fit exceeds noise, with `noise_fraction_of_stated_std` applied."""
        return replace(self.null_test_excess_criteria, noise_fraction_of_stated_std=self.noise_fraction_of_stated_std)


def _compared() -> dict[str, Solver]:
    return {
        "steepest_descent": SteepestDescent(
            first_trial_step_rule="spectral", nonmonotone_memory=10, max_iterations=800, gradient_tolerance=1e-4
        ),
        "single_shooting": SingleShooting(),
        "gauss_newton": GaussNewton(),
        "multiple_shooting": MultipleShooting(),
    }


@dataclass(frozen=True, kw_only=True)
class _CompareSettings:
    """Solvers to compare, each with its own settings."""

    methods: Annotated[
        Mapping[str, Annotated[Solver, RegistryChoice(SOLVERS)]], OptionInfo("settings of each method, by name")
    ] = field(default_factory=_compared)
    total_time_budget: Annotated[
        float | None, Gt(0), OptionInfo("total time for all methods, without the run of `solve`", "s")
    ] = 300.0
    reference_paper_experiment_name: Annotated[
        str | None, OptionInfo("experiment of Caldwell et al. (2014) whose result is shown for comparison")
    ] = None


@dataclass(frozen=True, kw_only=True)
class _VirtualFramesSettings:
    """A MuJoCo experiment with a virtual depth camera, used if there are no recorded frames."""

    seed: Annotated[int, Ge(0), OptionInfo("random seed of motion, noise and camera")] = 0
    duration: Annotated[float, Gt(0), Le(600), OptionInfo("duration of the experiment", "s")] = 5.0
    max_gripper_travel: Annotated[float, Gt(0), Le(1), OptionInfo("largest gripper distance from start", "m")] = 0.11
    gripper_start_offset_from_object_end: Annotated[
        Mapping[str, Vector3], OptionInfo("start relative to the end of the undeformed object, by grasp", "m")
    ] = field(default_factory=dict)
    camera_position: Annotated[Vector3, OptionInfo("position of the camera", "m")] = (2.6, 0.0, 0.45)
    camera_target: Annotated[Vector3, OptionInfo("point at which the camera looks", "m")] = (0.85, 0.0, -0.1)
    frame_rate: Annotated[float, Gt(0), Le(60), OptionInfo("mean rate of frames", "Hz")] = 3.0
    dropped_frame_fraction: Annotated[float, Ge(0), Lt(1), OptionInfo("fraction of frames that are lost")] = 0.0
    latency: Annotated[float, OptionInfo("stamp minus time of the image", "s")] = 0.0
    latency_std: Annotated[float, Ge(0), OptionInfo("standard deviation of the latency", "s")] = 0.0


@dataclass(frozen=True, kw_only=True)
class _TrackSettings:
    """Tracking of points in the frames of a depth camera."""

    frames_path: Annotated[
        _FilePath | None,
        OptionInfo("folder of clouds or depth images, bag, MCAP or RealSense file; virtual frames when absent"),
    ] = None
    frame_topic: Annotated[str | None, OptionInfo("topic of the clouds or depth images, if a bag has several")] = None
    camera_pose: Annotated[
        tuple[_Vector4, _Vector4, _Vector4, _Vector4] | None,
        OptionInfo("pose of the camera (x right, y down, z ahead) in the world, by rows; default: the folder's", "m"),
    ] = None
    point_cloud_unit: Annotated[Literal["m", "mm"] | None, OptionInfo("unit of clouds; default: the folder's")] = None
    background_frames_path: Annotated[
        _FilePath | None,
        OptionInfo("frames of the scene without robot and object from the same camera pose, whose points are removed"),
    ] = None
    virtual_frames: Annotated[_VirtualFramesSettings, OptionInfo("virtual frames, used without recorded frames")] = (
        _VirtualFramesSettings()
    )
    n_drawn_frames: Annotated[int, Ge(0), Le(1000), OptionInfo("number of frames with drawings of every stage")] = 2
    options: Annotated[TrackOptions, OptionInfo("filters, clock, calibration and acceptance of frames")] = field(
        default_factory=TrackOptions
    )


@dataclass(frozen=True, kw_only=True)
class _PlanSettings(PlanOptions):
    """Goal of a planned motion and the run that supplies the parameters."""

    parameter_run_folder: Annotated[
        _FilePath | None,
        OptionInfo("run folder of `solve` (or `diagnose`) with parameters and covariance; default: the initial values"),
    ] = None


@dataclass(frozen=True, kw_only=True)
class OutputSettings:
    """Settings of run folders, the report and the discretisation check."""

    runs_folder: Annotated[_FilePath | None, OptionInfo("folder of run folders; default: `runs`")] = None
    write_report: Annotated[bool, OptionInfo("whether report.html is written")] = True
    checked_discretisation: Annotated[
        Literal["none", "time_step", "both"] | None,
        OptionInfo(
            "what `solve` refines to test the estimates: nothing, the time step, or time step and links; "
            "default: both for an object of segments, the time step for others"
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """All sections of a configuration file. A section in --set changes only the keys it names; {} clears a section."""

    description: Annotated[str, OptionInfo("one sentence for the report")] = ""
    plugins: Annotated[
        tuple[_FilePath, ...], OptionInfo("Python files to execute, which register effects, sensors or report sections")
    ] = ()
    model: Annotated[_ModelSettings, OptionInfo("the mechanical model")] = _ModelSettings()
    recordings: Annotated[RecordingsSettings, OptionInfo("recordings for estimation and test")] = RecordingsSettings()
    import_: Annotated[ImportSettings, OptionInfo("conversion of other tools' files to recordings")] = ImportSettings()
    sensors: Annotated[
        Mapping[str, SensorOptions],
        OptionInfo("options by group of the recordings, such as points, joints.effort or wrist.force"),
    ] = field(default_factory=dict)
    parameters: Annotated[Mapping[str, ParameterSettings], OptionInfo("parameters by name or pattern")] = field(
        default_factory=dict
    )
    problem: Annotated[_ProblemSettings, OptionInfo("options: initial state, weights, filters, steps")] = (
        _ProblemSettings()
    )
    solver: Annotated[Solver, RegistryChoice(SOLVERS, "gauss_newton"), OptionInfo("method that minimises the cost")] = (
        field(default_factory=GaussNewton)
    )
    compare: Annotated[_CompareSettings, OptionInfo("methods that `compare` runs")] = _CompareSettings()
    diagnosis: Annotated[_DiagnosisSettings, OptionInfo("candidates and thresholds of `diagnose`")] = (
        _DiagnosisSettings()
    )
    track: Annotated[_TrackSettings, OptionInfo("tracking of points in a camera's frames")] = _TrackSettings()
    plan: Annotated[_PlanSettings, OptionInfo("the motion that `plan` computes")] = _PlanSettings()
    virtual_arm: Annotated[VirtualArmImperfections, OptionInfo("properties of the virtual arms of `blind`")] = field(
        default_factory=VirtualArmImperfections
    )
    output: Annotated[OutputSettings, OptionInfo("run folders and reports")] = OutputSettings()
    name: str = "run"  # stem of the configuration file
    config_file: str = field(default="", compare=False)  # path of the configuration file, empty without one
    # file and line of every key, for error messages
    key_locations: Mapping[tuple[str | int, ...], str] = field(default_factory=dict, compare=False, repr=False)

    def setting_location(self, *path: str | int) -> str:
        """Return the place of a setting (file, line and key) as text, for the `where` of an error message."""
        key, place = ".".join(map(str, path)), innermost_location(self.key_locations, path) or self.config_file
        option, _, told = place.partition(" ")
        # an override of another key is told only because it made the section of both
        if option == "--set" and not (f"{key}.".startswith(f"{told}.") or told.startswith(f"{key}.")):
            option, place = "", self.config_file
        rest = key
        if option == "--set":
            names = f"{key}.".removeprefix(f"{told}.").split(".")
            rest = ".".join(name for name in names if not name.isdigit()).strip(".")  # of a list: none
        below = {own for at, own in self.key_locations.items() if at[: len(path)] == path and own.startswith("--set ")}
        said = place if option == "--baseline" else ": ".join(filter(None, (place, rest)))
        return ", ".join((said, *sorted(below - {place})))

    def config_error(self, what: str, *path: str | int, hint: str, allowed: str = "") -> ConfigError:
        """Make a `ConfigError` that states the file, line and key of a setting. The caller raises it."""
        return ConfigError(what, where=self.setting_location(*path), allowed=allowed, hint=hint)


def innermost_location(locations: Mapping[tuple[str | int, ...], str], path: tuple[str | int, ...]) -> str | None:
    """Return the location of a key or, if it has none, of the innermost section around it that has one."""
    return next((locations[path[:n]] for n in range(len(path), 0, -1) if path[:n] in locations), None)


def config_yaml_with_defaults(run: RunSettings) -> str:
    """Return the settings of a run, with all defaults, as YAML text. `load_config` reads the same run from it."""
    stream = io.StringIO()
    yaml = YAML()
    yaml.width = 120
    yaml.dump(_plain(run), stream)
    return stream.getvalue()


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        result: dict[str, Any] = {}
        for name, option in class_options_by_key(type(value)).items():
            item = getattr(value, option.field_name)
            if item is not None or option.default_value is not None:
                markers = split_annotated(option.type_hint)[1]
                chosen = any(isinstance(m, RegistryChoice) and m.selector_key == "name" for m in markers)
                result[name] = {"name": item.name, **_plain(item)} if chosen else _plain(item)
        return result
    if isinstance(value, Mapping):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        sequence = CommentedSeq([_plain(item) for item in value])
        if not any(isinstance(item, dict) for item in sequence):
            sequence.fa.set_flow_style()
        return sequence
    return value
