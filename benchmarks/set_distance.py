"""Distances of sets of pictures: whether they see a change of the layouts, and how fast features and distances are.

``python -m benchmarks.set_distance DATASET [--scenes N] [--json FILE]``. The front views of the scenes, 299 x 299, are compared with
themselves in another order, and with the views of the same scenes whose objects are shifted by 1, 3 and 9 cm and turned by as many tenths
of a radian (standard deviations). The extractors are ``gradients`` and, if its weights were fetched, ``inception``.

Times are of the processor. Distances are timed on drawn features. pytorch-fid and torch-fidelity compute the same in the same run, if
``make consumers NAME=fid`` has made their environment. Run with ``OMP_NUM_THREADS=1``.
"""

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from itertools import islice, pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.audit import readable_scenes
from benchmarks.consumers.environment import FID_LIBRARIES
from models.picture_features import FeatureExtractor, Pictures, extractor_named
from pipelines.reports.text_table import align_columns
from stable_data.assets.store import AssetStore
from stable_data.feature_files import GRADIENTS, INCEPTION, fetch_command, inception_file
from stable_data.mesatask import MesaTaskDataset
from stable_data.scene import FloatArray, Scene
from stable_data.scores.set_distance import (
    FeatureStatistics,
    frechet_distance,
    kernel_distance,
    kernel_distance_at,
    vendi_score,
)
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.simulation.views import draw_view

_SHIFTS = (0.01, 0.03, 0.09)  # metres
_TURN = 10.0  # radians for a shift of one metre
_SIZE = (299, 299)
_DRAWS, _SEED = 5, 2020
_TIMED_PICTURES = 32


@dataclass(frozen=True, slots=True)
class FeatureFigures:
    """What one extractor says of the sets.

    Attributes:
        features: Its name.
        distance_name: What its Fréchet distance is called.
        same: Fréchet distance of the scenes and themselves in another order.
        shifted: Fréchet distance to the shifted scenes, by shift in metres.
        kernel_shifted: Likewise, the kernel distance.
        is_monotone: Whether both grow with the shift.
        vendi: Vendi score of the scenes.
        pictures_per_second: Speed of the features.
    """

    features: str
    distance_name: str
    same: float
    shifted: dict[float, float]
    kernel_shifted: dict[float, float]
    is_monotone: bool
    vendi: float
    pictures_per_second: float


@dataclass(frozen=True, slots=True)
class SpeedFigure:
    """The speed of one computation.

    Attributes:
        what: What is computed.
        by: Who computes it.
        seconds: Processor time.
        value: The result; None for features.
    """

    what: str
    by: str
    seconds: float
    value: float | None


def shifted(scene: Scene, shift: float) -> Scene:
    """Returns a scene whose objects are shifted on the table and turned; the same draw for all shifts, so that only its size differs."""
    noise = np.random.default_rng(len(scene.objects)).normal(0.0, 1.0, (len(scene.objects), 4))
    return scene.with_poses(scene.poses() + shift * noise * (1.0, 1.0, 0.0, _TURN))


def draw_sets(data: Path, num_scenes: int) -> tuple[dict[float, Pictures], float]:
    """Draws the scenes as they are (shift 0) and shifted, (N, H, W, 3) each; also gives the pictures a second."""
    dataset = MesaTaskDataset(data)
    store = AssetStore(dataset)
    sets: dict[float, list[Pictures]] = {shift: [] for shift in (0.0, *_SHIFTS)}
    seconds = 0.0
    for scene in islice(readable_scenes(dataset), num_scenes):
        for shift, pictures in sets.items():
            geometry = SceneGeometry.of(shifted(scene, shift), store)
            start = time.process_time()
            pictures.append(draw_view(geometry, "front", _SIZE))
            seconds += time.process_time() - start
    number = sum(map(len, sets.values()))
    return {shift: np.stack(pictures) for shift, pictures in sets.items()}, number / seconds


def measure(extractor: FeatureExtractor, sets: dict[float, Pictures]) -> FeatureFigures:
    """Measures one extractor."""
    extractor(sets[0.0][:1])  # the first call of a network is slower
    start = time.process_time()
    rows = {shift: extractor(pictures) for shift, pictures in sets.items()}
    seconds = time.process_time() - start
    own = FeatureStatistics.of(rows[0.0])
    mixed = FeatureStatistics.of(rows[0.0][np.random.default_rng(0).permutation(len(rows[0.0]))])
    frechet = {shift: frechet_distance(own, FeatureStatistics.of(rows[shift])) for shift in _SHIFTS}
    kernel = {shift: kernel_distance(rows[0.0], rows[shift]) for shift in _SHIFTS}
    grows = all(a < b for found in (frechet, kernel) for a, b in pairwise(found.values()))
    number = sum(map(len, sets.values()))
    same = frechet_distance(own, mixed)
    return FeatureFigures(
        extractor.name, extractor.distance_name, same, frechet, kernel, grows, vendi_score(rows[0.0]), number / seconds
    )


def drawn_features(number: int, width: int) -> tuple[FloatArray, FloatArray]:
    """Draws two sets of features that are a little apart; like those of a network, they are correlated and not negative."""
    random = np.random.default_rng(0)
    mixed = random.normal(size=(width, width)) / np.sqrt(width)
    first, second = (np.abs(random.normal(size=(number, width)) @ mixed) for _ in range(2))
    return first, second + 0.02


