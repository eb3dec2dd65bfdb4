"""Evaluation of pre-trained codes: errors on held-out shapes and pairs, errors of baselines, and the effective rank."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from models.point_encoder.heads import PretrainingModel
from models.point_encoder.pretraining_data import TrainingShape
from models.point_encoder.pretraining_targets import CLEARANCE_LIMIT, DISTANCE_LIMIT, draw_targets


@torch.no_grad()
def evaluate(model: PretrainingModel, shapes: Sequence[TrainingShape], batch_size: int = 16, seed: int = 1) -> dict[str, float]:
    """Computes errors on shapes, with the same queries and pairs at every call.

    Returns:
        ``distance_error``, the mean error of the signed distance as a share of the largest extent, and
        ``distance_error_of_mean``, the error of the constant mean; ``iou`` of the insides within the boxes; ``clearance_mm`` and
        ``overlap_accuracy`` of pairs, also of two baselines: ``box_head_``, learned from boxes alone, and ``box_``, the distance
        of the boxes; ``effective_rank`` of the codes, at most 64.
    """
    model.eval()
    found: dict[str, list[Tensor]] = {}
    for start in range(0, len(shapes), batch_size):
        chosen = list(shapes[start : start + batch_size])
        num_queries = len(chosen[0].queries)
        x = draw_targets(chosen, num_queries, min(4, max(1, len(chosen) - 1)), np.random.default_rng([seed, start])).to(
            model.encoder.device
        )
        codes, distances, clearances, of_boxes = model(x)
        inside, is_in_box = x.distances < 0, (x.places.abs() <= x.proportions.exp()[:, None] / 2).all(-1)
        values = {
            "codes": codes,
            "distance": (distances - x.distances).abs().mean(1),
            "distances": x.distances.flatten(),
            "common": (inside & (distances < 0) & is_in_box).sum(1),
            "either": ((inside | (distances < 0)) & is_in_box).sum(1),
            "truth": x.clearances * x.units,
            "head": clearances.clamp(-1, 1) * x.units,
            "box_head": of_boxes.clamp(-1, 1) * x.units,
            "box": x.box_clearances * x.units,
        }
        for name, value in values.items():
            found.setdefault(name, []).append(value)
    model.train()
    v = {name: torch.cat(parts).cpu() for name, parts in found.items()}
    extent = DISTANCE_LIMIT / 2  # distances are in half the largest extent, errors in the whole
    result = {
        "distance_error": extent * float(v["distance"].mean()),
        "distance_error_of_mean": extent * float((v["distances"] - v["distances"].mean()).abs().mean()),
        "iou": float((v["common"] / v["either"].clamp(min=1)).mean()),
        "effective_rank": effective_rank(v["codes"]),
        "num_pairs": len(v["truth"]),
    }
    for name, prefix in (("head", ""), ("box_head", "box_head_"), ("box", "box_")):
        result[f"{prefix}clearance_mm"] = 1000 * CLEARANCE_LIMIT * float((v[name] - v["truth"]).abs().mean())
        result[f"{prefix}overlap_accuracy"] = float(((v[name] < 0) == (v["truth"] < 0)).float().mean())
    return result


def effective_rank(codes: Tensor) -> float:
    """The effective rank of codes (B, C): the exponential of the entropy of their covariance's spectrum (Roy and Vetterli)."""
    variance = torch.linalg.svdvals((codes - codes.mean(0)).double()).square()
    share = variance / variance.sum()
    return float(torch.exp(-(share * share.clamp(min=1e-30).log()).sum()))
