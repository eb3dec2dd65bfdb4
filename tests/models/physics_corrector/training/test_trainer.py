from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch.multiprocessing.spawn import spawn

from models.physics_corrector.flow.checkpoint import save_corrector
from models.physics_corrector.training.layout_trainer import train
from models.physics_corrector.training.losses import LossSettings
from models.physics_corrector.training.settings import CorrectorTrainingSettings, PhysicsSchedule, training_preset
from models.physics_corrector.training.trainer import CorrectorTrainer
from models.training.distributed import ProcessContext
from stable_data.errors import ConfigError
from tests.models.physics_corrector.training.training_scenes import TINY, training_set

DATA = training_set()
ONE_CHUNK = replace(TINY, batch_size=3, chunk=3)


def trained(settings: CorrectorTrainingSettings, steps: int, training: CorrectorTrainer | None = None) -> CorrectorTrainer:
    training = CorrectorTrainer(DATA, settings) if training is None else training
    count = iter(range(steps + 1))
    train(training, wants_stop=lambda: next(count) >= steps - 1, after=lambda *_: None)
    return training


def content(training: CorrectorTrainer, path: Path) -> bytes:
    save_corrector(path, training.settings.corrector, training.average)
    return path.read_bytes()


@pytest.mark.parametrize("schedule", [PhysicsSchedule(), PhysicsSchedule(unroll_share=0.5, unroll_scenes=1.0)])
def test_a_run_that_was_killed_and_resumed_gives_the_same_bytes(tmp_path: Path, schedule: PhysicsSchedule) -> None:
    settings = replace(TINY, physics=schedule, warm_up=3, cool_down=0.5)
    clean = trained(settings, 8)
    first = trained(settings, 3)
    first.save(tmp_path / "state.pt")
    trained(settings, 2, first)  # lost: it was killed before it was kept
    second = CorrectorTrainer(DATA, settings)
    assert second.resume(tmp_path / "state.pt")
    assert second.step == 3
    trained(settings, 8, second)
    assert second.step == clean.step == 8
    assert content(second, tmp_path / "second") == content(clean, tmp_path / "clean")


def test_there_may_be_nothing_to_resume(tmp_path: Path) -> None:
    assert not CorrectorTrainer(DATA, TINY).resume(tmp_path / "state.pt")


def test_a_checkpoint_of_other_settings_or_data_is_refused(tmp_path: Path) -> None:
    trained(TINY, 1).save(tmp_path / "state.pt")
    other = replace(TINY, learning_rate=1e-5)
    with pytest.raises(ConfigError, match=r"learning_rate: 0.003 -> 1e-05"):
        CorrectorTrainer(DATA, other).resume(tmp_path / "state.pt")
    with pytest.raises(ConfigError, match=r"encoder:  -> another"):
        CorrectorTrainer(replace(DATA, encoder="another"), TINY).resume(tmp_path / "state.pt")
    (tmp_path / "state.pt").write_bytes(b"PK nothing")
    with pytest.raises(ConfigError, match="cannot be read"):
        CorrectorTrainer(DATA, TINY).resume(tmp_path / "state.pt")


def test_the_loss_goes_down() -> None:
    settings = replace(TINY, steps=60, batch_size=12, chunk=12)
    training, losses = CorrectorTrainer(DATA, settings), []
    train(training, wants_stop=lambda: False, after=lambda _, figures: losses.append(figures["flow"]))
    assert training.step == 60
    assert sum(losses[-15:]) < 0.75 * sum(losses[:15])


def test_only_the_training_split_is_drawn_and_each_pass_once() -> None:
    training = CorrectorTrainer(DATA, replace(TINY, batch_size=4))
    drawn = []
    for step in range(6):
        training.step = step
        drawn += training._scenes_of_step().tolist()
    assert [sorted(drawn[k : k + 6]) for k in range(0, 24, 6)] == [list(range(6))] * 4
    training.step = 2
    assert training._scenes_of_step().tolist() == drawn[8:12]


def test_gradients_of_chunks_add_up_to_those_of_the_step() -> None:
    """The mean over objects and scenes does not depend on how a step is cut, but for its draws."""
    training = CorrectorTrainer(DATA, replace(TINY, batch_size=6, chunk=2))
    shares = [share for _, share, _ in training._chunks()]
    assert len(shares) == 3
    assert sum(shares) == pytest.approx(1.0)


