"""A scene with a robot at its table, as one MuJoCo model, and where everything is in the model."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from stable_data.geometry.surface_sampling import surface_points
from stable_data.robot.arm.mounting import Mount
from stable_data.robot.arm.robots import Robot, robot_spec
from stable_data.rotations import quat_of, wxyz, yaw_quat
from stable_data.scene import FloatArray, IntArray
from stable_data.simulation.mujoco_import import mujoco
from stable_data.simulation.mujoco_model import VISUAL, VISUAL_GROUP, engine_spec
from stable_data.simulation.room import FLOOR
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.settling import compile_spec

ROBOT_PREFIX = "robot/"
"""Before all names of the robot in the model."""

TOOL = f"{ROBOT_PREFIX}tool"
"""The site of the tool frame."""

WRIST = "wrist"
"""The camera at the hand."""

CAMERAS = (WRIST, "front", "top")
"""The cameras of a scene with a robot."""

SURFACE_POINTS = 32
"""Points by which the surface of an object is described."""

_STAND_COLOUR = (0.28, 0.29, 0.31, 1.0)
_STAND_HALF = 0.09  # half the width of the stand below the base, metres
_WRIST_CAMERA = (0.08, 0.0, -0.06)  # in the tool frame, metres
_WRIST_TARGET = 0.12  # how far before the tool frame the camera looks, metres
_WRIST_FIELD = 70.0  # degrees


@dataclass(frozen=True, slots=False, eq=False)
class RobotModel:
    """A MuJoCo model of a scene with a robot.

    Attributes:
        model: The compiled model.
        robot: The robot.
        mount: Its base in the frame of the scene.
        geometry: The scene with its geometry.
    """

    model: mujoco.MjModel
    robot: Robot
    mount: Mount
    geometry: SceneGeometry

    @cached_property
    def _surfaces(self) -> dict[int, FloatArray]:
        return {}

    def surface(self, index: int) -> FloatArray:
        """Points all over the surface of an object, (SURFACE_POINTS, 3), metres, body frame."""
        if index not in self._surfaces:
            points, _ = surface_points(self.geometry.shapes[index].ordered_mesh, SURFACE_POINTS)
            self._surfaces[index] = points.astype(np.float64)
        return self._surfaces[index]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Instances of the scene, in its order."""
        return tuple(o.instance for o in self.geometry.scene.objects)

    @cached_property
    def joint_addresses(self) -> IntArray:
        """Places of the arm's joints in ``qpos``, (J,)."""
        return self._joints("jnt_qposadr")

    @cached_property
    def speed_addresses(self) -> IntArray:
        """Places of the arm's joints in ``qvel``, (J,)."""
        return self._joints("jnt_dofadr")

    @cached_property
    def controls(self) -> IntArray:
        """Actuators of the arm's joints, (J,)."""
        return np.array([self.model.actuator(ROBOT_PREFIX + name).id for name in self.robot.actuators], np.int64)

    @cached_property
    def hand_control(self) -> int:
        """The actuator of the hand."""
        return int(self.model.actuator(ROBOT_PREFIX + self.robot.hand.actuator).id)

    @cached_property
    def opening_address(self) -> int:
        """Place of the hand's opening joint in ``qpos``."""
        return int(self.model.joint(ROBOT_PREFIX + self.robot.hand.opening_joint).qposadr[0])

    @cached_property
    def hand_addresses(self) -> IntArray:
        """Places of all joints of the hand in ``qpos``."""
        arm = set(self.joint_addresses.tolist())
        joints = [k for k in range(self.model.njnt) if self.model.joint(k).name.startswith(ROBOT_PREFIX)]
        return np.array([a for k in joints if (a := int(self.model.jnt_qposadr[k])) not in arm], np.int64)

    def hand_positions(self, opening: float) -> FloatArray:
        """Positions of all joints of the hand at an opening, metres; those of linked fingers as they are when it is open."""
        hand, start = self.robot.hand, self.start_qpos[self.hand_addresses]
        share = opening / hand.max_opening
        return hand.closed_angle + share * (start - hand.closed_angle) if hand.open_angle > hand.closed_angle else start

    @cached_property
    def tool(self) -> int:
        """The site of the tool frame."""
        return int(self.model.site(TOOL).id)

    @cached_property
    def robot_bodies(self) -> npt.NDArray[np.bool_]:
        """Whether each body is of the robot."""
        return np.array([self.model.body(k).name.startswith(ROBOT_PREFIX) for k in range(self.model.nbody)])

    @cached_property
    def hand_bodies(self) -> npt.NDArray[np.bool_]:
        """Whether each body is of the hand: the body of the tool frame, and those that hang on its parent link."""
        root = int(self.model.body(ROBOT_PREFIX + self.robot.hand.body).id)
        found = np.zeros(self.model.nbody, bool)
        found[root] = True
        for body in range(root + 1, self.model.nbody):  # parents come before their children
            found[body] = found[self.model.body_parentid[body]]
        return found

    @cached_property
    def finger_bodies(self) -> tuple[frozenset[int], frozenset[int]]:
        """Bodies of the first and of the second finger."""
        one, other = self.robot.hand.fingers
        return self._bodies(one), self._bodies(other)

    @cached_property
    def object_bodies(self) -> IntArray:
        """The body of each object of the scene, (N,)."""
        return np.arange(1, len(self.names) + 1)

    @cached_property
    def free_addresses(self) -> Mapping[str, tuple[int, int]]:
        """Places of each object's free joint in ``qpos`` and ``qvel``; fixed objects have none."""
        found = {}
        for k, name in enumerate(self.names):
            if self.model.body_jntnum[k + 1]:
                joint = int(self.model.body_jntadr[k + 1])
                found[name] = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
        return found

    @cached_property
    def start_qpos(self) -> FloatArray:
        """Positions of all joints at the start: objects at their poses, the arm at home, the hand open."""
        data = mujoco.MjData(self.model)
        qpos = np.array(data.qpos)
        qpos[self.joint_addresses] = self.robot.home
        for address in self.hand_addresses:
            qpos[address] = self.robot.hand.open_angle if abs(self.robot.hand.open_angle) > 0 else qpos[address]
        return qpos

    def object_poses(self, data: mujoco.MjData) -> FloatArray:
        """Position (metres, scene frame) and quaternion (xyzw) of every object, (N, 7)."""
        n = len(self.names)
        return np.concatenate([data.xpos[1 : n + 1], data.xquat[1 : n + 1][:, [1, 2, 3, 0]]], axis=1)

    def tool_pose(self, data: mujoco.MjData) -> tuple[FloatArray, FloatArray]:
        """Position (3,) and rotation matrix (3, 3) of the tool frame in the frame of the base."""
        turn = self.mount.rotation
        position = self.mount.to_base(np.array(data.site_xpos[self.tool]))
        return position, turn.T @ np.array(data.site_xmat[self.tool]).reshape(3, 3)

    def _joints(self, field: str) -> IntArray:
        values = getattr(self.model, field)
        return np.array([values[self.model.joint(ROBOT_PREFIX + name).id] for name in self.robot.joints], np.int64)

    def _bodies(self, names: tuple[str, ...]) -> frozenset[int]:
        return frozenset(int(self.model.body(ROBOT_PREFIX + name).id) for name in names)


