"""LeRobot opens an exported dataset: frames, statistics, tools and a training; see README.md.

Each file of the request is a folder with ``dataset``, the export, and ``run``, the run that it was made of.
"""

import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pandas as pd
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.datasets.compute_stats import aggregate_stats, auto_downsample_height_width, get_feature_stats, sample_indices
from lerobot.datasets.dataset_tools import delete_episodes, merge_datasets
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import DEFAULT_FEATURES
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy
from lerobot.policies.factory import make_pre_post_processors
from PIL import Image

CHUNK, STEPS, BATCH = 8, 20, 8
DECODER = "pyav"  # torchcodec needs the libraries of FFmpeg on the system
VIDEO_ERROR = 16.0  # largest mean difference of a picture of a video from its PNG file, levels of 255
OURS = {"episode_id", "scene_id", "split", "number", "seed", "task_kind", "control", "success"}  # columns of meta/episodes


_CACHE = tempfile.TemporaryDirectory()
datasets.config.HF_DATASETS_CACHE = Path(_CACHE.name)
datasets.disable_progress_bars()


def rows_of(run: Path) -> dict[str, dict[str, Any]]:
    """The rows of the run's table, by episode."""
    return {row["episode_id"]: row for row in ds.dataset(run / "episodes").to_table().to_pylist()}


def pixels(content: bytes) -> Any:
    """A picture, (H, W, 3) uint8."""
    return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))


def arrays_of(row: dict[str, Any], index: int, first: int, tasks: list[str]) -> dict[str, Any]:
    """What the frames of an episode should be: feature -> (T, D), and camera -> pictures."""
    steps = row["num_steps"]
    k = np.arange(steps)
    found = {
        "observation.state": np.reshape(row["states"], (steps, -1)).astype(np.float32),
        "observation.environment_state": np.reshape(row["environment_states"], (steps, -1)).astype(np.float32),
        "action": np.reshape(row["actions"], (steps, -1)).astype(np.float32),
        "next.reward": np.array(row["rewards"], np.float32)[:, None],
        "next.success": ((k == steps - 1) & row["success"])[:, None],
        "next.done": (k == steps - 1)[:, None],
        "timestamp": (k / row["fps"]).astype(np.float32)[:, None],
        "frame_index": k[:, None],
        "episode_index": np.full((steps, 1), index),
        "index": first + k[:, None],
        "task_index": np.full((steps, 1), tasks.index(row["instruction"])),
    }
    if not row["environment_state_names"]:
        del found["observation.environment_state"]
    pictures = {f"observation.images.{c['camera']}": [pixels(one) for one in c["images"]] for c in row["pictures"] or []}
    return found | pictures


def shows(seen: Any, pictures: list[Any], step: int) -> bool:
    """Whether a picture of a video is near to its PNG file, and no nearer to those before and after it."""
    near = range(max(0, step - 1), min(len(pictures), step + 2))
    off = {k: float(np.abs(seen.transpose(1, 2, 0) * 255 - pictures[k]).mean()) for k in near}
    return off[step] < VIDEO_ERROR and off[step] == min(off.values())


def compare_frames(dataset: Any, expected: list[dict[str, Any]], rows: list[dict[str, Any]]) -> list[str]:
    """Every value of every frame."""
    problems, k = [], 0
    for row, arrays in zip(rows, expected, strict=True):
        for step in range(row["num_steps"]):
            frame = dataset[k]
            if set(frame) != {*arrays, "task"}:
                problems.append(f"frame {k} has {sorted(frame)}")
            if frame["task"] != row["instruction"]:
                problems.append(f"frame {k}: task is {frame['task']}")
            for name, values in arrays.items():
                seen = frame[name].numpy()
                if name in dataset.meta.video_keys:
                    is_same = shows(seen, values, step)
                elif name.startswith("observation.images."):
                    is_same = np.abs(seen.transpose(1, 2, 0) * 255 - values[step]).max() < 1e-3
                else:
                    is_same = seen.dtype == values.dtype and np.array_equal(np.atleast_1d(seen), values[step])
                if not is_same:
                    problems.append(f"frame {k}: {name} differs")
            k += 1
    return problems if k == len(dataset) else [*problems, f"{len(dataset)} frames, expected {k}"]


def statistics_of(name: str, values: Any) -> dict[str, Any]:
    """LeRobot's own statistics; of pictures from numbers that do not overflow, unlike its 8-bit squares."""
    if not name.startswith("observation.images."):
        whole = values if values.dtype.kind in "ib" else values.astype(np.float64)
        return dict(get_feature_stats(whole, axis=0, keepdims=False))
    chosen = np.stack([auto_downsample_height_width(values[k].transpose(2, 0, 1)) for k in sample_indices(len(values))])
    found = get_feature_stats(chosen.astype(np.float64), axis=(0, 2, 3), keepdims=True)
    return {key: value if key == "count" else np.squeeze(value / 255, axis=0) for key, value in found.items()}


