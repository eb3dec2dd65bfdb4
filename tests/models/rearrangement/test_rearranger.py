"""A rearranger as a benchmark uses it: scenes in, scenes out; weights of something else are refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from models.physics_corrector.certify.correction import KnownShapes, shapes_by_instance
from models.physics_corrector.corrector import PhysicsCorrector
from models.physics_corrector.flow.checkpoint import load_corrector, save_corrector
from models.physics_corrector.scene_reading import Encoders
from models.point_encoder import save as save_encoder
from models.rearrangement.rearranger import Rearranger, open_rearranger
from models.rearrangement.selection import choose_sample, num_faults
from models.rearrangement.settings import METHODS, Method
from models.rearrangement.weights import load_rearranger, save_rearranger
from models.training.weights_file import read_notes, save_weights
from stable_data.errors import ConfigError
from stable_data.geometry.shape import Shape
from stable_data.scene import Scene
from tests.models.physics_corrector.certify.things import box, cylinder, laid
from tests.models.physics_corrector.flow.conditions import awake_network, small_settings
from tests.models.point_encoder.clouds import tiny_encoder
from tests.models.rearrangement.rearrangers import awake, boxes_alone, small

CUP, BOOK = cylinder(0.04, 0.1), box(0.15, 0.2, 0.03)
FREE: frozenset[str] = frozenset()


def weights_of(method: Method, folder: Path) -> Path:
    """The file of one whose head is awake."""
    path, settings = folder / f"{method}.safetensors", boxes_alone(method)
    save_rearranger(path, settings, awake(settings).state_dict(), {"data_fingerprint": "abc"})
    return path


def two_scenes() -> tuple[list[Scene], list[list[Shape]]]:
    first, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.46, 0.3, 0.0), ("c", BOOK, 0.2, 0.2, 0.0))
    second, others = laid(("d", BOOK, 0.3, 0.3, 0.0))
    return [first, replace(second, scene_id="another")], [list(shapes), list(others)]


def moved(
    mover: Rearranger, scenes: list[Scene], shapes: list[list[Shape]], fixed_of_first: frozenset[str] = FREE
) -> list[Scene]:
    found = mover(scenes, shapes, [fixed_of_first, *[FREE] * (len(scenes) - 1)])
    return [scene for scene in found if scene is not None]


@pytest.mark.parametrize("method", METHODS)
def test_weights_come_back_as_they_were(method: Method, tmp_path: Path) -> None:
    path = weights_of(method, tmp_path)
    read = load_rearranger(path)
    assert (read.settings, read.notes) == (boxes_alone(method), {"data_fingerprint": "abc"})
    for name, value in awake(read.settings).state_dict().items():
        assert torch.equal(read.network.state_dict()[name], value)
    again = tmp_path / "again"
    save_rearranger(again, read.settings, read.network.state_dict(), read.notes)
    assert again.read_bytes() == path.read_bytes()


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    path, settings = weights_of("lego_net", tmp_path), small_settings("set_transformer")
    corrector = tmp_path / "corrector"
    save_corrector(corrector, settings, awake_network(settings).state_dict())
    (tmp_path / "text").write_text("no weights")
    for file, said in (
        (corrector, "its format is not given, expected stable-data rearranger 1"),
        (tmp_path / "text", "cannot be read as safetensors"),
        (tmp_path / "none", "cannot be read as safetensors"),
    ):
        with pytest.raises(ConfigError, match=said):
            load_rearranger(file)
    with pytest.raises(ConfigError, match="corrector"):
        load_corrector(path)
    tensors, notes = load_file(path), read_notes(path)
    first = min(tensors)
    for changed, said in (
        ({**tensors, first: tensors[first][:1]}, f"do not match its settings .{first}: found"),
        ({name: value for name, value in tensors.items() if name != first}, f"{first}: found none"),
        ({**tensors, "more": tensors[first].clone()}, "more: found .*, expected none"),
        ({**tensors, first: torch.full_like(tensors[first], torch.nan)}, f"{first} .* not finite"),
    ):
        save_weights(path, changed, notes)
        with pytest.raises(ConfigError, match=said):
            load_rearranger(path)
    save_file(tensors, path, {**notes, "settings": '{"method": "lego_net"}'})
    with pytest.raises(ConfigError, match="settings of a rearranger: found no"):
        load_rearranger(path)


def test_encoders_of_another_training_are_refused(tmp_path: Path) -> None:
    settings, encoder = small("lego_net", num_features=64, num_texts=0), tiny_encoder()
    path = tmp_path / "weights.safetensors"
    save_rearranger(path, settings, awake(settings).state_dict(), {"encoder_fingerprint": encoder.fingerprint()})
    with pytest.raises(ConfigError, match="was trained on the features of encoder"):
        open_rearranger(path)  # the encoder of the repository
    save_encoder(encoder, path.with_name("point_encoder.safetensors"))
    scenes, shapes = two_scenes()
    found = open_rearranger(path)(scenes, shapes, [FREE, FREE])[0]
    assert found is not None
    assert found.poses().shape == (3, 4)
    with pytest.raises(ConfigError, match="was trained on the features of encoder"):
        Rearranger(load_rearranger(path), Encoders())


@pytest.mark.parametrize("method", METHODS)
def test_what_is_fixed_stays_and_a_scene_comes_out_as_it_would_alone(method: Method, tmp_path: Path) -> None:
    rearranger = open_rearranger(weights_of(method, tmp_path))
    scenes, shapes = two_scenes()
    first, second = moved(rearranger, scenes, shapes, frozenset({"b"}))
    assert first["b"] == scenes[0]["b"]
    assert all(first[name].position != scenes[0][name].position for name in ("a", "c"))
    alone = moved(rearranger, scenes[1:], shapes[1:])[0]
    assert second.poses() == pytest.approx(alone.poses(), abs=1e-4)
    other = moved(open_rearranger(weights_of(method, tmp_path), seed=1), scenes[1:], shapes[1:])[0]
    assert not np.allclose(other.poses(), alone.poses(), atol=1e-4)
    fewer = moved(open_rearranger(weights_of(method, tmp_path), steps=1), scenes[1:], shapes[1:])[0]
    assert not np.allclose(fewer.poses(), alone.poses(), atol=1e-4)
    empty = replace(scenes[0], objects=())
    assert rearranger([empty], [[]], [FREE]) == [empty]


def test_the_sample_with_the_fewest_faults_is_taken_and_then_the_nearest() -> None:
    start, shapes = laid(("a", CUP, 0.4, 0.3, 0.0), ("b", CUP, 0.43, 0.3, 0.0), ("c", BOOK, 0.2, 0.2, 0.0))

    def at(*shifts: tuple[float, float]) -> Scene:
        return start.with_poses(start.poses() + np.array([(*shift, 0.0, 0.0) for shift in shifts]))

    beside, farther, over = at((0, 0), (0.1, 0), (0, 0)), at((0, 0), (0.15, 0), (0, 0)), at((0, 0), (0.1, 0), (-0.15, 0))
    assert [num_faults(scene, shapes) for scene in (start, beside, farther, over)] == [1, 0, 0, 1]
    assert choose_sample(start, shapes, [start, over, farther, beside]) is beside
    assert choose_sample(start, shapes, [over]) is over
    assert choose_sample(start, shapes, [None, over, None]) is over  # poses that are not finite are no sample
    assert choose_sample(start, shapes, [None]) is None


@pytest.mark.parametrize("method", METHODS)
def test_poses_that_are_not_finite_are_no_result(method: Method, tmp_path: Path) -> None:
    rearranger = open_rearranger(weights_of(method, tmp_path))
    scenes, shapes = two_scenes()
    x, y, z = scenes[0]["a"].position
    lost = replace(scenes[0], objects=(scenes[0]["a"].moved((x + 1e30, y, z), 0.0), *scenes[0].objects[1:]))
    nothing, moved = rearranger([lost, scenes[1]], shapes, [FREE, FREE])
    assert nothing is None
    assert moved is not None
    named = [shapes_by_instance(lost, shapes[0])]
    parts = PhysicsCorrector(rearranger, polish="off").move([lost], KnownShapes(named[0]))
    assert parts[0].raw is None
