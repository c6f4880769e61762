"""Frames in bags of ROS 1 and ROS 2, MCAP and RealSense files, which the tests write themselves."""

import numpy as np
import pytest
from ros_bags import START, Bag

from yid_ocp.errors import DataError
from yid_ocp.vision import CameraIntrinsics, look_at_pose
from yid_ocp.vision.frame_reading import read_frames

POSE = look_at_pose([2.0, 0.5, 0.3], [0.0, 0.0, 0.0])
CLOUDS = [np.random.default_rng(i).uniform(0.5, 2.0, (5 + i, 3)).astype(np.float32) for i in range(3)]
COLOURS = [np.random.default_rng(i).integers(0, 256, (5 + i, 3)).astype(np.uint8) for i in range(3)]
DEPTH = np.arange(1200, 1200 + 6 * 8, dtype=np.uint16).reshape(6, 8)
DEPTH[0, :2] = 0
LENS = CameraIntrinsics(8, 6, 10.0, 11.0, 3.5, 2.5, "plumb_bob", (-0.2, 0.05, 1e-3, -1e-3, 0.0))
NO_LENS = CameraIntrinsics(8, 6, 0, 0, 0, 0)
STAMPS = (0.3, 0.1, 0.2)
"""Since the first joint states [s]; messages come out of order."""
KINDS = ("bag", "db3 folder", "mcap folder")
UNSTAMPED = object()


class Film(Bag):
    """A bag with what a camera and an arm publish; times are in seconds after the start."""

    def at(self, topic, kind, seconds, **fields):
        stamp = 0 if seconds is UNSTAMPED else START + round(1e9 * seconds)
        self.put(topic, kind, header=self.header(stamp), **fields)

    def joints(self, seconds):
        empty = np.zeros(0)
        fields = {"name": ["a"], "position": np.zeros(1), "velocity": empty, "effort": empty}
        self.at("/joint_states", "sensor_msgs/msg/JointState", seconds, **fields)

    def cloud(self, seconds, points, colours=None, topic="/camera/points", names="xyz"):
        order = ">" if self.big else "<"
        columns = [(name, f"{order}f4") for name in names] + [("gap", "V4")]
        columns += [] if colours is None else [("rgb", f"{order}u4")]
        rows = np.zeros(len(points), columns)
        for name, column in zip(names, points.T, strict=True):
            rows[name] = column
        if colours is not None:
            wide = colours.astype(np.uint32)
            rows["rgb"] = (wide[:, 0] << 16) | (wide[:, 1] << 8) | wide[:, 2]
        places = {name: rows.dtype.fields[name][1] for name, _ in columns if name != "gap"}
        field, size = "sensor_msgs/msg/PointField", rows.dtype.itemsize
        fields = [self.of(field, name=name, offset=at, datatype=7, count=1) for name, at in places.items()]
        layout = {"height": 1, "width": len(rows), "point_step": size, "row_step": size * len(rows), "is_dense": False}
        data = np.frombuffer(rows.tobytes(), np.uint8)
        kind = "sensor_msgs/msg/PointCloud2"
        self.at(topic, kind, seconds, **layout, fields=fields, is_bigendian=self.big, data=data)

    def image(self, seconds, image, encoding, topic="/camera/depth/image_raw"):
        padded = np.zeros((image.shape[0], image.shape[1] + 1), image.dtype)  # rows may be longer than the picture
        padded[:, :-1] = image
        packed = padded.astype(padded.dtype.newbyteorder(">" if self.big else "<"))
        layout = {"height": image.shape[0], "width": image.shape[1], "step": packed.strides[0], "encoding": encoding}
        data = np.frombuffer(packed.tobytes(), np.uint8)
        self.at(topic, "sensor_msgs/msg/Image", seconds, **layout, is_bigendian=int(self.big), data=data)

    def info(self, lens=LENS, topic="/camera/depth/camera_info", model=None):
        matrix = np.array([lens.fx, 0, lens.cx, 0, lens.fy, lens.cy, 0, 0, 1])
        rectified = np.array([2 * lens.fx, 0, lens.cx, 0, 0, 2 * lens.fy, lens.cy, 0, 0, 0, 1, 0])
        names = {"k": matrix, "d": np.array(lens.coefficients), "r": np.eye(3).ravel(), "p": rectified}
        if self.ros1:
            names = {key.upper(): value for key, value in names.items()}
        nothing = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        region = self.of("sensor_msgs/msg/RegionOfInterest", **nothing)
        more = {"height": lens.height, "width": lens.width, "binning_x": 0, "binning_y": 0, "roi": region}
        self.at(topic, "sensor_msgs/msg/CameraInfo", 0.0, distortion_model=model or lens.model, **names, **more)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_clouds(tmp_path, kind, big):
    with Film(tmp_path, kind, big) as bag:
        bag.joints(0.0)
        for stamp, cloud, colours in zip(STAMPS, CLOUDS, COLOURS, strict=True):
            bag.cloud(stamp, cloud, colours)
    sequence = read_frames(bag.path, pose=POSE)
    assert np.allclose(sequence.stamps, STAMPS, atol=1e-9)
    for i in (2, 0, 1):
        assert np.array_equal(sequence.load_cloud(i), CLOUDS[i].astype(float))
        assert np.array_equal(sequence.load_colours(i), COLOURS[i])
    assert np.allclose(read_frames(bag.path, pose=POSE, unit="mm").load_cloud(0), 1e-3 * CLOUDS[0])


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
@pytest.mark.parametrize("kind", KINDS)
def test_depth_images_with_the_lens_of_the_camera(tmp_path, kind, encoding):
    image = DEPTH if encoding == "16UC1" else (1e-3 * DEPTH).astype(np.float32)
    with Film(tmp_path, kind) as bag:
        bag.info()
        bag.info(NO_LENS, topic="/camera/colour/camera_info")
        bag.image(0.5, image, encoding)
        bag.image(0.1, image, "rgb8", topic="/camera/colour/image_raw")
    sequence = read_frames(bag.path, pose=POSE)
    assert np.array_equal(sequence.stamps, [0.0])  # without joint states, since the first frame
    assert sequence.intrinsics == LENS
    assert np.allclose(sequence.load_cloud(0), LENS.points_from_depth(1e-3 * DEPTH), atol=1e-6)
    assert len(sequence.load_cloud(0)) == 46
    assert sequence.load_colours(0) is None


