"""Frames of a depth camera: clouds with time stamps and the camera's pose, wherever they come from."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from yid_ocp.errors import DataError
from yid_ocp.vision.camera_intrinsics import CameraIntrinsics

Array = NDArray[np.float64]
Colours = NDArray[np.uint8]


@cache
def import_open3d() -> ModuleType:
    """The open3d package; `DataError` where it is not installed or cannot be loaded."""
    hint = "pip install 'yid-ocp[vision]'"
    try:
        # the wheel of open3d wants the system's libusb, which a bare machine does not have
        import libusb_package

        ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError):
        pass  # the system may have its own
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise DataError(f"vision needs Open3D, which cannot be loaded ({error})", hint=hint) from error
    return open3d


@dataclass(frozen=True, eq=False)
class FrameSequence:
    """Sequence of clouds of one camera, loaded one at a time.

    Attributes
    ----------
    stamps : ndarray, shape (M,)
        Time stamps as the camera gave them, in the order of the frames: neither sorted nor unique [s].
    frame_names : tuple of str
    camera_pose : ndarray, shape (4, 4)
        Camera (x right, y down, z ahead) in the world [m].
    load_cloud : callable
        From a frame's index to its cloud in the camera's frame, shape (N, 3) [m]; `DataError` where it cannot be read.
    intrinsics : Pinhole, optional
    source : str
        Where the frames come from, for messages.
    load_colours : callable, optional
        From a frame's index to the red, green and blue of each of its points, shape (N, 3), None where it has none.
    """

    stamps: Array
    frame_names: tuple[str, ...]
    camera_pose: Array
    load_cloud: Callable[[int], Array]
    intrinsics: CameraIntrinsics | None = None
    source: str = "sequence"
    load_colours: Callable[[int], Colours | None] | None = None

    def __len__(self) -> int:
        return len(self.frame_names)

    def load_world_cloud(self, index: int) -> Array:
        """Cloud of a frame in the world, shape (N, 3) [m]; `DataError` where it cannot be read."""
        return self.load_cloud(index) @ self.camera_pose[:3, :3].T + self.camera_pose[:3, 3]

    def select_frames(self, indices: Sequence[int]) -> FrameSequence:
        """The frame sequence with only these frames, in this order."""
        kept = [int(i) for i in indices]
        names, colours = tuple(self.frame_names[i] for i in kept), self.load_colours
        return replace(
            self,
            stamps=self.stamps[kept],
            frame_names=names,
            load_cloud=lambda i: self.load_cloud(kept[i]),
            load_colours=None if colours is None else lambda i: colours(kept[i]),
        )

    @staticmethod
    def from_clouds(
        t: ArrayLike, clouds: Sequence[ArrayLike], pose: ArrayLike, *, source: str = "sequence"
    ) -> FrameSequence:
        """A frame sequence of clouds that are in memory.

        Parameters
        ----------
        t : array_like, shape (M,)
            [s]
        clouds : sequence of array_like, each (N, 3)
            In the camera's frame [m].
        pose : array_like, shape (4, 4)
            Camera in the world.
        source : str
        """
        arrays = [np.asarray(cloud, float).reshape(-1, 3) for cloud in clouds]
        names = tuple(f"frame {i}" for i in range(len(arrays)))
        return FrameSequence(
            np.asarray(t, float), names, validated_pose(pose, source), arrays.__getitem__, None, source
        )


def look_at_pose(eye: ArrayLike, target: ArrayLike, up: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Pose of a camera (x right, y down, z ahead) at `eye` that looks at `target`, shape (4, 4) [m]."""
    position = np.asarray(eye, float)
    ahead = np.asarray(target, float) - position
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, np.asarray(up, float))
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    pose[:3, 3] = position
    return pose


def validated_pose(pose: ArrayLike | None, where: str) -> Array:
    """A camera's pose as an array; `DataError` where it is missing or not a rigid transform."""
    hint = "give the camera in the world as a 4x4 matrix, x right, y down, z ahead, translation in metres"
    if pose is None:
        raise DataError("the pose of the camera is missing", where=where, hint=hint)
    try:
        matrix = np.asarray(pose, float)
    except (TypeError, ValueError) as error:
        raise DataError("the pose of the camera is not a matrix of numbers", where=where, hint=hint) from error
    good = matrix.shape == (4, 4) and bool(np.isfinite(matrix).all())
    if good:
        rotation = matrix[:3, :3]
        good = bool(np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-4) and np.linalg.det(rotation) > 0)
        good = good and bool(np.allclose(matrix[3], [0, 0, 0, 1]))
    if not good:
        raise DataError("the pose of the camera is not a rigid transform", where=where, allowed="4x4", hint=hint)
    return matrix
