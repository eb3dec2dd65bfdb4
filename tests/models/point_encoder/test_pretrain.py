from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from models.point_encoder import checkpoint
from models.point_encoder.boxes import box_clearance
from models.point_encoder.cloud import PointCloud, Preprocessing
from models.point_encoder.evaluation import effective_rank
from models.point_encoder.heads import ClearanceHead, PretrainingModel, spread_loss
from models.point_encoder.pretrain import CONFIGS, ENCODER, STATE, PretrainSettings, pretrain
from models.point_encoder.pretraining_data import PosedShape, ShapePair, TrainingShape, pretraining_corpus, training_shape
from models.point_encoder.pretraining_targets import draw_targets
from stable_data.embedded_world.families.catalogue import KEYS
from stable_data.errors import ConfigError
from stable_data.geometry.mesh import Mesh
from stable_data.geometry.shape import Shape
from tests.models.point_encoder.clouds import TINY


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> PretrainSettings:
    monkeypatch.setitem(CONFIGS, "tiny", replace(TINY, enc_mode=True))
    return PretrainSettings(
        config="tiny",
        steps=6,
        batch_size=4,
        pairs_a_shape=1,
        queries_a_shape=64,
        num_categories=1,
        num_copies=1,
        num_queries=128,
    )


def test_labels_are_exact_signed_distances_and_stay_so_when_turned(rng: np.random.Generator) -> None:
    shape = training_shape(KEYS[0], 1, 128, 256)
    assert np.allclose(shape.signed_distance(shape.queries), shape.distances)
    assert (shape.distances < 0).any()
    posed = PosedShape.sample(shape, rng)
    assert np.allclose(posed.distances(posed.transform(shape.queries)), shape.distances, atol=1e-9)
    assert np.abs(posed.distances(posed.cloud.points.astype(np.float64))).max() < 1e-5


def test_a_turned_cloud_fills_its_box_and_keeps_outward_normals(rng: np.random.Generator) -> None:
    posed = PosedShape.sample(training_shape(KEYS[0], 0, 512, 64), rng)
    cloud = posed.cloud
    assert (np.abs(cloud.points) <= cloud.size / 2 + 1e-6).all()
    assert (np.ptp(cloud.points, axis=0) > 0.8 * cloud.size).all()
    outwards = posed.distances(cloud.points.astype(np.float64) + 2e-4 * cloud.normals)
    assert (outwards > 0).mean() > 0.95


def test_a_pair_is_asked_in_the_frame_of_its_first(rng: np.random.Generator) -> None:
    """Two objects that are far apart: the clearance is nearly that of the centres."""
    shapes = [training_shape(key, 0, 128, 64) for key in KEYS[:2]]
    first, second = (PosedShape.sample(shape, rng) for shape in shapes)
    pairs = [ShapePair.sample(first, second, rng) for _ in range(40)]
    reach = [max(s.cloud.size) for s in shapes]
    assert all(np.linalg.norm(p.offset) - sum(reach) < p.clearance < np.linalg.norm(p.offset) for p in pairs)
    assert 0.1 < np.mean([p.clearance < 0 for p in pairs]) < 0.9


def test_assets_held_out_are_never_trained_on() -> None:
    shapes, held_out = pretraining_corpus(3, 2, 32, 32)
    trained = {s.key.partition("#")[0] for s in shapes}
    assert (len(shapes), len(held_out)) == (30, 3)
    assert not trained & {s.key.partition("#")[0] for s in held_out}


def test_the_distance_of_boxes_is_right_where_it_is_plain() -> None:
    boxes = torch.tensor([[2.0, 2.0, 2.0, 2.0, 2.0, 2.0]] * 3)
    poses = torch.tensor([[3.0, 0.0, 0.0, 1.0, 0.0], [3.0, 0.0, 0.0, 0.0, 1.0], [1.5, 0.0, 0.0, 1.0, 0.0]])
    assert torch.allclose(box_clearance(boxes, poses), torch.tensor([1.0, 1.0, -0.5]), atol=1e-6)


def test_the_clearance_of_boxes_is_the_distance_of_boxes(rng: np.random.Generator) -> None:
    def boxed(size: tuple[float, float, float]) -> TrainingShape:
        shape = Shape.box(size)
        mesh = Mesh(shape.vertices, shape.faces)
        return TrainingShape("box", PointCloud.of_shape(shape, 1024), shape.footprint, mesh, np.zeros((1, 3)), np.zeros(1))

    first, second = (PosedShape(boxed(size), np.eye(3)) for size in ((0.2, 0.1, 0.1), (0.1, 0.1, 0.3)))
    boxes = torch.from_numpy(np.concatenate([first.cloud.size, second.cloud.size])).float()[None]
    for _ in range(20):
        pair = ShapePair.sample(first, second, rng)
        pose = torch.tensor([[*pair.offset, np.cos(pair.yaw), np.sin(pair.yaw)]], dtype=torch.float32)
        assert float(box_clearance(boxes, pose)) == pytest.approx(pair.clearance, abs=0.01)


def test_the_effective_rank_counts_even_directions() -> None:
    codes = torch.zeros(40, 64)
    codes[torch.arange(40), torch.arange(40) % 5] = 1.0
    assert effective_rank(codes) == pytest.approx(4, abs=0.01)  # five corners of a simplex


