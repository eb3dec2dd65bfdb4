"""Self-supervised pre-training of the point encoder on the embedded assets: ``python -m models.point_encoder.pretrain``.

Two heads predict from the codes: the signed distance around an object, and the clearance of two objects. The corrector needs
both of a shape in its yaw frame. Step k has its own random stream, so that a resumed run ends with the same weights as an
uninterrupted one.
"""

import json
import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from torch import nn
from tqdm import tqdm

from models.point_encoder.checkpoint import save
from models.point_encoder.cloud import Preprocessing
from models.point_encoder.evaluation import evaluate
from models.point_encoder.heads import PretrainingModel
from models.point_encoder.pretraining_data import TrainingShape, pretraining_corpus
from models.point_encoder.pretraining_targets import PretrainingTargets, draw_targets
from models.point_encoder.transformer import BASE, EMBEDDED
from models.settings import Count, NonNegative, Positive, PositiveCount, Settings
from stable_data.commands.command_line import echo
from stable_data.config_diff import config_differences
from stable_data.errors import ConfigError

STATE, LABELS, ENCODER, REPORT = "state.pt", "labels.npz", "encoder.safetensors", "report.json"
CONFIGS = {"base": replace(BASE, enc_mode=True), "embedded": EMBEDDED}
"""Networks without a decoder; pre-training learns a projection of their output to 64 channels."""

_SAVE_EVERY = 60.0  # seconds
_WARM_UP = 0.05  # of the steps


@dataclass(frozen=True, slots=True)
class PretrainSettings(Settings):
    """Settings that determine the weights."""

    config: str = "embedded"
    """The network: ``embedded`` or ``base``."""

    steps: Count = 0
    """Optimizer steps; 0 performs as many as fit into the given minutes."""

    seed: int = 0
    """Seed of the initial weights and of all draws."""

    batch_size: PositiveCount = 32
    """Shapes per step."""

    pairs_a_shape: PositiveCount = 4
    """Pairs per shape of a step."""

    queries_a_shape: PositiveCount = 192
    """Distance queries per shape of a step."""

    num_categories: PositiveCount | None = None
    """Number of categories of the catalogue; None uses all."""

    num_copies: PositiveCount = 2
    """Number of aspects and tilts of each shape."""

    num_queries: PositiveCount = 2048
    """Distance labels that are computed per shape."""

    learning_rate: Positive = 2e-3
    """Learning rate of AdamW, after the warm-up."""

    weight_decay: NonNegative = 1e-2
    """Weight decay of AdamW."""

    pair_weight: NonNegative = 1.0
    """Weight of the clearance loss; the distance loss has weight 1."""

    spread_weight: NonNegative = 0.4
    """Weight of the loss that makes codes use all dimensions."""

    def check(self) -> None:
        """Refuses unknown networks and batches of too few shapes; see the base class."""
        if self.config not in CONFIGS:
            raise ConfigError(f"pretrain: config {self.config!r}, expected one of {sorted(CONFIGS)}", "pretrain_settings")
        if self.batch_size <= self.pairs_a_shape:
            message = f"pretrain: {self.batch_size} shapes, {self.pairs_a_shape} pairs of each, expected more shapes than pairs"
            raise ConfigError(message, "pretrain_settings")


def pretrain(
    out: Path, settings: PretrainSettings, minutes: float | None = None, stop_after: int | None = None
) -> dict[str, Any]:
    """Pre-trains an encoder, or resumes a stopped run.

    Args:
        out: Folder of the run: ``state.pt`` during the run, ``encoder.safetensors`` and ``report.json`` at its end.
        settings: Settings that determine the weights. If ``steps`` is 0, the number of steps is computed from the minutes; a
            resumed run uses the number of its start.
        minutes: Time of the training on this machine, without labels; read only if ``steps`` is 0.
        stop_after: Step at which this call stops; another call may resume.

    Returns:
        The report: errors on held-out assets, effective rank, time.

    Raises:
        ConfigError: The folder has a run of other settings, or neither steps nor minutes are given (``pretrain_settings``).
    """
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(settings.seed)
    preprocessing = Preprocessing()
    model = PretrainingModel(CONFIGS[settings.config], preprocessing).to("cuda" if torch.cuda.is_available() else "cpu")
    optimiser = torch.optim.AdamW(model.parameters(), settings.learning_rate, weight_decay=settings.weight_decay)
    step, losses, settings = _resume(out / STATE, settings, model, optimiser)
    shapes, held_out = pretraining_corpus(
        settings.num_categories, settings.num_copies, preprocessing.num_points, settings.num_queries, out / LABELS
    )
    if not settings.steps:
        if minutes is None:
            raise ConfigError("pretrain: neither steps nor minutes given, expected one of them", "pretrain_settings")
        settings = replace(settings, steps=max(1, int(60 * minutes / _seconds_a_step(model, shapes, settings))))
    began = saved = time.monotonic()
    first = step
    last = max(first, settings.steps if stop_after is None else min(stop_after, settings.steps))
    progress = tqdm(range(step, last), desc="pretrain", initial=step, total=settings.steps, unit="step")
    for step in progress:
        parts = _step(model, optimiser, _draw_batch(shapes, settings, step), settings, step)
        losses.append(parts)
        progress.set_postfix({name: f"{value:.3f}" for name, value in parts.items()}, refresh=False)
        if time.monotonic() - saved > _SAVE_EVERY:
            _save_state(out / STATE, settings, model, optimiser, step + 1, losses)
            saved = time.monotonic()
    _save_state(out / STATE, settings, model, optimiser, last, losses)
    seconds = (time.monotonic() - began) / max(1, last - first)
    report = {
        "settings": asdict(settings),
        "steps": last,
        "num_shapes": len(shapes),
        "num_parameters": sum(p.numel() for p in model.encoder.parameters()),
        "seconds_a_step": seconds,
        "losses": losses,
        **(evaluate(model, held_out) if held_out else {}),
    }
    if last == settings.steps:
        model.set_encoder_projection()
        save(model.encoder, out / ENCODER)
        report["fingerprint"] = model.encoder.fingerprint()
    (out / REPORT).write_text(json.dumps(report, indent=1) + "\n", "utf-8")
    return report


