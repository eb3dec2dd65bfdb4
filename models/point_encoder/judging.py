"""What pre-trained codes know: errors on shapes and pairs that were never trained on, beside baselines, and their rank."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from models.point_encoder.corpus import TrainingShape
from models.point_encoder.heads import Pretraining
from models.point_encoder.questions import CLEARANCE_LIMIT, DISTANCE_LIMIT, questions

_BOX_TICKS = 9  # along each edge of a box


@torch.no_grad()
def evaluate(model: Pretraining, shapes: Sequence[TrainingShape], batch_size: int = 16, seed: int = 1) -> dict[str, float]:
    """Errors on shapes, always the same questions.

    Returns:
        ``distance_error``: mean error of the signed distance, share of the largest extent, and ``distance_error_of_mean`` of who
        always answers the mean; ``iou`` of inside and outside over the boxes; ``clearance_mm`` and ``overlap_accuracy`` of
        pairs, and of the two baselines: ``box_head_`` learned from boxes alone, ``box_`` the distance of the boxes itself;
        ``effective_rank`` of the codes, 64 at most.
    """
    model.eval()
    found: dict[str, list[Tensor]] = {}
    for start in range(0, len(shapes), batch_size):
        chosen = list(shapes[start : start + batch_size])
        num_queries = len(chosen[0].queries)
        x = questions(chosen, num_queries, min(4, max(1, len(chosen) - 1)), np.random.default_rng([seed, start])).to(
            model.encoder.device
        )
        codes, distances, clearances, of_boxes = model(x)
        inside, is_in_box = x.distances < 0, (x.places.abs() <= x.proportions.exp()[:, None] / 2).all(-1)
        answers = {
            "codes": codes,
            "distance": (distances - x.distances).abs().mean(1),
            "distances": x.distances.flatten(),
            "common": (inside & (distances < 0) & is_in_box).sum(1),
            "either": ((inside | (distances < 0)) & is_in_box).sum(1),
            "truth": x.clearances * x.units,
            "head": clearances.clamp(-1, 1) * x.units,
            "box_head": of_boxes.clamp(-1, 1) * x.units,
            "box": (box_clearance(x.boxes.exp(), x.poses) / CLEARANCE_LIMIT).clamp(-1, 1) * x.units,
        }
        for name, value in answers.items():
            found.setdefault(name, []).append(value)
    model.train()
    v = {name: torch.cat(parts).cpu() for name, parts in found.items()}
    extent = DISTANCE_LIMIT / 2  # of the largest extent
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


def box_clearance(boxes: Tensor, poses: Tensor) -> Tensor:
    """Smallest signed distance between samples of either of two upright boxes and the other, (R,), as pairs are labelled.

    Args:
        boxes: Sides of both, (R, 6).
        poses: Of the second in the frame of the first: offset, cosine and sine of its yaw, (R, 5).
    """
    ticks = torch.linspace(-1, 1, _BOX_TICKS, device=boxes.device)
    grid = torch.cartesian_prod(ticks, ticks, ticks)
    surface = grid[grid.abs().amax(1) == 1]  # (P, 3)
    first, second = (boxes[:, None, k : k + 3] / 2 for k in (0, 3))
    offset, (c, s) = poses[:, None, :3], (poses[:, 3, None], poses[:, 4, None])
    theirs, ours = second * surface, first * surface - offset
    to_first = _box_distance(_turned(theirs, c, s) + offset, first)
    to_second = _box_distance(_turned(ours, c, -s), second)
    return torch.minimum(to_first.amin(1), to_second.amin(1))


def effective_rank(codes: Tensor) -> float:
    """How many dimensions codes (B, C) use: the exponential of the entropy of their covariance's spectrum (Roy and Vetterli)."""
    variance = torch.linalg.svdvals((codes - codes.mean(0)).double()).square()
    share = variance / variance.sum()
    return float(torch.exp(-(share * share.clamp(min=1e-30).log()).sum()))


def _turned(points: Tensor, c: Tensor, s: Tensor) -> Tensor:
    x, y, z = points.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=-1)


def _box_distance(points: Tensor, half: Tensor) -> Tensor:
    beyond = points.abs() - half
    return beyond.clamp(min=0).square().sum(-1).sqrt() + beyond.amax(-1).clamp(max=0)
