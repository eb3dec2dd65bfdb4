"""The leaderboard of policies: ``python -m benchmarks.leaderboard add RUN [--name NAME] [--scenes NAME]``, and ``show``.

RUN is a finished run of ``python -m pipelines evaluate-policy``. Its line replaces that of the same policy on the same episodes.
Lines are compared with each other only within one block: the same scenes, condition, task, robot and settings of the episodes.
"""

import argparse
import csv
import io
import shlex
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipelines.evaluate_policy.settings import EvaluatePolicySettings
from pipelines.reports.text_table import align_columns
from stable_data.atomic_files import write_file_atomically
from stable_data.content_id import content_id
from stable_data.errors import ConfigError
from stable_data.scores.intervals import wilson_interval
from stable_data.storage.manifest import read_manifest
from stable_data.storage.run_folder import RunFolder

FILE = Path(__file__).with_name("leaderboard.csv")
"""The leaderboard of this repository."""


@dataclass(frozen=True, slots=True)
class Line:
    """The result of one policy on one set of episodes.

    Attributes:
        policy: Its name.
        scenes: Name of the run of the scenes.
        where: Condition on the scenes; empty: all.
        task: ``scene``, the tasks of the scenes, or ``pick``.
        robot: Name of the robot.
        successes: Episodes that fulfil their goal.
        attempts: All episodes that began.
        low: Lower end of the 95 % interval of the success rate (Wilson).
        high: Upper end.
        never_began: Episodes that could not begin, which are no attempts.
        control: Meaning of an action.
        policy_fingerprint: Hash of the weights or the source of the policy.
        episodes_fingerprint: Hash of scenes, condition and settings of the episodes.
        code_version: Version of this library.
        command: The command of the evaluation; of its paths the last part.
        date: Day on which the line was added, UTC.
    """

    policy: str
    scenes: str
    where: str
    task: str
    robot: str
    successes: int
    attempts: int
    low: float
    high: float
    never_began: int
    control: str
    policy_fingerprint: str
    episodes_fingerprint: str
    code_version: str
    command: str
    date: str

    @property
    def key(self) -> tuple[str, str]:
        """What a line is about: another one with this key is replaced."""
        return self.policy_fingerprint, self.episodes_fingerprint


def line_of(run: str, name: str = "", scenes: str = "") -> Line:
    """Returns the line of an evaluation.

    Args:
        run: Folder or URI of the run.
        name: Name of the policy; empty: that of the run.
        scenes: Name of the scenes; empty: that of their run.

    Raises:
        ConfigError: It is not a finished run of evaluate-policy (``run_invalid``), or nothing was attempted (``set_empty``).
    """
    manifest = read_manifest(RunFolder(run))
    job, status = (manifest or {}).get("job"), (manifest or {}).get("status")
    if manifest is None or job != "evaluate-policy" or status != "complete":
        found = "no run" if manifest is None else f"a run of {job} that is {status}"
        raise ConfigError(f"{run}: is {found}, expected a complete run of evaluate-policy", "run_invalid")
    counts, settings = manifest["counts"], manifest["settings"]
    if not counts["attempts"]:
        raise ConfigError(f"{run}: no episode began, expected at least one", "set_empty")
    low, high = wilson_interval(counts["successes"], counts["attempts"])
    aside = {"scenes_per_shard", *EvaluatePolicySettings.ASIDE}  # which change no episode
    of_episodes = {key: value for key, value in settings.items() if key not in aside}
    inputs = {key: value for key, value in manifest["inputs"].items() if key != "policy"}
    return Line(
        policy=name or manifest["policy"],
        scenes=scenes or manifest["dataset"],
        where=inputs["where"],
        task=settings["task"],
        robot=settings["robot"],
        successes=counts["successes"],
        attempts=counts["attempts"],
        low=round(low, 3),
        high=round(high, 3),
        never_began=counts["never_began"],
        control=settings["control"],
        policy_fingerprint=manifest["inputs"]["policy"],
        episodes_fingerprint=content_id(inputs, of_episodes),
        code_version=manifest["code_version"],
        command=_public(manifest["command"]),
        date=f"{datetime.now(UTC):%Y-%m-%d}",
    )


def _public(command: str) -> str:
    """The command without the folders of the machine on which it ran."""
    return shlex.join(word.rstrip("/").rpartition("/")[2] if "/" in word else word for word in shlex.split(command))


def read_lines(file: Path) -> list[Line]:
    """Reads a leaderboard; none if there is no file.

    Raises:
        ConfigError: The file has other columns, or a value is not of its kind (``leaderboard_invalid``).
    """
    if not file.is_file():
        return []
    kinds = {field.name: field.type for field in fields(Line)}
    with file.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        if tuple(reader.fieldnames or ()) != tuple(kinds):
            raise ConfigError(f"{file}: has columns {reader.fieldnames}, expected {list(kinds)}", "leaderboard_invalid")
        rows = list(reader)
    try:
        return [Line(**{name: _value(row[name], kind) for name, kind in kinds.items()}) for row in rows]
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{file}: {error}, expected a line as `add` writes it", "leaderboard_invalid") from error


def _value(text: str, kind: Any) -> Any:
    return kind(text)


def with_line(lines: Sequence[Line], new: Line) -> list[Line]:
    """Returns the lines with a new one, sorted: blocks of the same episodes, the best policy of each first."""
    kept = [line for line in lines if line.key != new.key]
    return sorted(
        [*kept, new],
        key=lambda line: (line.scenes, line.task, line.episodes_fingerprint, -line.successes / line.attempts, line.policy),
    )


def write_lines(file: Path, lines: Sequence[Line]) -> None:
    """Writes a leaderboard atomically."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Line)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(line) for line in lines)
    write_file_atomically(file, text.getvalue().encode())


def leaderboard_text(lines: Sequence[Line]) -> str:
    """Returns the lines as a text table."""
    head = ["scenes", "task", "robot", "policy", "successes", "rate", "95 %"]
    rows = [
        [
            line.scenes + (f" where {line.where}" if line.where else ""),
            line.task,
            line.robot,
            line.policy,
            f"{line.successes}/{line.attempts}",
            f"{line.successes / line.attempts:.0%}",
            f"{line.low:.0%} - {line.high:.0%}",
        ]
        for line in lines
    ]
    return align_columns([head, *rows], 4)


def main(arguments: Sequence[str] | None = None) -> None:
    """Adds a line, or shows all of them."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--file", type=Path, default=FILE, help="the leaderboard; default: that of this repository")
    verbs = parser.add_subparsers(dest="verb", required=True)
    adding = verbs.add_parser("add", help="add the result of an evaluation")
    adding.add_argument("run", help="a finished run of evaluate-policy")
    adding.add_argument("--scenes", default="", help="name of the scenes; default: that of the folder of their run")
    adding.add_argument("--name", default="", help="name of the policy; default: that of its folder or module")
    verbs.add_parser("show", help="print the leaderboard")
    chosen = parser.parse_args(arguments)
    try:
        lines = read_lines(chosen.file)
        if chosen.verb == "add":
            lines = with_line(lines, line_of(chosen.run, chosen.name, chosen.scenes))
            write_lines(chosen.file, lines)
    except ConfigError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from error
    print(leaderboard_text(lines) if lines else f"{chosen.file}: no lines yet")


if __name__ == "__main__":
    main()
