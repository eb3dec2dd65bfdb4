"""The evaluate-policy job: episodes of a policy in the scenes of a run, as the table ``episodes``."""

import sys
from collections import Counter
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import polars as pl

from models.policy.chunk_policy import OpenedPolicy, open_policy
from pipelines.demonstrate.episodes_job import EpisodesJob
from pipelines.evaluate_policy.report import write_evaluation_report
from pipelines.evaluate_policy.settings import EvaluatePolicySettings
from pipelines.evaluate_policy.shard import EXPERT, OPENING, EvaluatePolicyStep
from pipelines.execution.ray_executor import WorkerPool
from pipelines.execution.shard_job import run_job
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.scores.intervals import wilson_interval
from stable_data.storage.run_folder import RunFolder

SEEN, UNSEEN, UNKNOWN = "seen in training", "not seen in training", "not known"
"""Whether the demonstrations acted on the assets that an episode acts on."""


def evaluate_policy(
    policy: str,
    scenes: str,
    out: str,
    settings: EvaluatePolicySettings,
    workers: WorkerPool,
    *,
    where: str = "",
    report: bool = True,
) -> dict[str, Any]:
    """Runs the job, or its missing shards; see :func:`pipelines.execution.shard_job.run_job`."""
    return run_job(EvaluatePolicyJob(policy, scenes, settings, where), out, workers, report=report)


def settings_for(policy: str) -> EvaluatePolicySettings:
    """Returns the default settings with the robot, the control and the cameras of a policy.

    Raises:
        ConfigError: The policy cannot be opened.
    """
    features = None if policy == EXPERT else open_policy(policy).features
    found = EvaluatePolicySettings()
    if features is None:
        return found
    height, width = features.image_size or (found.image_height, found.image_width)
    return replace(
        found,
        robot=features.robot,
        control=features.control,
        cameras=frozenset(features.cameras),
        image_height=height,
        image_width=width,
    )


class EvaluatePolicyJob(EpisodesJob):
    """Lets a policy act in the scenes of a run.

    Args:
        policy: A folder of train-policy, ``module:function``, or ``expert``; every node of a cluster must see it.
        scenes: The run, with the tables ``scenes``, ``assets`` and ``meshes``; every node must see it.
        settings: The job's settings.
        where: A condition on ``scenes``; empty: all of them.

    Raises:
        ConfigError: The policy cannot be opened, or does not fit robot and control (``policy_mismatch``); the run lacks a table, the
            condition is none or selects nothing, or the files of the robot are missing.
    """

    name = "evaluate-policy"
    settings: EvaluatePolicySettings

    def __init__(self, policy: str, scenes: str, settings: EvaluatePolicySettings, where: str = "") -> None:
        super().__init__(scenes, settings, where)
        folder = Path(policy).expanduser()
        self.policy = str(folder.resolve()) if folder.exists() else policy
        self.opened: OpenedPolicy | None = None if policy == EXPERT else open_policy(self.policy)
        if self.opened is not None and self.opened.features is not None:
            features = self.opened.features
            for key, was, now in (
                ("robot", features.robot, settings.robot),
                ("control", features.control, settings.control),
            ):
                if was != now:
                    raise ConfigError(
                        f"policy {self.opened.name}: its {key} is {was}, but setting evaluate_policy.{key} is {now}, expected the same; "
                        "leave the setting out",
                        "policy_mismatch",
                    )

    def inputs(self) -> dict[str, Any]:
        """Hashes of the policy and of the tables, and the condition."""
        fingerprint = EXPERT if self.opened is None else self.opened.fingerprint
        return {"policy": fingerprint, **self.scenes.inputs()}

    def about(self) -> dict[str, Any]:
        """The policy, and the number of scenes and of episodes."""
        return {
            "policy": EXPERT if self.opened is None else self.opened.name,
            "scenes_fingerprint": content_id(self.scenes.inputs()),
            "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
            **super().about(),
        }

    def step(self) -> EvaluatePolicyStep:
        """The step that lets the policy act."""
        return EvaluatePolicyStep(self.scenes.run, self.policy, self.settings)

    @cached_property
    def assets(self) -> frozenset[str] | None:
        """Assets that the demonstrations of the policy acted on; None: not known."""
        return None if self.opened is None else self.opened.assets

    def finish(self, folder: RunFolder) -> dict[str, Any]:
        """Counts successes. An episode in which the policy crashed or took too long is a failure of the policy.

        An episode that could not begin is none of its attempts.
        """
        rows = attempts(folder, self.assets)
        reasons = Counter(str(reason).partition(":")[0] for reason in rows.filter(~pl.col("success"))["reason"])
        never = folder.table("failures", ["step"])["step"].to_pylist().count(OPENING)
        counts = {
            "attempts": rows.height,
            "successes": int(rows["success"].sum()),
            "never_began": never,
            "by_reason": dict(sorted(reasons.items())),
        }
        counts["interval"] = [round(x, 4) for x in wilson_interval(counts["successes"], counts["attempts"])]
        for key in ("task_kind", "assets"):
            counts[f"by_{key}"] = {
                str(value): [int(part["success"].sum()), part.height]
                for (value,), part in sorted(rows.group_by(key), key=lambda of: str(of[0]))
            }
        return counts

    def report(self, folder: RunFolder, manifest: dict[str, Any]) -> None:
        """Writes the report page."""
        write_evaluation_report(folder, manifest, attempts(folder, self.assets))


def attempts(folder: RunFolder, known: frozenset[str] | None) -> pl.DataFrame:
    """Returns the attempts of a run, a row each: episode_id, scene_id, task_kind, success, reason, seconds, assets.

    Args:
        folder: The run.
        known: Assets that the demonstrations acted on; None: not known.
    """
    columns = (
        "episode_id",
        "scene_id",
        "task_kind",
        "success",
        "reason",
        "num_steps",
        "fps",
        "asset_ids",
        "subjects",
        "instances",
    )
    rows: list[dict[str, Any]] = [
        {key: row[key] for key in columns[:5]} | {"seconds": row["num_steps"] / row["fps"], "assets": _seen(row, known)}
        for row in folder.table("episodes", columns).to_pylist()
    ]
    failed = {"task_kind": UNKNOWN, "success": False, "seconds": None, "assets": UNKNOWN}
    rows += [
        failed | {"episode_id": row["id"], "scene_id": row["id"].rpartition("/")[0], "reason": row["code"]}
        for row in folder.table("failures", ["id", "step", "code"]).to_pylist()
        if row["step"] != OPENING
    ]
    kinds = {"episode_id": pl.String, "scene_id": pl.String, "task_kind": pl.String, "success": pl.Boolean, "reason": pl.String}
    return pl.DataFrame(rows, schema=kinds | {"seconds": pl.Float64, "assets": pl.String})


def _seen(row: dict[str, Any], known: frozenset[str] | None) -> str:
    if known is None or row["asset_ids"] is None or row["subjects"] is None:
        return UNKNOWN
    assets = dict(zip(row["instances"], row["asset_ids"], strict=True))
    return SEEN if all(assets[name] in known for name in row["subjects"]) else UNSEEN
