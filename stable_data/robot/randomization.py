"""Domain randomisation: light, colours, friction, masses, cameras and the start pose of the arm, drawn from a seed."""

import json
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from stable_data.errors import ConfigError
from stable_data.robot.arm.assembly import CAMERAS, RobotModel
from stable_data.scene import TABLE, FloatArray
from stable_data.simulation.mujoco_import import mujoco


@dataclass(frozen=True, slots=True)
class RandomizationOptions:
    """How much is varied. 0 varies nothing.

    Attributes:
        light: Largest change of the lights' brightness, as a share, and of their direction, radians.
        colours: Largest change of the colour of each thing that is seen, as a share.
        friction: Largest change of the friction of each object, as a share.
        mass: Largest change of the mass of each object, as a share.
        cameras: Standard deviation of the positions of the cameras, metres, and of their directions in tenths of a radian.
        start: Standard deviation of the joints at the start, radians.
    """

    light: float = 0.0
    colours: float = 0.0
    friction: float = 0.0
    mass: float = 0.0
    cameras: float = 0.0
    start: float = 0.02

    def __post_init__(self) -> None:
        """Refuses amounts that make no sense."""
        for name, value in asdict(self).items():
            if not 0 <= value < 1:
                raise ConfigError(f"randomization.{name} is {value}, expected 0 or more and less than 1", "setting_invalid")


@dataclass(frozen=True, slots=True, eq=False)
class Drawn:
    """What was drawn for an episode.

    Attributes:
        start: Joints at the start, (J,), radians.
        document: Everything as values of JSON.
    """

    start: FloatArray
    document: dict[str, Any]

    @property
    def text(self) -> str:
        """The document as text."""
        return json.dumps(self.document, sort_keys=True)


class Randomizer:
    """Varies a model in place, from its own values each time.

    Args:
        built: The scene with the robot.
        options: How much.
    """

    def __init__(self, built: RobotModel, options: RandomizationOptions) -> None:
        self._built, self._options = built, options
        model = built.model
        self._own = {name: np.array(getattr(model, name)) for name in _FIELDS}
        names = {int(body): name for body, name in zip(built.object_bodies, built.names, strict=True)}
        collides = (model.geom_contype > 0) & ~built.robot_bodies[model.geom_bodyid]
        self._geoms = [(names.get(int(body), TABLE), np.flatnonzero(model.geom_bodyid == body)) for body in [0, *names]]
        self._solid = collides

    def apply(self, rng: np.random.Generator) -> Drawn:
        """Draws anew; the same generator state draws the same."""
        built, options, model = self._built, self._options, self._built.model
        for name, values in self._own.items():
            getattr(model, name)[:] = values
        document: dict[str, Any] = {}
        # Every number is drawn whatever the options are, so that one option does not change what another one draws.
        noise = rng.normal(size=len(built.robot.home))
        start = np.clip(np.array(built.robot.home) + options.start * noise, *model.jnt_range[self._arm_joints()].T)
        bright, turn = rng.uniform(-1, 1, model.nlight), rng.uniform(-1, 1, (model.nlight, 3))
        if options.light:
            model.light_diffuse[:] = np.clip(model.light_diffuse * (1 + options.light * bright[:, None]), 0.0, 1.0)
            direction = model.light_dir + options.light * turn
            model.light_dir[:] = direction / np.linalg.norm(direction, axis=1, keepdims=True)
            document["light"] = {"brightness": bright.round(4).tolist(), "direction": turn.round(4).tolist()}
        factors = {}
        for name, geoms in self._geoms:
            drawn = rng.uniform(-1, 1, 5)
            colour, friction, mass = drawn[:3], drawn[3], drawn[4]
            if options.colours:
                model.geom_rgba[geoms, :3] = np.clip(model.geom_rgba[geoms, :3] * (1 + options.colours * colour), 0.0, 1.0)
            solid = geoms[self._solid[geoms]]
            if options.friction:
                model.geom_friction[solid, 0] *= 1 + options.friction * friction
            if options.mass and name != TABLE:
                body = 1 + built.names.index(name)
                model.body_mass[body] *= 1 + options.mass * mass
                model.body_inertia[body] *= 1 + options.mass * mass
            factors[name] = {
                "colour": (1 + options.colours * colour).round(4).tolist(),
                "friction": round(1 + options.friction * friction, 4),
                "mass": round(1 + options.mass * mass, 4) if name != TABLE else 1.0,
            }
        if options.colours or options.friction or options.mass:
            document["factors"] = factors
            mujoco.mj_setConst(model, mujoco.MjData(model))
        for camera in CAMERAS:
            moved, turned = rng.normal(size=3), rng.normal(size=3)
            if options.cameras:
                k = model.camera(camera).id
                model.cam_pos[k] += options.cameras * moved
                quat = np.array(model.cam_quat[k])
                mujoco.mju_quatIntegrate(quat, 0.1 * options.cameras * turned, 1.0)
                model.cam_quat[k] = quat
                document.setdefault("cameras", {})[camera] = {
                    "moved": moved.round(4).tolist(),
                    "turned": turned.round(4).tolist(),
                }
        if options.start:
            document["start"] = start.round(5).tolist()
        return Drawn(start, document)

    def _arm_joints(self) -> list[int]:
        from_address = {int(a): k for k, a in enumerate(self._built.model.jnt_qposadr)}
        return [from_address[int(a)] for a in self._built.joint_addresses]


_FIELDS = (
    "light_diffuse", "light_dir", "geom_rgba", "geom_friction", "body_mass", "body_inertia", "cam_pos", "cam_quat",
    "dof_invweight0", "body_invweight0", "dof_M0", "body_subtreemass",
)  # fmt: skip
