"""What must be true of the results of readers, whatever their input was."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzzing.watching import ROOT, FalsePass, check_text
from stable_data.errors import Notice
from stable_data.geometry.surface import Surface
from stable_data.mesatask.lint import LintResult
from stable_data.scene import Scene

DATA = ROOT / "tests" / "data"


def files_below(folder: Path, *patterns: str) -> dict[str, bytes]:
    """The files of a folder, by their paths within it; of all names, or of some patterns."""
    found = sorted({path for pattern in patterns or ("**/*",) for path in folder.glob(pattern) if path.is_file()})
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


def check_notices(notices: Iterable[Notice]) -> None:
    """Refuses notices that are no line, or report an unexpected error.

    Raises:
        FalsePass: See above.
    """
    for notice in notices:
        check_text(notice.message, notice.code)


def check_finite(what: str, *values: Any) -> None:
    """Refuses numbers that are not finite.

    Raises:
        FalsePass: See above.
    """
    for value in values:
        if value is not None and not np.isfinite(np.asarray(value, np.float64)).all():
            raise FalsePass(f"{what} is {value!r:.200}, expected finite numbers")


def check_scene(scene: Scene) -> None:
    """Refuses a scene with numbers that are not finite, or without extents.

    Raises:
        FalsePass: See above.
    """
    check_finite(f"table of {scene.scene_id!r:.80}", scene.table.size_xy, scene.table.restricted_zone)
    if min(scene.table.size_xy) <= 0:
        raise FalsePass(f"table is {scene.table.size_xy}")
    for o in scene.objects:
        check_finite(f"object {o.instance!r:.80}", o.position, o.size, o.scale, o.tilt_quat_xyzw, [o.yaw])
        if abs(math.hypot(*o.tilt_quat_xyzw) - 1) > 1e-6:
            raise FalsePass(f"object {o.instance!r:.80} has tilt {o.tilt_quat_xyzw}")


def check_surfaces(surfaces: Sequence[Surface]) -> None:
    """Refuses surfaces with corners that are not finite.

    Raises:
        FalsePass: See above.
    """
    for surface in surfaces:
        check_finite("surface", surface.triangles, surface.corner_uv, surface.corner_colours, surface.colour, [surface.opacity])


def check_lint(result: LintResult) -> None:
    """Refuses an audit that passes a scene although a figure of it is no number, and notices that are no lines.

    Raises:
        FalsePass: See above.
    """
    check_notices((*result.failures, *result.warnings))
    for row in result.rows:
        check_verdicts(row)


def check_verdicts(row: Any) -> None:
    """Refuses a row whose verdicts are good although a figure of it is no number.

    Raises:
        FalsePass: See above.
    """
    figures = {name: value for name, value in row.items() if isinstance(value, float) and not math.isfinite(value)}
    if figures and (row.get("clean") is True or row.get("stable") is True):
        raise FalsePass(f"clean is {row.get('clean')}, stable is {row.get('stable')}, but {figures}")


def plain(value: Any) -> Any:
    """A dataclass as a dict, for checks of its figures."""
    return dataclasses.asdict(value)