def assemble(geometry: SceneGeometry, robot: Robot, mount: Mount, picture: tuple[int, int] = (128, 128)) -> RobotModel:
    """Builds the model of a scene with a robot at its table.

    Args:
        geometry: The scene with its geometry.
        robot: The robot.
        mount: Where it stands.
        picture: Width and height of the largest picture that can be rendered off screen, pixels.

    Raises:
        MeshError: An object has no solid part, or MuJoCo refuses the model.
        ConfigError: The files of the robot cannot be read.
    """
    spec = engine_spec(geometry, picture)
    for key in list(spec.keys):
        spec.delete(key)  # they have no values for the robot's joints
    arm = robot_spec(robot)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # the stiff joints of an arm need it
    arm.option.integrator, arm.option.impratio, arm.option.cone = spec.option.integrator, spec.option.impratio, spec.option.cone
    hand = arm.body(robot.hand.body)
    hand.add_site(name="tool", pos=list(robot.hand.position), quat=wxyz(robot.hand.quat_xyzw), rgba=[0.0] * 4)
    frame = spec.worldbody.add_frame(pos=mount.position.tolist(), quat=wxyz(yaw_quat(mount.yaw)))
    spec.attach(arm, frame=frame, prefix=ROBOT_PREFIX)
    _add_wrist_camera(spec, robot)
    if robot.table_base is None:
        _add_stand(spec, mount)
    return RobotModel(compile_spec(spec), robot, mount, geometry)


def _add_wrist_camera(spec: mujoco.MjSpec, robot: Robot) -> None:
    """Adds a camera beside the hand that looks along the fingers, with the object between them in its middle."""
    tool, (x, y, z) = Rotation.from_quat(robot.hand.quat_xyzw), _WRIST_CAMERA
    forward = np.array([-x, -y, _WRIST_TARGET - z])
    forward /= np.linalg.norm(forward)
    right = np.array([0.0, 1.0, 0.0])
    turn = tool * Rotation.from_matrix(np.stack([right, np.cross(-forward, right), -forward], axis=1))
    position = np.array(robot.hand.position) + tool.apply(_WRIST_CAMERA)
    spec.body(ROBOT_PREFIX + robot.hand.body).add_camera(
        name=WRIST, fovy=_WRIST_FIELD, pos=position.tolist(), quat=wxyz(quat_of(turn))
    )


def _add_stand(spec: mujoco.MjSpec, mount: Mount) -> None:
    """Adds what is seen below the robot: a column down to the floor."""
    floor = np.array(spec.mesh(spec.geom(FLOOR).meshname).uservert).reshape(-1, 3)[:, 2].max()
    half = max(0.01, -float(floor) / 2)
    spec.worldbody.add_geom(
        spec.find_default(VISUAL),
        name="robot_stand",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[_STAND_HALF, _STAND_HALF, half],
        pos=[mount.x, mount.y, mount.z - half],
        quat=wxyz(yaw_quat(mount.yaw)),
        rgba=list(_STAND_COLOUR),
        group=VISUAL_GROUP,
    )