def test_rectified_images_have_no_distortion(tmp_path):
    with Film(tmp_path, "db3 folder") as bag:
        bag.info()
        bag.image(0.0, DEPTH, "16UC1", topic="/camera/depth/image_rect")
    lens = read_frames(bag.path, pose=POSE).intrinsics
    assert (lens.fx, lens.fy, lens.cx, lens.cy, lens.has_distortion) == (20.0, 22.0, 3.5, 2.5, False)


def test_a_file_of_a_realsense_camera(tmp_path):
    """Its topics, its encoding and its unit, as librealsense writes them."""
    sensor = "/device_0/sensor_0"
    with Film(tmp_path, "bag") as bag:
        bag.info(topic=f"{sensor}/Depth_0/info/camera_info")
        bag.info(NO_LENS, topic="/device_0/sensor_1/Color_0/info/camera_info")
        bag.put(f"{sensor}/option/Depth_Units/value", "std_msgs/msg/Float32", data=1e-4)
        bag.image(0.0, DEPTH, "mono16", topic=f"{sensor}/Depth_0/image/data")
        bag.image(0.0, DEPTH.astype(np.uint8), "rgb8", topic="/device_0/sensor_1/Color_0/image/data")
    sequence = read_frames(bag.path, pose=POSE)
    assert np.allclose(sequence.load_cloud(0), LENS.points_from_depth(1e-4 * DEPTH), atol=1e-9)


def test_messages_without_stamps_have_the_time_of_recording(tmp_path):
    with Film(tmp_path, "db3 folder") as bag:
        bag.info()
        bag.image(0.7, DEPTH, "16UC1")
        bag.image(UNSTAMPED, DEPTH, "16UC1")
    assert np.allclose(read_frames(bag.path, pose=POSE).stamps, [0.0, 1e-3], atol=1e-9)


def test_messages_of_one_time_are_told_apart(tmp_path):
    with Film(tmp_path, "db3 folder") as bag:
        for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
            bag.log = START
            bag.cloud(stamp, cloud)
    sequence = read_frames(bag.path, pose=POSE)
    assert {len(sequence.load_cloud(i)) for i in range(3)} == {5, 6, 7}


@pytest.mark.parametrize(
    ("fill", "options", "message"),
    [
        (lambda bag: bag.cloud(0, CLOUDS[0]), {"pose": None}, "pose of the camera is missing"),
        (lambda bag: bag.cloud(0, CLOUDS[0]), {"topic": "/camera/point"}, "no clouds or depth images on the topic"),
        (lambda bag: bag.cloud(0, CLOUDS[0]), {"unit": "cm"}, "there is no unit 'cm'"),
        (lambda bag: bag.joints(0), {}, "no clouds and no depth images"),
        (lambda bag: [bag.cloud(0, CLOUDS[0], topic=name) for name in ("/a", "/b")], {}, "2 topics of clouds"),
        (lambda bag: bag.image(0, DEPTH, "16UC1"), {}, "intrinsics of the camera are unknown"),
        (lambda bag: [bag.image(0, DEPTH, "16UC1"), bag.info(NO_LENS)], {}, "is not calibrated"),
        (lambda bag: [bag.image(0, DEPTH, "16UC1"), bag.info(model="odd")], {}, "model 'odd' is unknown"),
    ],
)
def test_what_a_bag_lacks_is_said(tmp_path, fill, options, message):
    with Film(tmp_path, "db3 folder") as bag:
        fill(bag)
    with pytest.raises(DataError, match=message) as caught:
        read_frames(bag.path, **{"pose": POSE, **options})
    assert "--field" not in caught.value.hint  # which `track` does not have


def test_a_cloud_without_places_and_a_cut_off_one_are_bad_frames(tmp_path):
    with Film(tmp_path, "db3 folder") as bag:
        bag.cloud(0.0, CLOUDS[0], names="xyi")
        bag.cloud(0.1, CLOUDS[1])
    sequence = read_frames(bag.path, pose=POSE)
    with pytest.raises(DataError, match="the cloud has the fields x, y, i"):
        sequence.load_cloud(0)
    assert np.array_equal(sequence.load_cloud(1), CLOUDS[1].astype(float))


def test_damaged_bags_and_other_files_are_refused(tmp_path):
    damaged = (("a.bag", b"#ROSBAG V2.0\nnonsense", "bag"), ("b.mcap", b"x" * 40, "bag"), ("c.db3", b"", "bag"))
    for name, text, message in (*damaged, ("d.txt", b"", "not a frame sequence")):
        (tmp_path / name).write_bytes(text)
        with pytest.raises(DataError, match=message):
            read_frames(tmp_path / name, pose=POSE)