def differ(name: str, theirs: dict[str, Any], ours: dict[str, Any]) -> list[str]:
    """The statistics of a feature that differ; LeRobot finds quantiles up to one of its 5,000 bins."""
    lines = [] if theirs.keys() == ours.keys() else [f"{name} has {sorted(ours)}"]
    spread = np.asarray(theirs["max"], float) - np.asarray(theirs["min"], float)
    for key in theirs.keys() & ours.keys():
        a, b = np.asarray(theirs[key], float), np.asarray(ours[key], float)
        allowed = spread / 4000 + 1e-8 if key.startswith("q") else 1e-8 * (1 + np.abs(a))
        if key == "std":
            allowed = 1e-5 * (1 + spread)  # theirs is a difference of large numbers
        if a.shape != b.shape or not (np.abs(a - b) <= allowed).all():
            lines.append(f"{name}: {key} is {b.ravel()[:3].tolist()}, LeRobot finds {a.ravel()[:3].tolist()}")
    return lines


def compare_statistics(dataset: Any, expected: list[dict[str, Any]]) -> list[str]:
    """The statistics of each episode and of all."""
    problems, all_theirs = [], []
    stored = pd.concat(pd.read_parquet(path) for path in sorted((dataset.root / "meta/episodes").glob("*/*.parquet")))
    for (_, row), arrays in zip(stored.iterrows(), expected, strict=True):
        theirs = {name: statistics_of(name, values) for name, values in arrays.items()}
        all_theirs.append(theirs)
        for name, found in theirs.items():
            ours = {key.rpartition("/")[2]: row[key] for key in row.index if key.startswith(f"stats/{name}/")}
            ours = {key: np.array(value.tolist()) if value.dtype != object else deep(value) for key, value in ours.items()}
            problems += differ(f"episode {row['episode_index']}: {name}", found, ours)
    for name, found in aggregate_stats(all_theirs).items():
        problems += differ(f"all: {name}", found, dataset.meta.stats[name])
    return problems


def deep(value: Any) -> Any:
    """An array of nested arrays as one array."""
    return np.array([deep(one) for one in value]) if isinstance(value, np.ndarray) else value


def types_of(path: Path) -> dict[str, str]:
    """Columns and their types of the Parquet files below a path."""
    first = sorted(path.rglob("*.parquet"))[0] if path.is_dir() else path
    return {field.name: str(field.type).replace("large_string", "string") for field in pq.read_schema(first)}


def compare_with_their_writer(
    dataset: Any, expected: list[dict[str, Any]], rows: list[dict[str, Any]], folder: Path
) -> list[str]:
    """The files beside those that LeRobot itself writes from the same frames."""
    own = {name: feature for name, feature in dataset.meta.features.items() if name not in DEFAULT_FEATURES}
    if dataset.meta.video_keys:
        own = {name: feature | {"dtype": "image"} if feature["dtype"] == "video" else feature for name, feature in own.items()}
    theirs = LeRobotDataset.create("local/theirs", dataset.fps, own, folder, dataset.meta.robot_type, use_videos=False)
    for row, arrays in zip(rows, expected, strict=True):
        for k in range(row["num_steps"]):
            theirs.add_frame({name: arrays[name][k] for name in own} | {"task": row["instruction"]})
        theirs.save_episode()
    theirs.finalize()
    is_video = bool(dataset.meta.video_keys)
    free = {"data_files_size_in_mb", "video_files_size_in_mb"} | ({"features", "video_path"} if is_video else set())
    infos = [json.loads((root / "meta/info.json").read_text()) for root in (dataset.root, folder)]
    problems = [
        f"info.json: {key} is {infos[0].get(key)}, LeRobot writes {infos[1].get(key)}"
        for key in (infos[0].keys() | infos[1].keys()) - free
        if infos[0].get(key, "nothing") != infos[1].get(key, "nothing")
    ]
    for part in ("data", "meta/episodes", "meta/tasks.parquet"):
        ours, wanted = types_of(dataset.root / part), types_of(folder / part)
        ours = {name: type_ for name, type_ in ours.items() if name not in OURS and not name.startswith("videos/")}
        wanted = {name: type_ for name, type_ in wanted.items() if name in ours or not is_video}
        problems += [
            f"{part}: {name} is {ours.get(name)}, LeRobot writes {wanted.get(name)}"
            for name in ours.keys() | wanted.keys()
            if ours.get(name) != wanted.get(name)
        ]
    ours_frames, their_frames = (pd.read_parquet(root / "meta/tasks.parquet") for root in (dataset.root, folder))
    return problems if ours_frames.equals(their_frames) else [*problems, "meta/tasks.parquet differs from LeRobot's"]


def compare_chunks(root: Path, expected: list[dict[str, Any]], fps: int) -> list[str]:
    """Chunks of actions by ``delta_timestamps``."""
    dataset = LeRobotDataset(
        "local/chunks", root, video_backend=DECODER, delta_timestamps={"action": [k / fps for k in range(CHUNK)]}
    )
    problems, first = [], 0
    for arrays in expected:
        actions = arrays["action"]
        for step in range(len(actions)):
            item, places = dataset[first + step], step + np.arange(CHUNK)
            wanted = actions[np.minimum(places, len(actions) - 1)]
            if (
                not np.array_equal(item["action"].numpy(), wanted)
                or (item["action_is_pad"].numpy() != (places >= len(actions))).any()
            ):
                problems.append(f"frame {first + step}: the chunk of actions differs")
        first += len(actions)
    return problems


