"""Opens scenes of a run in the programs of others: ``python -m benchmarks.consumers RUN [--consumer NAME] [--scenes N]``.

Prints, for each consumer, how many scenes it opened, in how many it saw something else than the scene says, and in how many
everything stayed where it was for two seconds; and the time and the size of each export. Consumers of episodes open the episodes
of the run, if it has any.
"""

import argparse
import json
from collections import Counter
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from benchmarks.consumers.comparison import differences, expected, stays
from benchmarks.consumers.environment import CONSUMERS, Consumer
from stable_data.export.formats import ExportFormat, format_named
from stable_data.robot.lerobot.dataset_writer import EpisodeSelection, write_lerobot
from stable_data.scene import Scene
from stable_data.simulation.run_reader import RunScenes, SceneSelection
from stable_data.storage.run_folder import RunFolder

LEROBOT = "lerobot"
"""The format of consumers of episodes; the others open scenes."""

_SHOWN = 5  # scenes with differences that are printed


def export_episodes(run: RunFolder, out: Path, *, is_video: bool = False) -> float:
    """Exports the episodes of a local run for a program that compares them, and returns the rate, episodes a second.

    Args:
        run: The run.
        out: Folder for ``dataset``, the export, and ``run``, a link to the run.
        is_video: Whether pictures become videos.
    """
    (out / "run").symlink_to(run.root)
    start = perf_counter()
    result = write_lerobot(run, out / "dataset", EpisodeSelection(with_failures=True), is_video=is_video)
    return result.num_episodes / (perf_counter() - start)


def export_scenes(scenes: list[Scene], source: RunScenes, chosen: ExportFormat, out: Path) -> dict[str, float]:
    """Exports scenes twice, the second time beside their assets, and returns the rates, scenes a second, and the size of a scene."""
    rates = []
    for _ in range(2):
        start = perf_counter()
        for scene in scenes:
            chosen.scene_path(scene, out).unlink(missing_ok=True)
            chosen.export_scene(source.geometry(scene), out)
        rates.append(len(scenes) / (perf_counter() - start))
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) / len(scenes)
    return {"scenes_per_second_first": rates[0], "scenes_per_second_again": rates[1], "bytes_per_scene": size}


def open_scenes(consumer: Consumer, scenes: list[Scene], source: RunScenes, out: Path, seconds: float) -> dict[str, Any]:
    """Opens exported scenes in a consumer and compares what it saw."""
    chosen = format_named(consumer.format_name)
    start = perf_counter()
    seen = consumer.open([chosen.scene_path(scene, out) for scene in scenes], seconds if consumer.engine else 0.0)
    elapsed = perf_counter() - start
    found = {}
    for scene, saw in zip(scenes, seen, strict=True):
        bodies = expected(source.geometry(scene), consumer.format_name)
        if consumer.format_name == "usd" and saw["error"] is None:  # its engines make fixed bodies shapes of the world
            bodies = {name: body for name, body in bodies.items() if not body.is_fixed or name in saw["bodies"]}
        if lines := differences(bodies, saw):
            found[scene.scene_id] = lines
    stayed = [stays(expected(source.geometry(s), consumer.format_name), saw) for s, saw in zip(scenes, seen, strict=True)]
    rest = Counter(stayed) if consumer.engine else Counter[bool | None]()
    return {
        "scenes": len(scenes),
        "opened": sum(saw["error"] is None for saw in seen),
        "different": found,
        "at_rest": rest[True],
        "not_at_rest": rest[False],
        "unknown": rest[None],
        "restless": [s.scene_id for s, is_still in zip(scenes, stayed, strict=True) if consumer.engine and is_still is False],
        "seconds_per_scene": elapsed / len(scenes),
    }


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", help="a run with scenes, assets and meshes")
    parser.add_argument("--consumer", action="append", choices=sorted(CONSUMERS), help="only this one; may be repeated")
    parser.add_argument("--scenes", type=int, help="at most this many")
    parser.add_argument("--where", help="condition on the scenes")
    parser.add_argument("--seconds", type=float, default=2.0, help="simulated time")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    given = parser.parse_args()
    run = RunFolder(given.run)
    chosen = [c for name, c in CONSUMERS.items() if name in (given.consumer or CONSUMERS)]
    figures: dict[str, Any] = {"formats": {}, "consumers": {}}
    for consumer in (c for c in chosen if c.format_name == LEROBOT):
        figures["consumers"][consumer.name] = _tell_of_episodes(consumer, run)
    chosen = [c for c in chosen if c.format_name != LEROBOT]
    if chosen:
        _tell_of_scenes(chosen, run, given, figures)
    if given.json:
        given.json.write_text(json.dumps(figures, indent=1))


