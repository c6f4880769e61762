"""Initial shapes for the shape fit, from the centerline of the object in the cloud.

The ends of the course are given to the root and the tips of the object in every way in which their distances along it
are about those along the object; each way is a start whose links follow the course.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from yid_ocp.errors import DataError
from yid_ocp.model.kinematics import forward_kinematics
from yid_ocp.model.mechanism import Mechanism
from yid_ocp.model.system import System, floating_clamp
from yid_ocp.vision.centerline import Centerline
from yid_ocp.vision.surface_meshes import numeric_mechanism

Array = NDArray[np.float64]

_FREE_ROOT_PREFIX = "found_root"
"""Prefix of the joints that `with_free_root` adds."""
_MOST_ENDS = 7  # of a course; more are clutter, and there are too many ways
_ALIKE = 1.3  # a way whose distances are off by so many times the best one's is tried as well
_WHOLE = 0.08  # of the object, by which a course may be off that shows all of it


@dataclass(frozen=True, eq=False)
class EndAnchor:
    """Observed position of one end of an object along its own direction.

    Attributes
    ----------
    link_end_index : int
        Among the links' starts and ends, in this order link by link.
    direction : ndarray, shape (3,)
        Unit vector along the object.
    position : ndarray, shape (3,)
        The corner lies in the plane through this place across it [m].
    position_std : float
        [m]
    """

    link_end_index: int
    direction: Array
    position: Array
    position_std: float


@dataclass(frozen=True, eq=False)
class InitialShape:
    """Initial shape: configuration (n,), root position (3,) [m] and observed ends."""

    q: Array
    root_position: Array
    end_anchors: tuple[EndAnchor, ...]


def with_free_root(system: System, values: Mapping[str, float] | None = None) -> tuple[System, tuple[str, ...]]:
    """System with its object on six additional free joints, without grasps.

    Parameters
    ----------
    system : System
    values : mapping of str to float, optional
        Parameter values; nominal where absent.

    Returns
    -------
    System
    tuple of str
        The six joints: the root's place [m], then its turns about x, y and z [rad].
    """
    tree = numeric_mechanism(system, values)
    q = ca.SX.sym("q", system.n_coordinates)
    base = tree.joint_index(next(s for s in system.segment_layouts if s.parent_segment is None).link_joints[0][0])
    place = ca.Function("root", [q], [forward_kinematics(tree, q).joint_origins[base]])(np.zeros(system.n_coordinates))
    under = np.eye(4)
    under[:3, 3] = -np.array(place).ravel()
    carrier = floating_clamp(_FREE_ROOT_PREFIX)
    carried = carrier.with_mechanism(system.mechanism, _FREE_ROOT_PREFIX, under)
    return replace(system, mechanism=carried, grasps=()), carrier.joint_names


@dataclass(frozen=True, eq=False)
class _Link:
    """A link: joints by which it turns, how far from the root it begins and ends [m], and a tip that lies behind it."""

    joints: tuple[int, ...]
    begin: float
    end: float
    tip: int


class InitialShapeFinder:
    """Finder of initial shapes for an object.

    Parameters
    ----------
    system : System
    tree : Mechanism
        The system's, with numbers in place of its parameters.
    rest : ndarray, shape (n,)
        Configuration at rest.
    bends : sequence of int
        Joints that a shape may bend.
    lengths : mapping of str to sequence of float
        Of the links of every segment [m].
    """

    def __init__(
        self, system: System, tree: Mechanism, rest: Array, bends: Sequence[int], lengths: Mapping[str, Sequence[float]]
    ) -> None:
        self._rest, self._bends = rest, frozenset(bends)
        self._root = [tree.joint_index(name) for name in floating_clamp(_FREE_ROOT_PREFIX).joint_names]
        self._parent = [joint.parent_index for joint in tree.joints]
        self._axis = [np.array(joint.axis, float) for joint in tree.joints]
        self._turns = [joint.kind == "revolute" for joint in tree.joints]
        self._placed = [np.array(ca.DM(joint.placement.rotation)) for joint in tree.joints]
        names = {name: i for i, name in enumerate(tree.joint_names)}
        ends: dict[int, float] = {}
        found: list[tuple[str, int, tuple[int, ...], float, float]] = []
        for segment in system.segment_layouts:
            for i, (joints, length) in enumerate(zip(segment.link_joints, lengths[segment.name], strict=True)):
                indices = tuple(names[joint] for joint in joints)
                begin = ends.get(self._parent[indices[0]], 0.0)
                ends[indices[-1]] = begin + float(length)
                found.append((segment.name, i, indices, begin, begin + float(length)))
        carrying = {self._parent[indices[0]] for _, _, indices, _, _ in found}
        tips = [indices[-1] for _, _, indices, _, _ in found if indices[-1] not in carrying]
        self._corners = [0, *(2 * [indices[-1] for _, _, indices, _, _ in found].index(tip) + 1 for tip in tips)]
        ways = {tip: self._way(tip) for tip in tips}
        self.links = [
            _Link(indices, begin, end, next(k for k, tip in enumerate(tips) if indices[-1] in ways[tip]))
            for _, _, indices, begin, end in found
        ]
        self.root_to_tip_lengths = np.array([ends[tip] for tip in tips])
        shared = [[max((ends[j] for j in ways[a] & ways[b] if j in ends), default=0.0) for b in tips] for a in tips]
        count = len(tips) + 1
        self.end_distances = np.zeros((count, count))
        self.end_distances[0, 1:] = self.end_distances[1:, 0] = self.root_to_tip_lengths
        self.end_distances[1:, 1:] = self.root_to_tip_lengths[:, None] + self.root_to_tip_lengths - 2 * np.array(shared)
        np.fill_diagonal(self.end_distances, 0.0)

    @property
    def n_ends(self) -> int:
        """Number of ends of the object, including its root."""
        return len(self.end_distances)

    def _way(self, joint: int) -> set[int]:
        way = set()
        while joint >= 0:
            way.add(joint)
            joint = self._parent[joint]
        return way

    def find_initial_shapes(self, trace: Centerline) -> list[InitialShape]:
        """Initial shapes that follow a centerline whose ends are as far apart as the object's.

        Parameters
        ----------
        trace : Trace

        Raises
        ------
        DataError
            The course has other ends than the object, or is not as long: part of the object is hidden, or something
            else hangs together with it.
        """
        leaves = trace.end_nodes
        if not self.n_ends <= len(leaves) <= _MOST_ENDS:
            counts = f"the cloud has {len(leaves)} ends, the object {self.n_ends}"
            raise DataError(f"the object cannot be followed from end to end: {counts}")
        # the middles of the last slices are half a slice from the ends
        along = np.array([trace.path_lengths_from(int(leaf))[0][leaves] for leaf in leaves]) + trace.slice_width
        np.fill_diagonal(along, 0.0)
        ways = []
        for chosen in permutations(range(len(leaves)), self.n_ends):
            off = np.abs(along[np.ix_(chosen, chosen)] - self.end_distances)
            ways.append((float(off.max()), chosen))
        best, nearest = min(ways)
        if best > max(_WHOLE * float(self.root_to_tip_lengths.max()), trace.slice_width):
            own = self.end_distances[0, 1]
            lengths = f"{along[nearest[0], nearest[1]]:.2f} m from end to end, the object has {own:.2f} m"
            raise DataError(f"the object cannot be followed from end to end: the cloud has {lengths}")
        limit = max(_ALIKE * best, trace.slice_width)
        kept = [chosen for off, chosen in sorted(ways) if off <= limit][: 2 * self.n_ends]
        return [self._along(trace, [int(leaves[k]) for k in chosen]) for chosen in kept]

    def _along(self, trace: Centerline, ends: Sequence[int]) -> InitialShape:
        """The start whose root and tips lie at some nodes of the course."""
        courses = [
            _Course(trace.path_between(ends[0], end), reach)
            for end, reach in zip(ends[1:], self.root_to_tip_lengths, strict=True)
        ]
        q = self._rest.copy()
        first = self.links[0]
        turned = self._rotations(q)
        aim = courses[first.tip].direction(first.begin, first.end)
        carry = _turn(turned[first.joints[-1]][:, 2], aim)
        for link in self.links[1:]:
            aim = carry.T @ courses[link.tip].direction(link.begin, link.end)
            carrier = self._parent[link.joints[0]]
            self._bend(q, link.joints, turned[carrier] if carrier >= 0 else np.eye(3), aim, turned)
        place = courses[first.tip].at(0.0)
        q[self._root[:3]] = place
        q[self._root[3:]] = Rotation.from_matrix(carry).as_euler("XYZ")
        anchors = []
        for corner, end in zip(self._corners, ends, strict=True):
            ahead = trace.outward_direction(end)
            middle = trace.nodes[end] + 0.5 * trace.slice_width * ahead
            anchors.append(EndAnchor(corner, ahead, middle, trace.slice_width / np.sqrt(12.0)))
        return InitialShape(q, place, tuple(anchors))

    def _rotations(self, q: Array) -> list[Array]:
        """Orientation of every joint's moving frame in the world."""
        turned: list[Array] = []
        for j, parent in enumerate(self._parent):
            turned.append((turned[parent] if parent >= 0 else np.eye(3)) @ self._own(j, q[j]))
        return turned

    def _own(self, joint: int, value: float) -> Array:
        if not self._turns[joint] or value == 0.0:
            return self._placed[joint]
        return np.asarray(self._placed[joint] @ Rotation.from_rotvec(value * self._axis[joint]).as_matrix())

    def _bend(self, q: Array, joints: Sequence[int], carrier: Array, aim: Array, turned: list[Array]) -> None:
        """Set the bends of a link so that its z axis, by which it is long, looks where it should."""
        bends = [j for j in joints if j in self._bends]
        base, ahead = carrier, np.array([0.0, 0.0, 1.0])
        for j in joints:
            if bends and j == bends[0]:
                local = (base @ self._placed[j]).T @ aim
                axis = self._axis[j]
                if len(bends) > 1:  # turns about the first axis leave what lies along it
                    other = self._axis[bends[1]]
                    rate = float(np.cross(other, ahead) @ axis)
                    q[bends[1]] = np.arcsin(np.clip(rate * float(local @ axis), -1.0, 1.0))
                    ahead = Rotation.from_rotvec(q[bends[1]] * other).apply(ahead)
                across = np.cross(axis, ahead)
                q[j] = np.arctan2(
                    float(local @ across), float(local @ ahead) - float(local @ axis) * float(ahead @ axis)
                )
            base = base @ self._own(j, q[j])
            turned[j] = base


class _Course:
    """A way through a cloud as a line, by length along it, which is stretched to that of the object."""

    def __init__(self, nodes: Array, length: float) -> None:
        steps = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        self.nodes, self.along = nodes, along * (length / max(float(along[-1]), 1e-9))

    def at(self, length: float) -> Array:
        """The place so far along it [m]."""
        return np.array([np.interp(length, self.along, self.nodes[:, axis]) for axis in range(3)])

    def direction(self, begin: float, end: float) -> Array:
        """Unit vector from one place to another."""
        way = self.at(end) - self.at(begin)
        return np.asarray(way / max(float(np.linalg.norm(way)), 1e-9))


def _turn(one: Array, other: Array) -> Array:
    """The least rotation from one direction to another, shape (3, 3)."""
    axis = np.cross(one, other)
    sine, cosine = float(np.linalg.norm(axis)), float(one @ other)
    if sine < 1e-9:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(one, np.eye(3)[int(np.argmin(np.abs(one)))])
        sine, cosine = float(np.linalg.norm(axis)), -1.0
        return np.asarray(Rotation.from_rotvec(np.pi * axis / sine).as_matrix())
    return np.asarray(Rotation.from_rotvec(np.arctan2(sine, cosine) * axis / sine).as_matrix())
