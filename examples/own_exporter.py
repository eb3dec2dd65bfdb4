"""Adds an export format without a change of the package: one CSV file of poses for each scene.

python -m examples.own_exporter RUN OUT
"""

import sys
from pathlib import Path

import stable_data as sd
from stable_data.atomic_files import safe_file_name, write_file_atomically
from stable_data.export.formats import FORMATS
from stable_data.simulation.scene_geometry import SceneGeometry


class PoseTable:
    """The format: what ``stable_data.export.formats.ExportFormat`` asks for."""

    ABOUT = "One CSV file for each scene: instance, centre of the box in metres, yaw in radians."

    def scene_path(self, scene: sd.Scene, out: Path) -> Path:
        """The file of a scene."""
        return out / f"{safe_file_name(scene.scene_id)}.csv"

    def export_scene(self, geometry: SceneGeometry, out: Path) -> None:
        """Writes the file of a scene in one step."""
        rows = [f'"{o.instance}",{",".join(map(str, (*o.position, o.yaw)))}' for o in geometry.scene.objects]
        write_file_atomically(self.scene_path(geometry.scene, out), "\n".join(["instance,x,y,z,yaw", *rows, ""]).encode())


if __name__ == "__main__":
    FORMATS["poses"] = PoseTable()
    result = sd.export_run(sd.RunFolder(sys.argv[1]), Path(sys.argv[2]), "poses", sd.SceneSelection(where="clean"))
    print(f"{result.num_written} scenes written, {len(result.failures)} failed")