def _step(
    model: PretrainingModel, optimiser: torch.optim.Optimizer, batch: PretrainingTargets, settings: PretrainSettings, step: int
) -> dict[str, float]:
    """Performs one optimizer step and returns the parts of its loss."""
    for group in optimiser.param_groups:
        group["lr"] = settings.learning_rate * _schedule(step, settings.steps)
    total, parts = model.loss(batch.to(model.encoder.device), settings.pair_weight, settings.spread_weight)
    optimiser.zero_grad()
    total.backward()  # type: ignore[no-untyped-call]
    nn.utils.clip_grad_norm_(model.parameters(), 1.0)
    optimiser.step()
    return parts


def _draw_batch(shapes: Sequence[TrainingShape], settings: PretrainSettings, step: int) -> PretrainingTargets:
    rng = np.random.default_rng([settings.seed, step])
    chosen = rng.choice(len(shapes), settings.batch_size, replace=len(shapes) < settings.batch_size)
    return draw_targets([shapes[n] for n in chosen], settings.queries_a_shape, settings.pairs_a_shape, rng)


def _schedule(step: int, steps: int) -> float:
    warm_up = max(1.0, _WARM_UP * steps)
    # Linear warm-up, then cosine decay to 1 % of the learning rate.
    return min((step + 1) / warm_up, 0.5 * (1 + math.cos(math.pi * step / steps)) + 1e-2)


def _seconds_a_step(model: PretrainingModel, shapes: Sequence[TrainingShape], settings: PretrainSettings) -> float:
    """Measures the time of a step on this machine, without an update of the weights."""
    seconds = []
    model.eval()  # batch norms must not update their running statistics
    for k in range(3):
        began = time.monotonic()
        batch = _draw_batch(shapes, settings, k).to(model.encoder.device)
        total, _ = model.loss(batch, settings.pair_weight, settings.spread_weight)
        total.backward()  # type: ignore[no-untyped-call]
        seconds.append(time.monotonic() - began)
    model.train()
    return sum(seconds) / len(seconds)


def _resume(
    path: Path, settings: PretrainSettings, model: PretrainingModel, optimiser: torch.optim.Optimizer
) -> tuple[int, list[dict[str, float]], PretrainSettings]:
    if not path.exists():
        return 0, [], settings
    state = torch.load(path, map_location=model.encoder.device, weights_only=True)
    was = PretrainSettings(**state["settings"])
    now = settings if settings.steps else replace(settings, steps=was.steps)
    if changed := config_differences(asdict(was), asdict(now)):
        message = f"{path} has a run of other settings ({'; '.join(changed)}); use the same settings or another folder"
        raise ConfigError(message, "pretrain_settings")
    model.load_state_dict(state["model"])
    optimiser.load_state_dict(state["optimiser"])
    return state["step"], state["losses"], was


def _save_state(
    path: Path,
    settings: PretrainSettings,
    model: PretrainingModel,
    optimiser: torch.optim.Optimizer,
    step: int,
    losses: list[dict[str, float]],
) -> None:
    aside = path.with_name(f"{path.name}.tmp")
    state = {"settings": asdict(settings), "model": model.state_dict(), "optimiser": optimiser.state_dict()}
    torch.save({**state, "step": step, "losses": losses}, aside)
    aside.replace(path)


def main(
    out: Annotated[Path, typer.Option(help="Folder of the run.")],
    minutes: Annotated[float, typer.Option(help="Time of the training on this machine.")] = 30.0,
    steps: Annotated[int, typer.Option(help="Number of steps, instead of minutes.")] = 0,
    config: Annotated[str, typer.Option(help="embedded or base.")] = "embedded",
    seed: Annotated[int, typer.Option(help="Seed of weights and draws.")] = 0,
    num_categories: Annotated[int | None, typer.Option(help="Number of categories of the catalogue; by default all.")] = None,
) -> None:
    """Pre-trains the point encoder on the embedded assets; resumes a stopped run with the same settings."""
    try:
        report = pretrain(out, PretrainSettings(config, steps=steps, seed=seed, num_categories=num_categories), minutes)
    except ConfigError as error:
        echo(str(error), err=True)
        raise typer.Exit(2) from error
    echo(json.dumps({name: value for name, value in report.items() if name != "losses"}, indent=1))


if __name__ == "__main__":
    typer.run(main)
