"""Models of the sensors, which predict readings at the nodes of a trajectory. A new kind of sensor is one file here."""

from importlib import import_module
from pkgutil import iter_modules

from yid_ocp.sensors.base import CHANNEL_KINDS as CHANNEL_KINDS
from yid_ocp.sensors.base import SENSOR_READERS as SENSOR_READERS
from yid_ocp.sensors.base import RecordedChannelSpec as RecordedChannelSpec
from yid_ocp.sensors.base import Sensor as Sensor
from yid_ocp.sensors.base import SensorData as SensorData
from yid_ocp.sensors.base import SensorDataInputs as SensorDataInputs
from yid_ocp.sensors.base import SensorOptions as SensorOptions
from yid_ocp.sensors.base import recorded_joint_column_indices as recorded_joint_column_indices
from yid_ocp.sensors.base import sensor_function_with_jacobians as sensor_function_with_jacobians
from yid_ocp.sensors.joints import PositionSensor as PositionSensor
from yid_ocp.sensors.joints import PrescribedJointEffortSensor as PrescribedJointEffortSensor
from yid_ocp.sensors.points import PointSensor as PointSensor
from yid_ocp.sensors.points import camera_pose_of_point_group as camera_pose_of_point_group

# every file of this folder registers its sensors when it is imported
for _module in iter_modules(__path__):
    import_module(f"{__name__}.{_module.name}")
