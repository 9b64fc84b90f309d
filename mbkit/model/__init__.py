"""A system as frozen data, and its builder. No engine is imported here."""

from mbkit.model.base_parameters import BaseParameters
from mbkit.model.builder import ModelBuilder
from mbkit.model.elements.forces import Bushing, FrameForce, GravityCompensation, JointForce
from mbkit.model.elements.formula import Formula
from mbkit.model.elements.kinds import Needs
from mbkit.model.elements.motion_laws import FormulaMotion, SplineMotion
from mbkit.model.joint_types import KINDS, JointType, kind_of, register_joint_type
from mbkit.model.model import Model
from mbkit.model.parameters import Expression, Number, Parameter, known, nominal
from mbkit.model.parts import Body, Coupler, Frame, Joint, JointCoupling, Loop, Mimic, NoSlip, PointSpring, Prescribed

__all__ = [
    "KINDS",
    "BaseParameters",
    "Body",
    "Bushing",
    "Coupler",
    "Expression",
    "Formula",
    "FormulaMotion",
    "Frame",
    "FrameForce",
    "GravityCompensation",
    "Joint",
    "JointCoupling",
    "JointForce",
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
    "SplineMotion",
    "kind_of",
    "known",
    "nominal",
    "register_joint_type",
]