def use_tools(dataset: Any, folder: Path) -> list[str]:
    """Merging with itself, and deleting the first episode."""
    problems = []
    merged = merge_datasets([dataset, dataset], "local/merged", folder / "merged")
    merged.video_backend = DECODER
    if (merged.num_episodes, merged.num_frames) != (2 * dataset.num_episodes, 2 * dataset.num_frames):
        problems.append(f"merged: {merged.num_episodes} episodes, {merged.num_frames} frames")
    kept = types_of(folder / "merged/meta/episodes").keys() & OURS
    if kept != OURS:
        problems.append(f"merged: meta/episodes lost {sorted(OURS - kept)}")
    if not torch.equal(merged[dataset.num_frames]["action"], dataset[0]["action"]):
        problems.append("merged: the second copy differs")
    if dataset.num_episodes > 1:
        less = delete_episodes(dataset, [0], folder / "less", "local/less")
        less.video_backend = DECODER
        first = dataset.meta.episodes[0]["length"]
        if less.num_frames != dataset.num_frames - first or not torch.equal(less[0]["action"], dataset[first]["action"]):
            problems.append("after deleting the first episode, others are not the same")
    return problems


def train(root: Path, fps: int) -> tuple[list[str], dict[str, float]]:
    """LeRobot's ACT on states; its loss must fall."""
    torch.manual_seed(0)
    dataset = LeRobotDataset(
        "local/train", root, video_backend=DECODER, delta_timestamps={"action": [k / fps for k in range(CHUNK)]}
    )
    sizes = {name: feature["shape"] for name, feature in dataset.features.items()}
    inputs = {"observation.state": PolicyFeature(FeatureType.STATE, sizes["observation.state"])}
    if "observation.environment_state" not in sizes:
        return ["no observation.environment_state, which ACT on states needs"], {}
    inputs["observation.environment_state"] = PolicyFeature(FeatureType.ENV, sizes["observation.environment_state"])
    config = ACTConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, sizes["action"])},
        chunk_size=CHUNK,
        n_action_steps=CHUNK,
        dim_model=128,
        dim_feedforward=256,
        device="cpu",
    )
    policy = ACTPolicy(config)
    prepare, _ = make_pre_post_processors(config, dataset_stats=dataset.meta.stats)
    frames = dataset.hf_dataset.select_columns([n for n in sizes if n not in dataset.meta.camera_keys])
    optimizer = torch.optim.AdamW(policy.parameters(), lr=3e-4)
    order, losses = torch.Generator().manual_seed(0), []
    policy.train()
    for _ in range(STEPS):
        batch = []
        for k in torch.randint(len(dataset), (BATCH,), generator=order).tolist():
            indices, padding = dataset._get_query_indices(k, int(frames[k]["episode_index"]))
            batch.append({name: frames[k][name] for name in inputs} | dataset._query_hf_dataset(indices) | padding)
        loss, _ = policy.forward(prepare(torch.utils.data.default_collate(batch)))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss))
    figures = {"first_loss": float(np.mean(losses[:5])), "last_loss": float(np.mean(losses[-5:]))}
    falls = np.isfinite(losses).all() and figures["last_loss"] < figures["first_loss"]
    return [] if falls else [f"the loss of ACT does not fall: {figures}"], figures


def look(folder: Path) -> dict[str, Any]:
    """Opens a dataset, and returns what is against it."""
    dataset = LeRobotDataset("local/export", folder / "dataset", video_backend=DECODER)
    table, tasks = rows_of(folder / "run"), list(dataset.meta.tasks.index)
    rows = [table[episode["episode_id"]] for episode in dataset.meta.episodes]
    firsts = np.cumsum([0, *(row["num_steps"] for row in rows)]).tolist()
    expected = [arrays_of(row, k, firsts[k], tasks) for k, row in enumerate(rows)]
    problems = compare_frames(dataset, expected, rows)
    for k, (episode, row) in enumerate(zip(dataset.meta.episodes, rows, strict=True)):
        problems += [f"episode {k}: {name} is {episode[name]}" for name in OURS if episode[name] != row[name]]
    problems += compare_statistics(dataset, expected)
    problems += compare_chunks(folder / "dataset", expected, dataset.fps)
    with tempfile.TemporaryDirectory() as place:
        problems += compare_with_their_writer(dataset, expected, rows, Path(place) / "theirs")
        problems += use_tools(dataset, Path(place))
    against, figures = train(folder / "dataset", dataset.fps)
    return {
        "error": None,
        "problems": problems + against,
        "episodes": dataset.num_episodes,
        "frames": dataset.num_frames,
        **figures,
    }


request = json.load(sys.stdin)
for file in request["files"]:
    try:
        opened = look(Path(file))
    except Exception as error:  # noqa: BLE001 - the reason is the result
        opened = {"error": f"{type(error).__name__}: {error}"}
    print("SEEN", json.dumps(opened), flush=True)