def _tell_of_scenes(chosen: list[Consumer], run: RunFolder, given: argparse.Namespace, figures: dict[str, Any]) -> None:
    source = RunScenes(run, SceneSelection(where=given.where, limit=given.scenes))
    scenes = list(source)
    with TemporaryDirectory() as folder:
        for name in dict.fromkeys(c.format_name for c in chosen):
            out = Path(folder) / name.replace(":", "_")
            out.mkdir()
            figures["formats"][name] = rates = export_scenes(scenes, source, format_named(name), out)
            print(
                f"{name}: {rates['scenes_per_second_first']:.1f} scenes a second, {rates['scenes_per_second_again']:.1f} beside their "
                f"assets, {rates['bytes_per_scene'] / 1000:.0f} kB a scene",
                flush=True,
            )
            for consumer in chosen:
                if consumer.format_name == name:
                    figures["consumers"][consumer.name] = _tell(consumer, scenes, source, out, given.seconds)


def _tell(consumer: Consumer, scenes: list[Scene], source: RunScenes, out: Path, seconds: float) -> dict[str, Any] | None:
    if not consumer.is_there:
        print(f"  {consumer.missing}")
        return None
    if consumer.judges:
        return _judge(consumer, out)
    seen = open_scenes(consumer, scenes, source, out, seconds)
    rest = f", {seen['at_rest']} at rest, {seen['not_at_rest']} not, {seen['unknown']} unknown" if consumer.engine else ""
    print(
        f"  {consumer.name}: {seen['opened']} of {seen['scenes']} opened, {len(seen['different'])} different{rest}; "
        f"{seen['seconds_per_scene']:.2f} s a scene",
        flush=True,
    )
    for name, lines in list(seen["different"].items())[:_SHOWN]:
        print(f"    {name}: {'; '.join(lines[:3])}")
    return seen


def _tell_of_episodes(consumer: Consumer, run: RunFolder) -> dict[str, Any] | None:
    if not run.files("episodes") or not consumer.is_there:
        print(f"{consumer.name}: the run has no episodes" if consumer.is_there else consumer.missing)
        return None
    with TemporaryDirectory() as folder:
        rate = export_episodes(run, Path(folder))
        [seen] = consumer.open([Path(folder)])
    print(f"{consumer.name}: {rate:.1f} episodes a second; {seen['error'] or seen}", flush=True)
    return {"episodes_per_second": rate, "seen": seen}


def _judge(consumer: Consumer, out: Path) -> dict[str, Any]:
    """Passes the assets of an export to a validator, and the scenes to one that is for any file."""
    files = sorted(out.glob("props/*/usd/*.usd"))
    if consumer.format_name == "sdformat":
        files = sorted(out.glob("worlds/*.sdf")) + sorted(out.glob("models/*/model.sdf"))
    if consumer.name == "nvidia_usd":
        files += sorted(out.glob("scenes/*.usda")) + sorted(out.glob("furniture/*.usd"))
    seen = consumer.open(files)
    bad = {file.name: saw for file, saw in zip(files, seen, strict=True) if saw["error"] is not None or saw["problems"]}
    print(f"  {consumer.name}: {len(files)} files, {len(bad)} with errors", flush=True)
    for name, saw in list(bad.items())[:_SHOWN]:
        print(f"    {name}: {saw['error'] or saw['problems'][0]}")
    return {"files": len(files), "bad": bad}


if __name__ == "__main__":
    main()
