"""Compares two folders of pictures: ``python -m models.picture_features FIRST SECOND [--features NAME]``."""

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from models.picture_features.extractor import FeatureExtractor, Rows
from models.picture_features.picture_folder import picture_files, read_pictures
from models.picture_features.registry import default_name, extractor_named
from stable_data.commands.command_line import echo, with_clear_errors
from stable_data.scores.set_distance import (
    DrawnValue,
    FeatureStatistics,
    frechet_distance,
    kernel_distance,
    kernel_distance_at,
    vendi_at,
)

_KID_SIZE = 1000  # samples of a subset, as usual for KID


def compare(extractor: FeatureExtractor, first: Rows, second: Rows, size: int, draws: int, seed: int) -> dict[str, Any]:
    """Compares two sets of features, (N, D) each.

    Args:
        extractor: What computed them.
        first: The one set.
        second: The other set.
        size: Samples of a subset; 0: 1000, or all of the smaller set.
        draws: Number of subsets.
        seed: Seed of the draws.

    Returns:
        The figures by name; values over draws are mean and deviation.

    Raises:
        ConfigError: A set is too small, see :mod:`stable_data.scores.set_distance`.
    """
    chosen = size or min(len(first), len(second), _KID_SIZE)
    return {
        "features": extractor.name,
        "fingerprint": extractor.fingerprint,
        "counts": [len(first), len(second)],
        extractor.distance_name: frechet_distance(FeatureStatistics.of(first), FeatureStatistics.of(second)),
        extractor.kernel_distance_name: kernel_distance(first, second),
        "subsets": {"size": chosen, "draws": draws, "seed": seed},
        f"{extractor.kernel_distance_name}, subsets": _pair(kernel_distance_at(first, second, chosen, draws, seed)),
        "Vendi score, first": _pair(vendi_at(first, chosen, draws, seed)),
        "Vendi score, second": _pair(vendi_at(second, chosen, draws, seed)),
    }


def _pair(value: DrawnValue) -> tuple[float, float | None]:
    return value.mean, value.deviation


@with_clear_errors
def main(
    first: Annotated[Path, typer.Argument(metavar="FIRST", help="A folder of pictures.")],
    second: Annotated[Path, typer.Argument(metavar="SECOND", help="Another one.")],
    features: Annotated[str, typer.Option(help="inception, inception:FILE, transformers:FOLDER or gradients.")] = "",
    name: Annotated[str, typer.Option(help="Use only files of this name, such as front.png.")] = "",
    size: Annotated[int, typer.Option(help="Pictures of a subset; 0: 1000, or all of the smaller set.")] = 0,
    draws: Annotated[int, typer.Option(help="Number of subsets.")] = 100,
    seed: Annotated[int, typer.Option(help="Seed of the draws.")] = 2020,
    device: Annotated[str, typer.Option(help="Torch device of a network.")] = "cpu",
) -> None:
    """Prints the Fréchet and the kernel distance of two sets of pictures, and the diversity of each, as JSON."""
    extractor = extractor_named(features or default_name(), device)
    rows = [np.concatenate([extractor(p) for p in read_pictures(picture_files(place, name))]) for place in (first, second)]
    echo(json.dumps(compare(extractor, rows[0], rows[1], size, draws, seed), indent=1))


if __name__ == "__main__":
    typer.run(main)
