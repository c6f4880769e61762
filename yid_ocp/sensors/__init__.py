"""What is measured: each sensor turns a node of the trajectory into readings; add one file for a new kind."""

from yid_ocp.sensors.base import Sensor as Sensor
from yid_ocp.sensors.base import sensor_function as sensor_function
from yid_ocp.sensors.joints import EffortSensor as EffortSensor
from yid_ocp.sensors.points import PointSensor as PointSensor
