import json
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any
from zipfile import ZIP_DEFLATED, ZIP_STORED, ZipFile

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor

from models.point_encoder.checkpoint import DEFAULT_WEIGHTS, load, load_default, load_published, save
from models.point_encoder.cloud import MODELNET, SONATA
from models.point_encoder.transformer import PointTransformer, TransformerConfig
from models.training.weights_file import read_weights, save_weights
from stable_data.errors import ConfigError
from stable_data.limits import MIB, memory_limited
from tests.models.point_encoder.clouds import TINY, box_cloud, clouds, tiny_encoder

FIRST = TransformerConfig(
    legacy_stale_cpe=True,
    enc_depths=(2, 1, 3),
    enc_channels=(32, 48, 64),
    enc_heads=(2, 3, 4),
    dec_depths=(2, 1),
    dec_channels=(64, 32),
    dec_heads=(4, 2),
)
SECOND = TransformerConfig(
    in_channels=9,
    stem="linear",
    norm="ln",
    pool="grid",
    enc_mode=True,
    layer_scale=1e-5,
    patch_size=512,
    enc_depths=(1, 2),
    enc_channels=(48, 96),
    enc_heads=(3, 6),
    dec_depths=(),
    dec_channels=(),
    dec_heads=(),
)


def weights(config: TransformerConfig) -> dict[str, Tensor]:
    torch.manual_seed(1)
    return PointTransformer(config).state_dict()


def written(tmp_path: Path, content: Any) -> Path:
    path = tmp_path / "model.pth"
    torch.save(content, path)
    return path


def test_an_encoder_reads_back_as_it_was(tmp_path: Path) -> None:
    encoder, path = tiny_encoder(), tmp_path / "deep" / "encoder.safetensors"
    save(encoder, path)
    again = load(path)
    assert again.config == encoder.config
    assert again.preprocessing == encoder.preprocessing
    assert again.fingerprint() == encoder.fingerprint()
    assert again.encode(clouds()).codes.tobytes() == encoder.encode(clouds()).codes.tobytes()
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_an_encoder_that_was_changed_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "encoder.safetensors"
    save(tiny_encoder(), path)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="was changed"):
        load(path)


def test_what_is_no_encoder_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "other.safetensors"
    save_file({"a": torch.zeros(2)}, path)
    with pytest.raises(ConfigError, match="format None"):
        load(path)
    path.write_bytes(b"nothing")
    with pytest.raises(ConfigError, match="cannot be read as safetensors"):
        load(path)
    with pytest.raises(ConfigError):
        load(tmp_path / "missing.safetensors")


@pytest.mark.parametrize(
    ("prefix", "beside"),
    [
        ("", {}),
        ("", {"seg_head.weight": torch.zeros(2)}),
        ("module.", {"module.cls_head.0.weight": torch.zeros(2)}),
        ("module.backbone.", {"module.seg_head.weight": torch.zeros(2)}),
        ("module.student.backbone.", {"module.teacher.backbone.enc.enc0.block0.norm1.0.weight": torch.zeros(2)}),
    ],
)
def test_a_first_generation_checkpoint_loads_strictly(tmp_path: Path, prefix: str, beside: dict[str, Tensor]) -> None:
    state = weights(FIRST)
    path = written(tmp_path, {"state_dict": {f"{prefix}{k}": v for k, v in state.items()} | beside, "epoch": 3})
    encoder = load_published(path, MODELNET)
    assert encoder.config == FIRST
    assert not encoder.needs_projection
    assert all(tensor.equal(state[name]) for name, tensor in encoder.backbone.state_dict().items())


def test_a_second_generation_checkpoint_loads_strictly(tmp_path: Path) -> None:
    state = weights(SECOND) | {"embedding.mask_token": torch.zeros(1, 48)}
    stated = {
        "enc_num_head": (3, 6),
        "enc_patch_size": (512, 512),
        "dec_patch_size": (9,),
        "order": tuple(str(c) for c in SECOND.curves),
    }
    encoder = load_published(written(tmp_path, {"config": stated, "state_dict": state}), SONATA)
    found = encoder.config
    assert found.layer_scale == pytest.approx(1e-5)
    assert replace(found, layer_scale=1e-5) == SECOND
    assert encoder.needs_projection


def test_a_plain_safetensors_state_dict_loads(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    save_file({name: tensor.contiguous() for name, tensor in weights(FIRST).items()}, path)
    assert load_published(path, MODELNET).config == FIRST


def test_what_does_not_fit_is_listed(tmp_path: Path) -> None:
    state = weights(FIRST)
    del state["enc.enc1.block0.attn.qkv.bias"]
    state["enc.enc1.block0.attn.gate"] = torch.zeros(3)
    state["dec.dec0.up.proj.0.weight"] = torch.zeros(64, 31)
    with pytest.raises(ConfigError) as found:
        load_published(written(tmp_path, state), MODELNET)
    message = str(found.value)
    assert "1 missing: enc.enc1.block0.attn.qkv.bias" in message
    assert "1 unexpected: enc.enc1.block0.attn.gate" in message
    assert "1 shape: dec.dec0.up.proj.0.weight is (64, 31), expected (64, 32)" in message


def test_rotary_positions_are_refused(tmp_path: Path) -> None:
    state = weights(SECOND) | {"enc.enc0.block0.attn.rope.inv_freq": torch.zeros(3)}
    with pytest.raises(ConfigError, match="rotary"):
        load_published(written(tmp_path, {"state_dict": state}), SONATA)


def test_preprocessing_of_another_checkpoint_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="takes 6 channels"):
        load_published(written(tmp_path, weights(FIRST)), SONATA)