@pytest.mark.slow
def test_pretraining_lowers_its_loss_and_leaves_an_encoder(tmp_path: Path, small: PretrainSettings) -> None:
    report = pretrain(tmp_path, replace(small, steps=40, learning_rate=3e-3))
    losses = np.array([step["distance"] for step in report["losses"]])
    assert losses[-10:].mean() < 0.9 * losses[:5].mean()
    assert checkpoint.load(tmp_path / ENCODER).fingerprint() == report["fingerprint"]
    assert {"distance_error", "iou", "effective_rank", "clearance_mm", "box_head_clearance_mm", "box_clearance_mm"} <= set(
        report
    )


def test_a_run_that_was_stopped_ends_as_one_that_was_not(tmp_path: Path, small: PretrainSettings) -> None:
    whole = pretrain(tmp_path / "whole", small)
    parts = [pretrain(tmp_path / "parts", small, stop_after=n) for n in (2, 5, None)]
    assert "fingerprint" not in parts[0]
    assert parts[-1]["fingerprint"] == whole["fingerprint"]
    assert parts[-1]["losses"] == whole["losses"]


def test_a_run_of_other_settings_is_not_resumed(tmp_path: Path, small: PretrainSettings) -> None:
    pretrain(tmp_path, small, stop_after=1)
    with pytest.raises(ConfigError, match="seed: 0 -> 3"):
        pretrain(tmp_path, replace(small, seed=3))
    assert (tmp_path / STATE).exists()


def test_minutes_are_turned_into_steps(tmp_path: Path, small: PretrainSettings) -> None:
    report = pretrain(tmp_path, replace(small, steps=0), minutes=0.02)
    assert report["settings"]["steps"] == report["steps"] >= 1
    with pytest.raises(ConfigError, match="neither steps nor minutes"):
        pretrain(tmp_path / "other", replace(small, steps=0))


def test_the_smallest_distance_is_the_same_when_few_points_are_asked(rng: np.random.Generator) -> None:
    first, second = (PosedShape.sample(training_shape(key, 0, 512, 64), rng) for key in (KEYS[0], KEYS[-1]))
    points = second.cloud.points.astype(np.float64)
    for shift in ((0.0, 0.0, 0.0), (0.03, 0.0, 0.0), (0.1, 0.05, 0.0), (0.0, 0.0, 2.0)):
        assert first.min_distance(points + shift) == pytest.approx(float(first.distances(points + shift).min()), abs=1e-12)
    assert first.min_distance(points, known=-1.0) == -1.0


def test_labels_are_kept_and_made_anew_where_they_are_of_others(tmp_path: Path) -> None:
    made = pretraining_corpus(1, 1, 32, 16, tmp_path / "labels.npz")
    written = (tmp_path / "labels.npz").stat().st_mtime_ns
    read = pretraining_corpus(1, 1, 32, 16, tmp_path / "labels.npz")
    assert (tmp_path / "labels.npz").stat().st_mtime_ns == written
    for shapes, again in zip(made, read, strict=True):
        for shape, other in zip(shapes, again, strict=True):
            assert shape.key == other.key
            for a, b in ((shape.cloud.points, other.cloud.points), (shape.distances, other.distances)):
                assert a.tobytes() == b.tobytes()
            assert np.array_equal(shape.cloud.size, other.cloud.size)
    assert len(pretraining_corpus(1, 1, 32, 12, tmp_path / "labels.npz")[0][0].distances) == 12
    assert (tmp_path / "labels.npz").stat().st_mtime_ns != written


def test_the_spread_loss_is_for_unit_deviation_and_no_correlation() -> None:
    torch.manual_seed(0)
    even = torch.linalg.qr(torch.randn(200, 64))[0]
    even = torch.linalg.qr(even - even.mean(0))[0] * 199**0.5  # uncorrelated, of unit deviation
    assert float(spread_loss(even)) == pytest.approx(0, abs=1e-3)
    assert float(spread_loss(0.1 * even)) == pytest.approx(0.9, abs=0.01)  # the deviation that is missing
    assert float(spread_loss(even[:, :1].expand(-1, 64))) == pytest.approx(63, abs=0.1)  # every pair of channels is alike


def test_the_encoder_that_is_left_gives_the_codes_that_were_asked() -> None:
    model = PretrainingModel(replace(TINY, enc_mode=True), Preprocessing(num_points=128, grid_size=1 / 4))
    shapes = [training_shape(key, 0, 128, 64) for key in KEYS[:6]]
    x = draw_targets(shapes, 16, 2, np.random.default_rng(0))
    for _ in range(3):
        model(x)  # levels learn what is usual
    model.eval()
    model.set_encoder_projection()
    codes = model.encoder.encode([p.cloud for p in x.posed]).codes
    assert np.allclose(codes, model(x)[0].detach().numpy(), atol=1e-4)
    assert np.abs(codes).max() > 0.1


def test_a_pair_has_one_clearance_whichever_is_first() -> None:
    shapes = [training_shape(key, 0, 128, 64) for key in KEYS[:6]]
    x = draw_targets(shapes, 16, 2, np.random.default_rng(0))
    head, codes = ClearanceHead(with_codes=True), torch.randn(6, 64)
    c, s = x.poses[:, 3], x.poses[:, 4]
    back = torch.stack(
        [
            -(c * x.poses[:, 0] + s * x.poses[:, 1]),
            s * x.poses[:, 0] - c * x.poses[:, 1],
            -x.poses[:, 2],
            c,
            -s,
        ],
        dim=1,
    )
    swapped = replace(x, boxes=x.boxes.roll(3, dims=1), poses=back)
    there, here = head(codes[x.first], codes[x.second], x), head(codes[x.second], codes[x.first], swapped)
    assert torch.allclose(there, here, atol=1e-5)
    assert there.std() > 0