def test_processes_share_the_chunks_of_a_step() -> None:
    alone = list(CorrectorTrainer(DATA, TINY)._chunks())
    shared = [list(CorrectorTrainer(DATA, TINY, ProcessContext(rank=rank, world_size=2))._chunks()) for rank in range(2)]
    merged = [shared[n % 2][n // 2] for n in range(len(alone))]
    for (one, share, generator), (other, same, like) in zip(alone, merged, strict=True):
        assert torch.equal(one.poses, other.poses)
        assert share == same
        assert torch.equal(torch.rand(3, generator=generator), torch.rand(3, generator=like))


def train_in_process(rank: int, folder: str) -> None:
    """Two steps with one chunk each, of which the second process has none."""
    torch.distributed.init_process_group("gloo", init_method=f"file://{folder}/store", rank=rank, world_size=2)
    training = CorrectorTrainer(DATA, ONE_CHUNK, ProcessContext(rank=rank, world_size=2))
    training.advance()
    training.advance()
    torch.save(training.network.state_dict(), Path(folder) / f"{rank}.pt")
    torch.distributed.destroy_process_group()


@pytest.mark.slow
def test_a_process_without_a_chunk_takes_the_gradients_of_the_others(tmp_path: Path) -> None:
    spawn(train_in_process, (str(tmp_path),), nprocs=2)  # type: ignore[no-untyped-call]
    alone = CorrectorTrainer(DATA, ONE_CHUNK)
    alone.advance()
    alone.advance()
    for rank in range(2):
        shared = torch.load(tmp_path / f"{rank}.pt", weights_only=True)
        for name, value in alone.network.state_dict().items():
            torch.testing.assert_close(shared[name], value)


def test_physics_counts_from_its_start_and_grows() -> None:
    settings = replace(TINY, physics=PhysicsSchedule(share=1.0, from_time=0.0, start=2, ramp=4))
    assert [settings.physics_at(step) for step in range(7)] == [0, 0, 0.25, 0.5, 0.75, 1, 1]
    training = CorrectorTrainer(DATA, settings)
    figures = [training.advance()[0] for _ in range(4)]
    assert [f["physics"] > 0 for f in figures] == [False, False, True, True]
    assert all(f["total"] == pytest.approx(f["flow"] + f["physics"], rel=1e-4) for f in figures)


@pytest.mark.slow
def test_a_share_of_the_scenes_stands_for_all_of_them() -> None:
    """The estimate from a quarter of the scenes has the mean of the whole."""

    def mean(share: float) -> float:
        schedule = PhysicsSchedule(share=share, from_time=0.0)
        training = CorrectorTrainer(DATA, replace(TINY, batch_size=32, chunk=32, learning_rate=1e-12, physics=schedule))
        return sum(training.advance()[0]["object_table"] for _ in range(30)) / 30

    assert mean(0.25) == pytest.approx(mean(1.0), rel=0.35)


def test_the_learning_rate_warms_up_and_cools_down() -> None:
    settings = replace(TINY, steps=10, learning_rate=1.0, warm_up=2, cool_down=0.4)
    assert [round(settings.learning_rate_at(step), 2) for step in range(10)] == [0.5, 1, 1, 1, 1, 1, 1, 0.75, 0.5, 0.25]


def test_the_average_follows_the_weights() -> None:
    training = trained(replace(TINY, ema=0.9), 5)
    name = "head.1.weight"
    weight = training.network.state_dict()[name]
    assert not torch.equal(training.average[name], weight)
    assert torch.equal(training.averaged().state_dict()[name], training.average[name])
    settings = replace(TINY, ema=0.0)
    same = trained(settings, 2)
    assert torch.equal(same.average[name], same.network.state_dict()[name])


def test_a_step_leaves_the_clean_scenes_alone() -> None:
    before = DATA.batch.poses.clone()
    trained(TINY, 2)
    assert torch.equal(DATA.batch.poses, before)


def test_paper_preset_is_the_papers() -> None:
    settings = training_preset("paper").resolved(10_000)
    assert (settings.learning_rate, settings.batch_size, settings.epochs) == (2e-4, 2048, 5000)
    assert settings.steps == -(-5000 * 10_000 // 2048)
    assert (settings.losses.sdf_weight, settings.losses.support_weight, settings.losses.flow_weight) == (0.02, 0.01, 1.0)
    assert (settings.ema, settings.clip, settings.warm_up, settings.cool_down, settings.prefixes.fixed) == (0, 0, 0, 0, 0)
    assert (settings.physics.share, settings.physics.from_time, settings.physics.power) == (1.0, 0.0, 0.0)
    network, flow = settings.corrector.network, settings.corrector.flow
    assert (network.backbone, network.channels, network.num_features, network.num_texts) == ("unet1d", 512, 64, 0)
    assert not network.reads_errors
    assert (flow.coordinates.form, flow.heights, flow.source) == ("absolute", "learned", "coarse")
    assert settings.initial == ""


def test_the_tuned_paper_preset_has_the_same_network() -> None:
    assert training_preset("paper_tuned").corrector.network == training_preset("paper").corrector.network
    assert training_preset("paper_tuned").ema > 0


def test_box_features_make_a_network_that_reads_none() -> None:
    settings = replace(training_preset("embedded"), features="box").resolved(10)
    assert settings.corrector.network.num_features == 0


def test_a_loss_that_is_not_finite_stops_the_training() -> None:
    training = CorrectorTrainer(DATA, TINY)
    with torch.no_grad():
        training.network.state_dict()["head.1.bias"].fill_(float("nan"))
    with pytest.raises(ConfigError, match="not finite"):
        train(training, wants_stop=lambda: False, after=lambda *_: None)


def test_training_makes_a_corrector_that_moves_things_where_they_belong() -> None:
    """Overfitted on two scenes, raw samples are nearer to the targets than what they came from."""
    from models.physics_corrector.training.validation import ValidationScenes, validation_card

    data = training_set(2, 1)
    settings = replace(TINY, steps=150, batch_size=16, chunk=16, learning_rate=5e-3, cool_down=0.5).resolved(2)
    training = CorrectorTrainer(data, settings)
    train(training, wants_stop=lambda: False, after=lambda *_: None)
    held_out = ValidationScenes(data, torch.tensor([0, 1, 0, 1, 0, 1]))
    move = training.flow.mover(training.averaged())
    card = validation_card(move, held_out, settings.perturbation, 0, ("jitter",))["jitter"]
    before, after = card["coarse"]["target_distance_mm"], card["raw"]["target_distance_mm"]
    assert before is not None
    assert after is not None
    assert after < 0.7 * before


def test_a_limit_lets_large_losses_count_as_their_logarithm() -> None:
    def figures(limit: float) -> dict[str, float]:
        schedule = PhysicsSchedule(share=1.0, from_time=0.0, limit=limit)
        return CorrectorTrainer(DATA, replace(TINY, physics=schedule)).advance()[0]

    plain, small, large = figures(0.0), figures(1e-4), figures(1e6)
    assert large["physics"] == pytest.approx(plain["physics"], rel=1e-3)
    assert small["physics"] < 0.2 * plain["physics"]
    assert small["object_table"] == plain["object_table"]


SAMPLED = PhysicsSchedule(share=0.0, unroll_share=1.0, unroll_scenes=1.0)


def trained_network(settings: CorrectorTrainingSettings) -> CorrectorTrainer:
    """A training whose network moves things: an untrained one leaves them where they are."""
    training = CorrectorTrainer(DATA, settings)
    with torch.no_grad():
        training.network.state_dict()["head.1.weight"].normal_(0, 0.5, generator=torch.Generator().manual_seed(0))
    return training


def test_a_training_without_a_loss_is_refused() -> None:
    bare = LossSettings(sdf_weight=0.0, support_weight=0.0, flow_weight=0.0)
    with pytest.raises(ConfigError, match="steps without a loss"):
        replace(TINY, losses=bare, physics=replace(SAMPLED, unroll_share=0.5))


def test_the_flow_counts_by_its_weight() -> None:
    def flow(weight: float) -> float:
        return CorrectorTrainer(DATA, replace(TINY, losses=LossSettings(flow_weight=weight))).advance()[0]["flow"]

    assert flow(0.25) == pytest.approx(0.25 * flow(1.0))


def test_training_starts_from_the_weights_that_it_is_given(tmp_path: Path) -> None:
    first = trained(TINY, 3)
    path = tmp_path / "first.safetensors"
    save_corrector(path, TINY.corrector, first.average)
    second = CorrectorTrainer(DATA, replace(TINY, initial=str(path), learning_rate=1e-4))
    for name, value in first.average.items():
        assert torch.equal(second.network.state_dict()[name], value)
        assert torch.equal(second.average[name], value)
    second.advance()
    assert not torch.equal(second.network.state_dict()["head.1.bias"], first.average["head.1.bias"])
    fewer_steps = replace(TINY.corrector, flow=replace(TINY.corrector.flow, steps=2))
    CorrectorTrainer(DATA, replace(TINY, initial=str(path), corrector=fewer_steps))  # how the flow is followed may differ


def test_weights_of_another_network_or_encoder_are_no_start(tmp_path: Path) -> None:
    path = tmp_path / "first.safetensors"
    save_corrector(path, TINY.corrector, CorrectorTrainer(DATA, TINY).average, {"encoder_fingerprint": "another"})
    with pytest.raises(ConfigError, match="encoder another"):
        CorrectorTrainer(DATA, replace(TINY, initial=str(path)))
    wider = replace(TINY.corrector, network=replace(TINY.corrector.network, levels=3))
    with pytest.raises(ConfigError, match=r"levels: 2 -> 3"):
        CorrectorTrainer(DATA, replace(TINY, initial=str(path), corrector=wider))
    with pytest.raises(ConfigError, match="cannot be read"):
        CorrectorTrainer(DATA, replace(TINY, initial=str(tmp_path / "none.safetensors")))