@pytest.mark.parametrize("content", [{"a": torch.zeros(1)}, [1, 2], {"state_dict": 3}, {"state_dict": {"embedding.stem.x": 1}}])
def test_other_files_are_refused(tmp_path: Path, content: Any) -> None:
    with pytest.raises(ConfigError, match="expected"):
        load_published(written(tmp_path, content), MODELNET)


def repacked(path: Path, compression: int) -> Path:
    """The same archive, packed in another way."""
    with ZipFile(path) as source:
        contents = {name: source.read(name) for name in source.namelist()}
    with ZipFile(path, "w", compression) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return path


def test_a_packed_checkpoint_is_refused_before_it_is_unpacked(tmp_path: Path) -> None:
    path = repacked(written(tmp_path, {"embedding.stem.conv.weight": torch.zeros(50_000_000)}), ZIP_DEFLATED)
    assert path.stat().st_size < 10**6
    with memory_limited(180 * MIB), pytest.raises(ConfigError, match=r"its member '\S+' is packed") as caught:
        load_published(path, MODELNET)
    assert caught.value.code == "weights_invalid"
    assert load_published(repacked(written(tmp_path, weights(FIRST)), ZIP_STORED), MODELNET)


def test_a_checkpoint_whose_members_share_their_bytes_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, {"embedding.stem.conv.weight": torch.zeros(10_000)})
    with ZipFile(path, "a") as archive:
        member = next(each for each in archive.infolist() if each.filename.endswith("/data/0"))
        archive.writestr("archive/version_2", "3")
        for k in range(100):
            twin = copy(member)
            twin.filename = f"archive/data/{k + 1}"
            archive.filelist.append(twin)
    with pytest.raises(ConfigError, match=r"its members state \d,\d{3},\d{3} bytes, expected at most"):
        load_published(path, MODELNET)


def test_an_archive_with_two_lists_of_members_is_refused(tmp_path: Path) -> None:
    """torch reads the list that the end of a file names, Python the one before the end: one could be checked and the other read."""
    path = written(tmp_path, weights(FIRST))
    with ZipFile(path) as archive:
        start = archive.start_dir
    content = path.read_bytes()
    listed, longer, locator, end = content[start:-98], content[-98:-42], content[-42:-22], content[-22:]
    moved = longer[:48] + (start + len(listed) + len(longer)).to_bytes(8, "little")
    later = locator[:8] + (start + 2 * len(listed)).to_bytes(8, "little") + locator[16:]
    twice = {
        "plain": content[:start] + listed + listed + end,
        "long": content[:start] + listed + listed + longer + later + end,
        "two long ends": content[:start] + listed + longer + listed + moved + locator + end,
    }
    for name, both in twice.items():
        path.write_bytes(both)
        assert torch.load(path, weights_only=True).keys() == weights(FIRST).keys(), name
        with pytest.raises(ConfigError, match="names another list of members"):
            load_published(path, MODELNET)
    path.write_bytes(content[:start] + listed + end)
    assert load_published(path, MODELNET).config == FIRST
    path.write_bytes(
        content[:start] + listed + end + bytes(16) + end[16:20] + bytes(2)
    )  # Python reads on over what comes after
    with pytest.raises(ConfigError, match="names another list of members"):
        load_published(path, MODELNET)


