"""The import of assets: the speed of each step, and how well scales are estimated where they are hidden.

``python -m benchmarks.asset_import DATA [--samples DIR] [--limit N] [--json FILE]``, with DATA a dataset in the MesaTask-10K format,
and ``--samples`` a folder with the source folders ``gazebo`` (models with a true scale, in SDFormat) and ``gltf_kit`` (a kit without
a unit).

- Speed: assets are read and converted without decomposition; seconds of each step, and assets a minute.
- Hidden scales: the true unit of each asset is withheld, and all rows of the table of sizes that were measured on these sets are left
  out. An estimate is right within a factor of 1.5. For DATA this needs a ``truth.json`` that says by how much each object was scaled.
- The kit: the longest side that each of its things gets.

Times are processor seconds of this process.
"""

import json
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from models.text_encoder import load_default
from pipelines.reports.text_table import align_columns
from stable_data.errors import MeshError, Notice
from stable_data.geometry.gltf_reader import load_surfaces
from stable_data.importers.boundary import Boundary
from stable_data.importers.conversion import ConversionContext, ConversionSettings, SetScale, convert, extents_of
from stable_data.importers.conversion.scaling import choose_scale
from stable_data.importers.readers import reader_of
from stable_data.importers.source import ReaderOptions, SourceAsset

_RIGHT = math.log(1.5)
_MEASURED_ON = ("YCB", "AWS")  # sources of sizes that are the sets of the study
_KIT = ReaderOptions(preset="kaykit")
_SETS = {"kk_": "KayKit", "ycb_": "YCB", "aws_": "AWS RoboMaker"}
_WORST = 10


@dataclass(slots=True)
class StepTimer:
    """Receives the names of steps and adds up their processor seconds.

    Attributes:
        seconds: Step -> seconds.
    """

    seconds: defaultdict[str, float] = field(default_factory=lambda: defaultdict(float))
    _step: str = "read"
    _since: float = field(default_factory=time.process_time)

    @property
    def step(self) -> str:
        """The step that runs."""
        return self._step

    @step.setter
    def step(self, name: str) -> None:
        now = time.process_time()
        self.seconds[self._step] += now - self._since
        self._step, self._since = name, now


@dataclass(frozen=True, slots=True)
class HiddenScale:
    """An estimate of a scale that was withheld.

    Attributes:
        name: The asset.
        category: Its category.
        ratio: Estimated unit divided by the true one.
        confidence: Estimated probability that it is right within a factor of 1.5.
    """

    name: str
    category: str
    ratio: float
    confidence: float

    @property
    def is_right(self) -> bool:
        """Whether it is within a factor of 1.5."""
        return abs(math.log(self.ratio)) <= _RIGHT


@dataclass(frozen=True, slots=True)
class ScaleStudy:
    """The estimates of a set of assets.

    Attributes:
        what: What was measured.
        num: Assets.
        found: Estimates; an asset without one counts as wrong.
    """

    what: str
    num: int
    found: tuple[HiddenScale, ...]

    @property
    def share(self) -> float:
        """Share of all assets whose estimate is right."""
        return sum(each.is_right for each in self.found) / self.num

    @property
    def worst(self) -> list[HiddenScale]:
        """The ten worst estimates."""
        return sorted(self.found, key=lambda each: -abs(math.log(each.ratio)))[:_WORST]


def read_folder(folder: Path, kind: str, options: ReaderOptions) -> Iterator[SourceAsset]:
    """Reads all assets of a source folder."""
    reader = reader_of(kind)
    for ref in reader.find(Boundary(folder), options):
        if not isinstance(ref, Notice):
            yield reader.read(Boundary(folder), ref, options)


def measure_speed(
    assets: Iterator[SourceAsset], common: SetScale | None, context: ConversionContext
) -> tuple[int, dict[str, float]]:
    """Converts assets, which are read meanwhile; returns their number and the seconds of each step."""
    settings, timer, num = ConversionSettings(licence="CC0", decomposes=False, set_scale=common), StepTimer(), 0
    for asset in assets:
        try:
            convert(asset, settings, context, timer)
        except MeshError as error:
            print(error)
        num += 1
        timer.step = "read"
    return num, dict(timer.seconds)


