"""Clean recordings of an arm that holds a rod, set up by `init` alone: is there a false alarm, is a tip mass named?

    python benchmarks/clean_rod.py [ROBOT ...] [--tip-mass KG] [--encoder-noise RAD] [--brisk] [--finer N]

Each ROBOT is a seed: it draws four links, a lightly damped rod of six links and two motions of 4 s. MuJoCo simulates
them by RK4 at 0.2 ms. Encoders are recorded at 200 Hz, three markers on the rod at 100 Hz with noise of 0.3 mm. The
CSV files go through `import`, `init` and `diagnose` without an edit. With `--finer N`, the rod that MuJoCo simulates
has N times as many links as the model.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from yid_ocp.cli import main as yid

JOINTS = ("waist", "lift", "bend", "wrist")
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0")
EFFORT_LIMITS = (40, 60, 30, 8)  # [N m]
FLANGE = 0.09  # from the wrist [m]
LINKS, RADIUS, STEP, DURATION = 6, 0.004, 2e-4, 4.0  # RK4 needs steps in the fourth power of a link's length
POINT_STD = 3e-4  # [m]


@dataclass(frozen=True)
class Arm:
    """Link lengths [m] and masses [kg] of an arm, and the length, mass, rigidity and damping of its rod."""

    lengths: tuple[float, ...]
    masses: tuple[float, ...]
    rod_length: float
    rod_mass: float
    rigidity: float  # [N m^2]
    damping: float  # [N m^2 s]


def drawn(seed: int) -> Arm:
    rng = np.random.default_rng(500 + seed)
    lengths = (0.1, *map(float, rng.uniform(0.15, 0.4, 3)), FLANGE)
    masses = tuple(map(float, rng.uniform(0.5, 1.0, 4) * [4, 3, 2, 0.8]))
    length, mass, rigidity = (float(rng.uniform(*span)) for span in ((0.45, 0.8), (0.04, 0.1), (0.1, 0.4)))
    return Arm(lengths, masses, length, mass, rigidity, float(10 ** rng.uniform(-3.3, -2.5)))


def links(arm: Arm) -> Iterator[tuple[str, str, float, float, float, float]]:
    """Joint, axis, place of the joint, centre of mass, mass and transverse inertia of each link."""
    for i, (joint, axis) in enumerate(zip(JOINTS, AXES, strict=True)):
        long, mass = arm.lengths[i + 1], arm.masses[i]
        yield joint, axis, arm.lengths[i], long / 2, mass, mass * long**2 / 10


def urdf(arm: Arm) -> str:
    text, parent = '<robot name="arm"><link name="base"/>', "base"
    for i, (joint, axis, place, middle, mass, across) in enumerate(links(arm)):
        inertia = f'ixx="{across}" iyy="{across}" izz="{0.001 * mass}" ixy="0" ixz="0" iyz="0"'
        inertial = f'<origin xyz="0 0 {middle}"/><mass value="{mass}"/><inertia {inertia}/>'
        limit = f'<limit lower="-2.9" upper="2.9" effort="{EFFORT_LIMITS[i]}" velocity="6"/>'
        text += f'<link name="l{i}"><inertial>{inertial}</inertial></link><joint name="{joint}" type="revolute">'
        text += f'<parent link="{parent}"/><child link="l{i}"/><origin xyz="0 0 {place}"/><axis xyz="{axis}"/>{limit}'
        text += "</joint>"
        parent = f"l{i}"
    fixed = f'<parent link="{parent}"/><child link="flange"/><origin xyz="0 0 {FLANGE}"/>'
    return text + f'<link name="flange"/><joint name="end" type="fixed">{fixed}</joint></robot>'


def mjcf(arm: Arm, tip_mass: float, finer: int) -> str:
    count = finer * LINKS
    long, mass = arm.rod_length / count, arm.rod_mass / count
    stiffness, damping = arm.rigidity / long, arm.damping / long
    across, along = mass * (3 * RADIUS**2 + long**2) / 12, mass * RADIUS**2 / 2
    body = "".join(
        f'<body pos="0 0 {place}"><joint name="{joint}" axis="{axis}"/>'
        f'<inertial pos="0 0 {middle}" mass="{m}" diaginertia="{inertia} {inertia} {0.001 * m}"/>'
        for joint, axis, place, middle, m, inertia in links(arm)
    )
    for i in range(count):
        share, place = (2, FLANGE) if i == 0 else (1, long)  # half a link to the clamp
        spring = f'stiffness="{share * stiffness}" damping="{share * damping}"'
        body += f'<body pos="0 0 {place}"><joint axis="1 0 0" {spring}/><joint axis="0 1 0" {spring}/>'
        body += f'<inertial pos="0 0 {long / 2}" mass="{mass}" diaginertia="{across} {across} {along}"/>'
        body += f'<site name="m{i}" pos="0 0 {long}"/>'
    if tip_mass:
        load = f'<inertial pos="0 0 0" mass="{tip_mass}" diaginertia="1e-7 1e-7 1e-7"/>'
        body += f'<body pos="0 0 {long}">{load}</body>'
    motors = "".join(f'<motor joint="{joint}"/>' for joint in JOINTS)
    option = f'<option timestep="{STEP / finer**4}"/>'
    closed = "</body>" * (len(JOINTS) + count)
    return f"<mujoco>{option}<worldbody>{body}{closed}</worldbody><actuator>{motors}</actuator></mujoco>"


def recorded(
    arm: Arm, seed: int, tip_mass: float, encoder_std: float, brisk: bool, finer: int
) -> tuple[np.ndarray, np.ndarray]:
    """Rows (time, joint angles) and (time, marker coordinates in mm) of a motion that begins and ends at rest."""
    step, model = STEP / finer**4, mujoco.MjModel.from_xml_string(mjcf(arm, tip_mass, finer))
    data, rng, noise = mujoco.MjData(model), np.random.default_rng(seed), np.random.default_rng(9000 + seed)
    rates = rng.uniform(0.35, 1.2, (4, 3)) * (1.6 if brisk else 1.0)
    phases, size = rng.uniform(0, 2 * np.pi, (4, 3)), np.array([0.5, 0.35, 0.45, 0.5])
    stiff, damp = np.array([1500.0, 1500.0, 500.0, 60.0]), np.array([60.0, 60.0, 20.0, 1.5])

    def wanted(t: float) -> np.ndarray:
        window = np.sin(np.pi * np.clip((t - 0.3) / (DURATION - 0.8), 0, 1)) ** 2
        return np.array([0, 0.5, 0.9, 0.4]) + window * size * np.sin(2 * np.pi * rates * t + phases).sum(axis=1) / 2.2

    def advance(t: float) -> None:
        at, speed = wanted(t), (wanted(t + 1e-4) - wanted(t)) / 1e-4
        data.ctrl[:] = data.qfrc_bias[:4] + stiff * (at - data.qpos[:4]) + damp * (speed - data.qvel[:4])
        mujoco.mj_step(model, data)

    data.qpos[:4] = wanted(0.0)
    # damped until the rod rests; RK4 takes damping as explicit
    kinds = mujoco.mjtIntegrator
    for factor, rest, kind in ((30.0, 3.0, kinds.mjINT_IMPLICITFAST), (1 / 30.0, 1.5, kinds.mjINT_RK4)):
        model.dof_damping[4:] *= factor
        model.opt.integrator = kind
        for _ in range(round(rest / step)):
            advance(0.0)
    angles, points = [], []
    for k in range(round(DURATION / step) + 1):
        if k % round(0.01 / step) == 0:
            mujoco.mj_kinematics(model, data)
            seen = np.concatenate([data.site(name).xpos for name in (f"m{k * finer - 1}" for k in (2, 4, LINKS))])
            points.append([k * step, *(1e3 * (seen + POINT_STD * noise.standard_normal(9)))])
        if k % round(0.005 / step) == 0:
            angles.append([k * step, *(data.qpos[:4] + encoder_std * noise.standard_normal(4))])
        advance(k * step)
    return np.array(angles), np.array(points)


def diagnosed(robot: int, tip_mass: float, encoder_std: float, brisk: bool, finer: int, folder: Path) -> str:
    """Verdict on a robot's recordings, a row of the table."""
    arm, files = drawn(robot), []
    (folder / "arm.urdf").write_text(urdf(arm))
    columns = ",".join(f"{name}.{axis}" for name in ("rod_1", "rod_2", "rod_tip") for axis in "XYZ")
    for i in (0, 1):
        angles, points = recorded(arm, 2 * robot + i, tip_mass, encoder_std, brisk, finer)
        tables = {
            "joints": (angles, "timestamp," + ",".join(f"pos_{n}" for n in JOINTS)),
            "mocap": (points, "time," + columns),
        }
        names = [str(folder / f"swing_{i}_{name}.csv") for name in tables]
        for name, (rows, head) in zip(names, tables.values(), strict=True):
            np.savetxt(name, rows, delimiter=",", fmt="%.7g", comments="", header=head)
        files.append(str(folder / f"swing_{i}.h5"))
        yid(["import", *names, "--units", "points=mm", "--out", files[-1], "--quiet"])
    numbers = {"length": arm.rod_length, "mass": arm.rod_mass, "radius": RADIUS, "links": LINKS}
    said = [text for name, value in numbers.items() for text in (f"--{name}", f"{value:.6g}")]
    run, out = str(folder / "run.yaml"), folder / "run"
    yid(["init", str(folder / "arm.urdf"), *files, "--object", "cable", *said, "--out", run, "--quiet"])
    begun = time.process_time()
    yid(["diagnose", run, "--set", "output.write_report=false", "--out", str(out), "--quiet"])
    found = json.loads((out / "result.json").read_text())
    named = ", ".join(f"{e['kind']}@{e['location']}" for e in found["effects"]) or "-"
    before = found["gap"]["before"]["chi2_per_dof"]
    return f"| {robot} | {found['verdict']} | {named} | {before:.3g} | {time.process_time() - begun:.0f} s |"


def main() -> None:
    parser = argparse.ArgumentParser(description="Diagnose clean arms that hold a rod, set up by init.")
    parser.add_argument("robots", nargs="*", type=int, default=[1, 2, 3])
    parser.add_argument("--tip-mass", type=float, default=0.0, help="unknown to the model [kg]")
    parser.add_argument("--encoder-noise", type=float, default=1e-4, help="standard deviation [rad]")
    parser.add_argument("--brisk", action="store_true", help="1.6 times the frequencies")
    parser.add_argument("--finer", type=int, default=1, help="links of the simulated rod per link of the model")
    chosen = parser.parse_args()
    print("| robot | verdict | named | chi2/n held out | CPU |\n|---|---|---|---|---|", flush=True)
    for robot in chosen.robots:
        with tempfile.TemporaryDirectory() as folder:
            how = (chosen.tip_mass, chosen.encoder_noise, chosen.brisk, chosen.finer)
            print(diagnosed(robot, *how, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