def test_a_lack_of_memory_is_no_fault_of_a_checkpoint(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the job would count a sound file as broken."""
    path = written(tmp_path, {"embedding.stem.conv.weight": torch.zeros(20_000_000)})
    with pytest.raises(MemoryError), memory_limited(30 * MIB):
        load_published(path, MODELNET)

    def build(*_: object) -> None:
        raise RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 4 bytes")

    monkeypatch.setattr("models.point_encoder.checkpoint.build_no_larger_than", build)
    with pytest.raises(RuntimeError, match="can't allocate memory"):
        load_published(written(tmp_path, weights(FIRST)), MODELNET)


@pytest.mark.parametrize("content", [b"PK\x03\x04", b"PK\x03\x04" + b"PK\x05\x06" * 9, b"PK\x05\x06" + b"\0" * 18])
def test_a_checkpoint_that_is_no_archive_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "model.pth"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match="expected a checkpoint of tensors"):
        load_published(path, MODELNET)


class Harmful:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return eval, ("1/0",)


def test_nothing_is_unpickled(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="tensors and plain values alone"):
        load_published(written(tmp_path, Harmful()), MODELNET)


def test_the_tiny_network_is_none_of_the_published(tmp_path: Path) -> None:
    """Layer norms in the stem of a first-generation network: read as what they are."""
    assert load_published(written(tmp_path, weights(replace(TINY, legacy_stale_cpe=True))), MODELNET).config.norm == "ln"


def test_the_default_weights_are_those_that_their_card_describes() -> None:
    encoder = load_default()
    card = DEFAULT_WEIGHTS.with_suffix(".md").read_text("utf-8")
    assert f"`{encoder.fingerprint()}`" in card
    sizes = ((0.1, 0.1, 0.1), (0.3, 0.02, 0.05), (0.2, 0.2, 0.01))
    features = encoder.encode([box_cloud(*size, num_points=encoder.preprocessing.num_points) for size in sizes])
    apart = np.linalg.norm(features.codes[:, None] - features.codes, axis=2)
    assert apart[np.triu_indices(3, 1)].min() > 1  # codes have about unit deviation
    twice = encoder.encode([box_cloud(0.6, 0.04, 0.1, num_points=encoder.preprocessing.num_points)])
    assert np.allclose(twice.codes[0], features.codes[1], atol=1e-3)  # the size is not in the code
    assert np.allclose(twice.log_extents[0] - features.log_extents[1], np.log(2), atol=1e-6)


def test_a_file_cannot_describe_a_network_that_is_larger_than_it(tmp_path: Path) -> None:
    """Its notes may come from anywhere, and the network is made before its tensors are compared."""
    tensors, notes = read_weights(DEFAULT_WEIGHTS)
    config = json.loads(notes["config"])
    for wrong in ({"enc_channels": [32, 64, 2**22]}, {"enc_depths": [1, 1, 10**9]}):
        path = tmp_path / "w.safetensors"
        save_weights(path, tensors, notes | {"config": json.dumps(config | wrong)})
        with pytest.raises(ConfigError, match="more numbers than the file has bytes") as caught:
            load(path)
        assert caught.value.code == "weights_invalid"


def test_a_small_file_cannot_describe_a_network_of_very_many_modules(tmp_path: Path) -> None:
    """Modules of one channel have few numbers, but each takes kilobytes and time."""
    _, notes = read_weights(DEFAULT_WEIGHTS)
    none: dict[str, Any] = {"dec_depths": [], "dec_channels": [], "dec_heads": []}
    narrow = json.loads(notes["config"]) | none | {"enc_channels": [1], "enc_heads": [1]}
    for depth, code in ((10, "weights_mismatch"), (300, "weights_invalid")):
        path = tmp_path / "w.safetensors"
        save_weights(path, {"a": torch.zeros(1)}, notes | {"config": json.dumps(narrow | {"enc_depths": [depth]})})
        with pytest.raises(ConfigError) as caught:
            load(path)
        assert caught.value.code == code


def test_a_published_checkpoint_cannot_describe_a_network_that_is_larger_than_it(tmp_path: Path) -> None:
    """A tensor in a file may have any shape: steps of zero repeat its numbers."""
    wide = {"enc.enc0.block0.norm1.0.weight": torch.zeros(1).expand(10**6)}
    path = written(tmp_path, weights(FIRST) | wide)
    with memory_limited(300 * MIB), pytest.raises(ConfigError, match="more numbers than the file has bytes") as caught:
        load_published(path, MODELNET)
    assert caught.value.code == "weights_invalid"
    scale = {"enc.enc0.block0.ls1.0.gamma": torch.zeros(1).expand(10**10)}
    path = written(tmp_path, weights(SECOND) | scale)
    with memory_limited(300 * MIB), pytest.raises(ConfigError, match=r"1 shape: enc\.enc0\.block0\.ls1"):
        load_published(path, SONATA)


@pytest.mark.parametrize(
    "stated",
    [
        {"enc_num_head": 3},
        {"enc_patch_size": (None,)},
        {"enc_patch_size": ([],)},
        {"order": 5},
        {"order": ({},)},
        {"enc_num_head": "ab"},
    ],
)
def test_a_published_checkpoint_with_settings_of_another_form_is_refused(tmp_path: Path, stated: Any) -> None:
    with pytest.raises(ConfigError) as caught:
        load_published(written(tmp_path, {"config": stated, "state_dict": weights(SECOND)}), SONATA)
    assert caught.value.code in ("weights_invalid", "encoder_config")


def test_a_checkpoint_in_the_old_format_of_torch_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.pth"
    torch.save(weights(FIRST), path, _use_new_zipfile_serialization=False)
    with pytest.raises(ConfigError, match=r"no archive as torch\.save writes it since version 1\.6"):
        load_published(path, MODELNET)


def test_notes_that_are_no_settings_are_refused(tmp_path: Path) -> None:
    tensors, notes = read_weights(DEFAULT_WEIGHTS)
    for wrong in ({"preprocessing": '"8"'}, {"config": "[1]"}, {"config": "null"}):
        path = tmp_path / "w.safetensors"
        save_weights(path, tensors, notes | wrong)
        with pytest.raises(ConfigError, match="its configuration cannot be read") as caught:
            load(path)
        assert caught.value.code == "weights_invalid"