def common_scale(assets: Sequence[SourceAsset], context: ConversionContext) -> SetScale | None:
    """The common unit of those assets whose files state none."""
    return context.set_scale([(a, extents_of(a.surfaces)) for a in assets if a.unit_m is None and a.size_m is None])


def library_assets(data: Path, limit: int | None) -> Iterator[SourceAsset]:
    """Reads the assets of a dataset, without a unit."""
    annotations: dict[str, Any] = json.loads((data / "Asset_annotation.json").read_text("utf-8"))
    for path in sorted((data / "Assets_library").glob("*.glb"))[:limit]:
        note = annotations.get(path.stem, {})
        try:
            surfaces = tuple(load_surfaces(path, path.stem))
        except MeshError as error:
            print(error)
            continue
        yield SourceAsset(
            path.stem, path.stem, surfaces, category=note.get("category", ""), description=note.get("description", "")
        )


def mesa_assets(data: Path) -> Iterator[tuple[SourceAsset, float]]:
    """Reads the assets of a dataset whose scenes say how large they truly are, with the true metres of a mesh unit."""
    truth: dict[str, Any] = json.loads((data / "truth.json").read_text("utf-8"))
    annotations: dict[str, Any] = json.loads((data / "Asset_annotation.json").read_text("utf-8"))
    units: dict[str, list[float]] = defaultdict(list)
    names: dict[str, str] = {}
    for scene_id, scene in sorted(truth.items()):
        layout = json.loads((data / "Layout_info" / scene["type"] / scene_id / "layout.json").read_text("utf-8"))
        scales = {o["instance"]: o["scale_factor"] for o in layout["objects"]}
        for instance, o in scene["objects"].items():
            if not o["non_uniform"] and instance in scales:
                units[o["uid"]].append(float(np.median(scales[instance])) / 100 / o["uniform_scale_jitter"])
                names[o["uid"]] = o["asset_id"]
    for uid, found in sorted(units.items(), key=lambda each: names[each[0]]):
        note = annotations[uid]
        surfaces = tuple(load_surfaces(data / "Assets_library" / f"{uid}.glb", uid))
        yield SourceAsset(names[uid], names[uid], surfaces, category=note["category"]), float(np.median(found))


def study(
    what: str,
    assets: Sequence[tuple[SourceAsset, float]],
    context: ConversionContext,
    *,
    common: bool = False,
    is_normalised: bool = False,
) -> ScaleStudy:
    """Estimates scales that are withheld.

    Args:
        what: What is measured.
        assets: Assets with their true units.
        context: Its table of sizes leaves out what was measured on the assets.
        common: Whether the assets are taken as one folder, whose unit counts as the import chooses; else each counts alone.
        is_normalised: Whether each file has a unit of its own, in which the longest side is 1; else all are in metres.
    """
    found, boxes = [], []
    for asset, unit in assets:
        box = np.multiply(extents_of(asset.surfaces), unit)
        boxes.append((asset, box, 1 / float(box.max()) if is_normalised else 1.0))
    shared = context.set_scale([(asset, (box * factor).tolist()) for asset, box, factor in boxes]) if common else None
    for asset, box, factor in boxes:
        category = context.vocabulary.name(asset).category
        hidden = replace(asset, unit_m=None, size_m=None)
        try:
            estimate = choose_scale(hidden, category, box * factor, context.sizes, set_scale=shared)
        except MeshError:  # no size of its category is known
            continue
        if estimate.confidence is not None:
            found.append(HiddenScale(asset.name, category, estimate.unit_m * factor, estimate.confidence))
    return ScaleStudy(what, len(assets), tuple(found))


