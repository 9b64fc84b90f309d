"""What a system is: frozen data and its builder. No engine is imported here."""

from mbkit.model.base_parameters import BaseParameters
from mbkit.model.builder import ModelBuilder
from mbkit.model.description import Needs
from mbkit.model.joint_types import KINDS, JointKind, JointType, kind_of, register_joint_type
from mbkit.model.model import Model
from mbkit.model.parameters import Expression, Number, Parameter, known, nominal
from mbkit.model.parts import Body, Coupler, Frame, Joint, JointCoupling, Loop, Mimic, NoSlip, PointSpring, Prescribed

__all__ = [
    "KINDS",
    "BaseParameters",
    "Body",
    "Coupler",
    "Expression",
    "Frame",
    "Joint",
    "JointCoupling",
    "JointKind",
    "JointType",
    "Loop",
    "Mimic",
    "Model",
    "ModelBuilder",
    "Needs",
    "NoSlip",
    "Number",
    "Parameter",
    "PointSpring",
    "Prescribed",
    "kind_of",
    "known",
    "nominal",
    "register_joint_type",
]
