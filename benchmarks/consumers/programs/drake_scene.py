"""Drake reads SDFormat worlds, and URDF files that a JSON file places; its solver is SAP; see README.md."""

import json
import logging
import sys
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.geometry import DefaultProximityProperties, SceneGraphConfig
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, ContactModel, DiscreteContactApproximation, MultibodyPlant
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

STEP = 0.005

logging.getLogger("drake").setLevel(logging.ERROR)


def look(path: Path, seconds: float) -> dict[str, object]:
    """Opens a file."""
    try:
        return run(path, seconds, ContactModel.kHydroelasticWithFallback if seconds else ContactModel.kPoint)
    except RuntimeError as error:
        if "mesh field element was degenerate" not in str(error):  # the volume of a flat part
            raise
    return run(path, seconds, ContactModel.kPoint)


def run(path: Path, seconds: float, contacts: ContactModel) -> dict[str, object]:
    """Opens a file with a contact model."""
    builder = DiagramBuilder()
    plant, scene_graph = AddMultibodyPlantSceneGraph(builder, STEP)
    plant.set_discrete_contact_approximation(DiscreteContactApproximation.kSap)
    if contacts == ContactModel.kHydroelasticWithFallback:
        # Contacts of areas: contacts of points give a flat face a single point, on which it rocks and sinks.
        areas = DefaultProximityProperties(compliance_type="compliant", hydroelastic_modulus=1e7)
        scene_graph.set_config(SceneGraphConfig(default_proximity_properties=areas))
    plant.set_contact_model(contacts)
    parser = Parser(plant)
    if path.suffix == ".sdf":
        found = {plant.GetModelInstanceName(k): k for k in parser.AddModels(str(path))}
        del found["table"]
    else:
        found = place(json.loads(path.read_text("utf-8")), path.parent, plant, parser)
    plant.Finalize()
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = plant.GetMyContextFromRoot(simulator.get_context())
    bodies, seen = {name: plant.get_body(plant.GetBodyIndices(k)[0]) for name, k in found.items()}, {}
    for name, body in bodies.items():
        inertia = body.default_spatial_inertia()
        com, mass = inertia.get_com(), inertia.get_mass()
        # The tensor is about the origin of the body.
        about_origin = inertia.CalcRotationalInertia().CopyToFullMatrix3()
        seen[name] = {
            "mass": mass,
            "center_of_mass": com.tolist(),
            "inertia": (about_origin - mass * (com @ com * np.eye(3) - np.outer(com, com))).tolist(),
            "parts": len(plant.GetCollisionGeometriesForBody(body)),
            **pose(plant, context, body),
            "is_fixed": bool(plant.IsAnchored(body)),
        }
    if seconds:
        simulator.AdvanceTo(seconds)
        for name, body in bodies.items():
            seen[name]["after"] = pose(plant, context, body)
    return {"error": None, "bodies": seen}


def place(layout: dict[str, Any], folder: Path, plant: MultibodyPlant, parser: Parser) -> dict[str, object]:
    """Loads the files of a layout, and gives the model of each object."""
    parser.SetAutoRenaming(True)
    found = {}
    for entry in [layout["table"], *layout["objects"]]:
        [model] = parser.AddModels(str(folder / entry["urdf"]))
        body = plant.get_body(plant.GetBodyIndices(model)[0])
        x, y, z, w = entry["quat_xyzw"]
        where = RigidTransform(Quaternion(w, x, y, z), entry["position"])
        if entry["fixed"]:
            plant.WeldFrames(plant.world_frame(), body.body_frame(), where)
        else:
            plant.SetDefaultFloatingBaseBodyPose(body, where)
        found[entry["name"]] = model
    del found["table"]
    return found


def pose(plant: MultibodyPlant, context: object, body: object) -> dict[str, object]:
    """The pose of a body; nulls if it diverged."""
    where = plant.EvalBodyPoseInWorld(context, body)
    w, x, y, z = where.rotation().ToQuaternion().wxyz()
    numbers = [float(v) if np.isfinite(v) else None for v in (*where.translation(), x, y, z, w)]
    return {"position": numbers[:3], "quat_xyzw": numbers[3:]}


request = json.load(sys.stdin)
for file in request["files"]:
    try:
        opened = look(Path(file), request["seconds"])
    except Exception as error:  # noqa: BLE001 - the reason is the result
        opened = {"error": f"{type(error).__name__}: {error}"}
    print("SEEN", json.dumps(opened), flush=True)
