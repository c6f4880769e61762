"""Make the recordings of the spring examples from their statics in closed form, without any integrator of ours.

    python benchmarks/make_spring_recordings.py [FOLDER]

Motions are slow enough for inertia to stay far below the noise.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from yid_ocp.data.recording import JointGroup, PointGroup, Recording
from yid_ocp.data.recording_hdf5 import write_recording

Array = NDArray[np.float64]
GRAVITY = 9.81
DURATION, RATE, FRAMES = 20.0, 50.0, 10.0  # [s], [Hz], [Hz]
NOISE = 1e-3  # [m]
AXIS_HEIGHT = 0.5  # [m]
SERIES_TRUTH = {"spring_1.stiffness": 200.0, "spring_2.stiffness": 300.0}  # [N/m]
TORSION_TRUTH = {"spring_1.stiffness": 2.0, "spring_2.stiffness": 3.0}  # [N m/rad]
SLIDER_MASS, END_MASS = 0.005, 0.5  # [kg]
ARM_MASS, ARM_LEVER, POINTER, MARKER = 0.3, 0.2, 0.3, 0.05  # [kg], [m]


def course(t: Array) -> Array:
    """Slow turn of the motor from -1 to 1 rad that starts and ends at rest."""
    return np.asarray(-np.cos(np.pi * t / DURATION))


def series_points(t: Array) -> Array:
    """Positions of `joint` and `end` on the tilted rail, shape (M, 2, 3): spring force = weight along the rail."""
    tilt = course(t)
    pull = GRAVITY * np.sin(tilt)
    first = 0.2 + (SLIDER_MASS + END_MASS) * pull / SERIES_TRUTH["spring_1.stiffness"]
    second = first + 0.2 + END_MASS * pull / SERIES_TRUTH["spring_2.stiffness"]
    along = np.stack([first, second], axis=1)
    zero = np.zeros_like(along)
    return np.stack([along * np.cos(tilt)[:, None], zero, AXIS_HEIGHT - along * np.sin(tilt)[:, None]], axis=2)


def torsion_points(t: Array) -> Array:
    """Positions of `pointer`, `shaft_end`, `coupling` and `coupling_marker`, shape (M, 4, 3).

    Both springs bear the torque of the arm's weight about the axis, so the total angle phi solves
    phi = motor - m g L cos(phi) (1/k1 + 1/k2).
    """
    motor = course(t)
    k1, k2 = TORSION_TRUTH.values()
    weight = ARM_MASS * GRAVITY * ARM_LEVER
    phi = motor.copy()
    for _ in range(100):
        slope = 1.0 - weight * np.sin(phi) * (1 / k1 + 1 / k2)
        phi = phi - (phi - motor + weight * np.cos(phi) * (1 / k1 + 1 / k2)) / slope
    first = motor - weight * np.cos(phi) / k1

    def on_circle(x: float, radius: float, angle: Array) -> Array:
        return np.stack([np.full_like(angle, x), radius * np.cos(angle), AXIS_HEIGHT + radius * np.sin(angle)], axis=1)

    points = (on_circle(0.2, POINTER, phi), on_circle(0.25, 0.0, phi), on_circle(0.1, 0.0, first))
    return np.stack([*points, on_circle(0.1, MARKER, first)], axis=1)


def recording(name: str, motor: str, points: tuple[str, ...], truth: dict[str, float], seed: int) -> Recording:
    rng = np.random.default_rng(seed)
    t, frames = np.arange(0.0, DURATION + 1e-9, 1 / RATE), np.arange(0.0, DURATION + 1e-9, 1 / FRAMES)
    clean = (series_points if motor == "tilt" else torsion_points)(frames)
    seen = clean + NOISE * rng.standard_normal(clean.shape)
    made = f"Statics in closed form; white noise of {1e3 * NOISE:g} mm on every coordinate of a point, seed {seed}."
    return Recording(
        JointGroup((motor,), t, course(t)[:, None], position_std=0.0),
        (PointGroup("points_camera", points, frames, seen, NOISE, sensor_name="camera", camera_pose=np.eye(4)),),
        made,
        "yid_ocp closed-form statics",
        name,
        true_parameters=truth,
    )


def make(folder: Path) -> None:
    series = recording("springs_series", "tilt", ("joint", "end"), SERIES_TRUTH, 2)
    names = ("pointer", "shaft_end", "coupling", "coupling_marker")
    torsion = recording("springs_torsion", "motor", names, TORSION_TRUTH, 3)
    for entry in (series, torsion):
        path = folder / f"{entry.name}.h5"
        write_recording(entry, path)
        print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Make the recordings of the spring examples.")
    default = Path(__file__).resolve().parents[1] / "configs" / "recordings"
    parser.add_argument("folder", nargs="?", type=Path, default=default)
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    make(arguments.folder)