def studies(data: Path, samples: Path | None, context: ConversionContext) -> Iterator[ScaleStudy]:
    """The studies of hidden scales that the data allow."""
    if samples is not None:
        models = list(read_folder(samples / "gazebo", "sdformat", ReaderOptions()))
        yield study("Gazebo models, each alone", [(replace(a, unit_m=None), a.unit_m or 1.0) for a in models], context)
    if (data / "truth.json").is_file():
        found = list(mesa_assets(data))
        yield study("dataset, each alone", found, context)
        yield study("of which all, in one folder, each normalised", found, context, common=True, is_normalised=True)
        for prefix, name in _SETS.items():
            own = [each for each in found if each[0].name.startswith(prefix)]
            if own:
                yield study(f"of which {name}, each alone", own, context)
                yield study(f"of which {name}, as a set", own, context, common=True)


def main(
    data: Annotated[Path, typer.Argument(help="dataset in the MesaTask-10K format")],
    samples: Annotated[Path | None, typer.Option(help="folder with the source folders gazebo and gltf_kit")] = None,
    limit: Annotated[int | None, typer.Option(help="largest number of assets of the dataset whose conversion is timed")] = None,
    output: Annotated[Path | None, typer.Option("--json", help="file of the figures")] = None,
) -> None:
    """Measures the import of assets."""
    context = ConversionContext(load_default())
    hidden = ConversionContext(context.encoder, without_sizes_of=_MEASURED_ON)
    for each in (context, hidden):  # encodes the known categories, which a worker does once
        each.vocabulary.nearest("a thing")
        each.sizes.infer_scale("a thing", (1.0, 1.0, 1.0))
    speed = {data.name: measure_speed(library_assets(data, limit), None, context)}
    kit: list[SourceAsset] = []
    if samples is not None:
        kit = list(read_folder(samples / "gltf_kit", "mesh", _KIT))
        speed["gazebo"] = measure_speed(read_folder(samples / "gazebo", "sdformat", ReaderOptions()), None, context)
        speed["gltf_kit"] = measure_speed(read_folder(samples / "gltf_kit", "mesh", _KIT), common_scale(kit, context), context)
    for folder, (num, seconds) in speed.items():
        total = sum(seconds.values())
        print(f"\n{folder}: {num} assets, {60 * num / total:.0f} a minute and core")
        print(align_columns([("step", "seconds an asset"), *((k, f"{v / num:.3f}") for k, v in sorted(seconds.items()))], 1))
    found = list(studies(data, samples, hidden))
    print_studies(found)
    sizes = kit_sizes(kit, context)
    if sizes:
        print("\nlongest sides of the kit, cm")
        print(align_columns([(name, category, f"{100 * size:.1f}") for name, category, size in sizes], 2))
    if output is not None:
        figures = {"speed": speed, "hidden": [asdict(each) | {"share": each.share} for each in found], "kit": sizes}
        output.write_text(json.dumps(figures, indent=2) + "\n", "utf-8")


def print_studies(found: Sequence[ScaleStudy]) -> None:
    """Prints shares, and the worst estimates of those studies that are no part of another."""
    if not found:
        return
    rows = [("hidden scales", "assets", "estimated", "within 1.5", "mean confidence")]
    for each in found:
        mean = f"{np.mean([e.confidence for e in each.found]):.0%}" if each.found else ""
        rows.append((each.what, str(each.num), str(len(each.found)), f"{each.share:.0%}", mean))
    print("\n" + align_columns(rows, 1))
    for each in found:
        if not each.what.startswith("of which"):
            print(f"\nworst of: {each.what} (estimate divided by truth, confidence)")
            print(align_columns([(e.name, e.category, f"{e.ratio:.2f}", f"{e.confidence:.0%}") for e in each.worst], 2))


def kit_sizes(kit: Sequence[SourceAsset], context: ConversionContext) -> list[tuple[str, str, float]]:
    """Name, category and longest side, metres, of each thing of a kit without a unit."""
    settings = ConversionSettings(decomposes=False, finds_poses=False, num_points=16, set_scale=common_scale(kit, context))
    found = []
    for asset in kit:
        row = convert(asset, settings, context, StepTimer()).asset_row
        found.append((asset.name, str(row["category"]), max(row["extents"])))
    return found


if __name__ == "__main__":
    typer.run(main)