def time_distances(first: FloatArray, second: FloatArray) -> list[SpeedFigure]:
    """Times our distances, from the features on."""
    size = min(len(first), 1000)

    def frechet() -> float:
        return frechet_distance(FeatureStatistics.of(first), FeatureStatistics.of(second))

    computed: dict[str, Callable[[], float]] = {
        "FID": frechet,
        f"KID, {_DRAWS} subsets of {size}": lambda: kernel_distance_at(first, second, size, _DRAWS, _SEED).mean,
        "KID, whole sets": lambda: kernel_distance(first, second),
    }
    return [_timed(what, compute) for what, compute in computed.items()]


def _timed(what: str, compute: Callable[[], float]) -> SpeedFigure:
    start = time.process_time()
    value = compute()
    return SpeedFigure(what, "this project", time.process_time() - start, value)


def time_libraries(first: FloatArray, second: FloatArray, pictures: Pictures) -> list[SpeedFigure]:
    """Lets the libraries compute the same; the features of pictures only with the fetched weights."""
    import torch

    from models.picture_features.inception_weights import read_layers, state_dict_of_layers

    size = min(len(first), 1000)
    question: dict[str, Any] = {"distances": {"size": size, "draws": _DRAWS, "seed": _SEED}}
    with TemporaryDirectory() as place:
        folder = Path(place)
        np.savez(folder / "features.npz", first=first, second=second)
        if inception_file().is_file():
            question["pictures"] = True
            np.save(folder / "pictures.npy", pictures)
            torch.save(state_dict_of_layers(read_layers(inception_file())), folder / "weights.pth")
        (folder / "question.json").write_text(json.dumps(question), "utf-8")
        [answer] = FID_LIBRARIES.open([folder])
    if answer["error"] is not None:
        raise SystemExit(f"the libraries cannot be measured: {answer['error']}")
    kid = {"kid_subsets": f"KID, {_DRAWS} subsets of {size}", "kid_whole": "KID, whole sets"}
    figures = []
    for name, seconds in answer["distance_seconds"].items():
        value = answer["distances"][name]
        known = (
            (kid[name], "torch-fidelity", seconds, value[0]) if name in kid else ("FID", name.replace("_", "-"), seconds, value)
        )
        figures.append(SpeedFigure(*known))
    for name, seconds in answer.get("picture_seconds", {}).items():
        figures.append(SpeedFigure(f"features of {len(pictures)} pictures", name.replace("_", "-"), seconds, None))
    return figures


def main(
    dataset: Annotated[Path, typer.Argument(help="Folder in the MesaTask-10K format.")],
    scenes: Annotated[int, typer.Option(help="Largest number of scenes.")] = 60,
    samples: Annotated[int, typer.Option(help="Rows of the drawn features on which distances are timed.")] = 2500,
    width: Annotated[int, typer.Option(help="Numbers of each of them.")] = 2048,
    file: Annotated[Path | None, typer.Option("--json", help="File for the figures.")] = None,
) -> None:
    """Measures distances of sets of pictures."""
    sets, views_per_second = draw_sets(dataset, scenes)
    print(f"{len(sets[0.0])} scenes, front views of {_SIZE[0]} x {_SIZE[1]}: {views_per_second:.1f} pictures a second")
    extractors = [extractor_named(GRADIENTS)]
    if inception_file().is_file():
        extractors.append(extractor_named(INCEPTION))
    else:
        print(f"inception is not measured: {fetch_command()}")
    found = [measure(extractor, sets) for extractor in extractors]
    print(features_table(found))
    drawn = drawn_features(samples, width)
    pictures = np.concatenate(list(sets.values()))[:_TIMED_PICTURES]
    speed = [_features_speed(extractor, pictures) for extractor in extractors if extractor.name == INCEPTION] + time_distances(
        *drawn
    )
    if FID_LIBRARIES.is_there:
        speed += time_libraries(*drawn, pictures)
    else:
        print(FID_LIBRARIES.missing)
    print(f"\nOn {samples} drawn features of {width} numbers in each set:\n{speed_table(speed)}")
    if file is not None:
        content = {
            "views_per_second": views_per_second,
            "features": [asdict(f) for f in found],
            "speed": [asdict(s) for s in speed],
        }
        file.write_text(json.dumps(content, indent=1) + "\n", "utf-8")


def _features_speed(extractor: FeatureExtractor, pictures: Pictures) -> SpeedFigure:
    timed = _timed(f"features of {len(pictures)} pictures", lambda: float(len(extractor(pictures))))
    return replace(timed, value=None)


def features_table(figures: Iterable[FeatureFigures]) -> str:
    """Returns a table of what the extractors say of the sets."""
    rows = [["features", "distance", "same set", *(f"{100 * s:.0f} cm" for s in _SHIFTS), "grows", "Vendi", "pictures/s"]]
    for f in figures:
        values = [f"{f.shifted[s]:.4g}" for s in _SHIFTS]
        rows.append(
            [f.features, f.distance_name, f"{f.same:.4g}", *values, "", f"{f.vendi:.2f}", f"{f.pictures_per_second:.1f}"]
        )
        values = [f"{f.kernel_shifted[s]:.4g}" for s in _SHIFTS]
        rows.append(["", "kernel distance", "", *values, "yes" if f.is_monotone else "no", "", ""])
    return align_columns(rows, 2)


def speed_table(figures: Iterable[SpeedFigure]) -> str:
    """Returns a table of the speeds."""
    rows = [["", "by", "seconds", "value"]]
    rows += [
        [s.what, s.by, f"{s.seconds:.2f}", "" if s.value is None else f"{s.value:.6g}"]
        for s in sorted(figures, key=lambda s: s.what)
    ]
    return align_columns(rows, 2)


if __name__ == "__main__":
    typer.run(main)
