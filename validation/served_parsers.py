"""What an engine's own parser reads from a text; runs beside a version of the engine, without mbkit."""

from __future__ import annotations

import os
import tempfile


def imported(adapter, text, format_):
    """Return the engine of what was read, and the places of each joint's numbers."""
    read = {"on_pinocchio": _pinocchio, "on_drake": _drake, "on_newton": _newton}.get(adapter.__name__, _mujoco)
    engine = adapter.Engine(read(text, format_))
    return engine, {"joints": engine.joints()}


def _mujoco(text, _):
    import mujoco

    return mujoco.MjModel.from_xml_string(text)


def _newton(*_):
    raise NotImplementedError("its own parser is compared by mb.compare_parsers")


def _drake(text, format_):
    """Return the plant, its base welded to the world where nothing holds it."""
    from pydrake.multibody.parsing import Parser
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(0.0)
    models = Parser(plant).AddModelsFromString(text, "urdf" if format_ == "urdf" else "xml")
    if format_ == "urdf":
        carried = {int(plant.get_joint(j).child_body().index()) for j in plant.GetJointIndices()}
        for b in [b for model in models for b in plant.GetBodyIndices(model) if int(b) not in carried]:
            plant.WeldFrames(plant.world_frame(), plant.get_body(b).body_frame())
    plant.Finalize()
    joints = [plant.get_joint(j) for j in plant.GetJointIndices()]
    return plant, {joint.name(): [joint] for joint in joints if joint.num_velocities()}, {}


def _pinocchio(text, format_):
    import pinocchio as pin

    if format_ == "urdf":
        model = pin.buildModelFromXML(text)
    else:
        if not hasattr(pin, "buildModelFromMJCF"):
            raise NotImplementedError("this version reads no MJCF")
        with tempfile.TemporaryDirectory() as folder:
            path = os.path.join(folder, "model.xml")
            with open(path, "w", encoding="utf-8") as file:
                file.write(text)
            model = pin.buildModelFromMJCF(path)
    return model, {str(model.names[j]): [j] for j in range(1, model.njoints)}, {}, 0.0
