"""Training of a policy: it learns what it is shown, continues where it stopped, and knows what it was trained with."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from models.policy.chunk_policy import open_policy
from models.policy.network import PolicyShape
from models.policy.training import PolicyTrainingSettings
from models.policy.weights import FILE, check_environment, load_policy
from pipelines.train.policy import PolicyTrainingJob
from stable_data.errors import ConfigError
from stable_data.robot.episodes import read_episodes

SMALL = PolicyTrainingSettings(PolicyShape(width=32, depth=1, modes=2, dropout=0.0), steps=6, batch=16, held_out=0.0)


def train(data: Path, out: Path, settings: PolicyTrainingSettings = SMALL) -> Path:
    PolicyTrainingJob(str(data), out, settings=settings, note_every=2).run()
    return out


def test_a_stopped_training_resumes_to_the_same_weights(demonstrations: Path, tmp_path: Path) -> None:
    whole = train(demonstrations, tmp_path / "whole")
    job = PolicyTrainingJob(str(demonstrations), tmp_path / "parts", settings=SMALL, note_every=2)
    line = replace(job, minutes=1e-9).run()  # stops before its first step, with a checkpoint
    assert "0 of 6 steps" in line
    from models.policy import training

    former = training.PolicyTrainer.train_step
    with pytest.MonkeyPatch.context() as patch:

        def interrupted(trainer: training.PolicyTrainer) -> dict[str, float]:
            if trainer.step == 3:
                trainer.save(tmp_path / "parts" / "checkpoint" / "state.pt")
                raise KeyboardInterrupt
            return former(trainer)

        patch.setattr(training.PolicyTrainer, "train_step", interrupted)
        with pytest.raises(KeyboardInterrupt):
            job.run()
    job.run()
    assert (tmp_path / "parts" / FILE).read_bytes() == (whole / FILE).read_bytes()
    assert (tmp_path / "parts" / "curve.csv").read_text() == (whole / "curve.csv").read_text()
    assert len((whole / "curve.csv").read_text().splitlines()) == 1 + 3


def test_other_settings_do_not_continue_a_training(demonstrations: Path, tmp_path: Path) -> None:
    out = train(demonstrations, tmp_path / "out")
    with pytest.raises(ConfigError, match="steps: 6 -> 7"):
        train(demonstrations, out, replace(SMALL, steps=7))


def test_a_policy_knows_its_features_and_assets(demonstrations: Path, tmp_path: Path) -> None:
    weights = load_policy(train(demonstrations, tmp_path / "out") / FILE)
    episodes = list(read_episodes(str(demonstrations)))
    assert weights.features == episodes[0].features
    assert sorted(weights.assets or ()) == sorted({asset for e in episodes for asset in e.subject_assets or ()})
    other = replace(weights.features, robot="panda")
    with pytest.raises(ConfigError, match=r"its robot is .simple., but that of the environment is .panda.") as caught:
        check_environment(weights.features, other, "mine")
    assert caught.value.code == "policy_mismatch"


def test_a_damaged_file_is_refused(demonstrations: Path, tmp_path: Path) -> None:
    out = train(demonstrations, tmp_path / "out")
    content = (out / FILE).read_bytes()
    (out / FILE).write_bytes(content[: len(content) // 2])
    with pytest.raises(ConfigError) as caught:
        open_policy(str(out))
    assert caught.value.code == "checkpoint_invalid"
    shutil.rmtree(out / "weights")
    with pytest.raises(ConfigError, match="there is no"):
        open_policy(str(out))


def test_failed_and_long_demonstrations_are_left_out(demonstrations: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="2 are longer than 3 actions") as caught:
        train(demonstrations, tmp_path / "out", replace(SMALL, max_actions=3))
    assert caught.value.code == "set_empty"
    line = PolicyTrainingJob(str(demonstrations), tmp_path / "one", settings=replace(SMALL, max_episodes=1)).run()
    assert "on 1 demonstrations of 1 scenes, 1 left out (beyond_max_episodes 1)" in line
