"""The mechanical model of a robot and a flexible object. The folder `effects` extends it."""

from yid_ocp.model.flexible import FlexibleObject as FlexibleObject
from yid_ocp.model.flexible import FlexibleSegment as FlexibleSegment
from yid_ocp.model.flexible import flexible_object as flexible_object
from yid_ocp.model.kinematics import forward_kinematics as forward_kinematics
from yid_ocp.model.mechanism import Mechanism as Mechanism
from yid_ocp.model.parameters import Parameter as Parameter
from yid_ocp.model.parameters import Parameters as Parameters
from yid_ocp.model.system import Grasp as Grasp
from yid_ocp.model.system import System as System
