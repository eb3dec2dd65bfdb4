"""pytorch-fid and torch-fidelity compute distances of features, and features of pictures; see README.md."""

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytorch_fid.inception
import torch
from pytorch_fid.fid_score import calculate_frechet_distance
from torch_fidelity.feature_extractor_inceptionv3 import FeatureExtractorInceptionV3
from torch_fidelity.metric_fid import fid_features_to_statistics, fid_statistics_to_metric
from torch_fidelity.metric_kid import kid_features_to_metric

BATCH = 8  # pictures that a network sees at a time


def timed(compute: Callable[[], Any]) -> tuple[Any, float]:
    """A result, and the processor time of its computation, seconds."""
    start = time.process_time()
    return compute(), time.process_time() - start


def distances(
    first: np.ndarray, second: np.ndarray, size: int, draws: int, seed: int
) -> tuple[dict[str, Any], dict[str, float]]:
    """FID of both libraries and KID of torch-fidelity, the latter of subsets, and of whole sets of one size; and their seconds."""
    one, other = (torch.from_numpy(rows) for rows in (first, second))

    def by_pytorch_fid() -> float:
        means = [rows.mean(axis=0) for rows in (first, second)]
        covariances = [np.cov(rows, rowvar=False) for rows in (first, second)]
        return float(calculate_frechet_distance(means[0], covariances[0], means[1], covariances[1]))

    def by_torch_fidelity() -> float:
        statistics = [fid_features_to_statistics(rows) for rows in (one, other)]
        return float(fid_statistics_to_metric(*statistics, verbose=False)["frechet_inception_distance"])

    def kid(few: int, number: int) -> list[float]:
        found = kid_features_to_metric(one, other, kid_subsets=number, kid_subset_size=few, rng_seed=seed, verbose=False)
        return [found["kernel_inception_distance_mean"], found["kernel_inception_distance_std"]]

    questions: dict[str, Callable[[], Any]] = {"pytorch_fid": by_pytorch_fid, "torch_fidelity": by_torch_fidelity}
    questions["kid_subsets"] = partial(kid, size, draws)
    if len(first) == len(second):
        questions["kid_whole"] = partial(kid, len(first), 1)
    answers = {name: timed(question) for name, question in questions.items()}
    return {name: value for name, (value, _) in answers.items()}, {name: seconds for name, (_, seconds) in answers.items()}


def features(pictures: np.ndarray, weights: Path) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Features of pictures (N, H, W, 3) uint8 by the networks of both libraries, with weights of a state dict; and their seconds."""
    # pytorch-fid knows no other place of its weights than the address from which it downloads them.
    pytorch_fid.inception.load_state_dict_from_url = lambda *given, **named: torch.load(weights, weights_only=True)
    network = pytorch_fid.inception.InceptionV3().eval()
    channels_first = torch.from_numpy(pictures).permute(0, 3, 1, 2).contiguous()
    fidelity = FeatureExtractorInceptionV3("inception", ["2048"], feature_extractor_weights_path=str(weights))
    networks: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
        "pytorch_fid": lambda batch: network(batch.float() / 255)[0].flatten(1),
        "torch_fidelity": lambda batch: fidelity(batch)[0],
    }
    batches = [channels_first[k : k + BATCH] for k in range(0, len(channels_first), BATCH)]
    found, seconds = {}, {}
    with torch.no_grad():
        for name, compute in networks.items():
            compute(channels_first[:1])  # the first call of a network is slower
            rows, seconds[name] = timed(partial(lambda network: torch.cat([network(batch) for batch in batches]), compute))
            found[name] = rows.numpy()
    return found, seconds


def look(folder: Path) -> dict[str, object]:
    """Answers the questions of a folder."""
    torch.set_num_threads(1)
    answer: dict[str, object] = {"error": None}
    question = json.loads((folder / "question.json").read_text("utf-8"))
    if "distances" in question:
        with np.load(folder / "features.npz") as arrays:
            answer["distances"], answer["distance_seconds"] = distances(
                arrays["first"], arrays["second"], **question["distances"]
            )
    if question.get("pictures"):
        found, answer["picture_seconds"] = features(np.load(folder / "pictures.npy"), folder / "weights.pth")
        np.savez(folder / "answer.npz", allow_pickle=False, **found)
    return answer


request = json.load(sys.stdin)
for file in request["files"]:
    try:
        opened = look(Path(file))
    except Exception as error:  # noqa: BLE001 - the reason is the result
        opened = {"error": f"{type(error).__name__}: {error}"}
    print("SEEN", json.dumps(opened), flush=True)
