"""Audits the scene files of a folder, as :func:`stable_data.mesatask.lint.lint_folder` audits a folder in the MesaTask-10K format."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from tqdm import tqdm

from stable_data.assets.store import AssetStore
from stable_data.diversity.scene_set import ComparedScene
from stable_data.errors import ConfigError, Notice, StableDataError
from stable_data.importers.boundary import Boundary
from stable_data.importers.scenes.formats import SUFFIXES, is_scene_candidate, is_usd, repaired_name
from stable_data.importers.scenes.layouts import scenes_of_file
from stable_data.importers.scenes.opening import read_scene_file
from stable_data.importers.scenes.scene_assets import SceneAssets
from stable_data.mesatask.lint import LintResult
from stable_data.metrics.audit import audit_scene
from stable_data.storage.schemas import Row


def scene_candidates(root: Path) -> list[str]:
    """The files of a folder that may be scenes, by their suffix and their first element; not what a repair wrote beside its original.

    Raises:
        ConfigError: There is no such folder.
    """
    found = list(Boundary(root).files(SUFFIXES))
    repaired = {repaired_name(path) for path in found if is_usd(path)}
    return [path for path in found if path not in repaired and is_scene_candidate(root, path)]


def no_scene_error(root: Path, num_files: int, others: str = "") -> ConfigError:
    """The error that a folder holds no scene (``source_missing``).

    Args:
        root: The folder.
        num_files: Its files that may be scenes.
        others: What else is expected, beside scene files.
    """
    found = "no scene file" if num_files == 0 else f"no scene, because none of its files ({num_files}) has a free body"
    expected = f"a scene file ({', '.join(sorted(SUFFIXES))}) with a free body{others}"
    return ConfigError(f"{root}: {found}, expected {expected}; check the path", "source_missing")


def lint_scene_files(root: Path, paths: Sequence[str], *, progress: bool = False) -> LintResult:
    """Audits scene files: one row for each surface on which free bodies stand.

    Files without a free body are left out; those that other files include, too, if they cannot be used alone.

    Args:
        root: The source folder; nothing outside of it is read.
        paths: The files, relative to it.
        progress: Whether to show a progress bar.

    Raises:
        ConfigError: There is no scene, and no file that could not be read (``source_missing``).
    """
    rows, scenes = list[Row](), list[ComparedScene]()
    failures: list[Notice] = []
    warnings: list[Notice] = []
    used: set[str] = set()
    for path in tqdm(paths, desc="lint", unit="file", disable=not progress):
        try:
            opened = read_scene_file(Boundary(root), path)
            used |= set(opened.paths) - {path}
            warnings += opened.file.notices
            for imported in scenes_of_file(opened.file):
                assets = SceneAssets()
                assets.add([imported])
                scene, shapes, notices = AssetStore(assets).resolved(imported.scene)
                audit = audit_scene(scene, shapes)
                head = {"scene_id": scene.scene_id, "table_type": scene.table.table_type}
                rows.append({**head, **asdict(audit.card()), **audit.rows()})
                scenes.append(ComparedScene.of(scene))
                warnings += [*notices, *audit.notices]
        except StableDataError as error:
            failures.append(Notice(path, "read", error.code, str(error)))
        except Exception as error:  # noqa: BLE001 - an unexpected error loses one file, not the page
            message = f"{path}: {type(error).__name__}: {error}; please report this with the file"
            failures.append(Notice(path, "read", "unexpected", message))
    left = [n for n in failures if n.code != "no_free_body" and n.item_id not in used]
    if not rows and not left:
        others = ", or Layout_info/<table type>/<scene> as in the MesaTask-10K format"
        raise no_scene_error(root, len(paths), others)
    return LintResult(root, tuple(rows), tuple(left), tuple(warnings), tuple(scenes))
