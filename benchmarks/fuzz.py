"""Gives changed inputs to every reader, and looks for crashes, hangs, memory, escapes and false verdicts.

``python -m benchmarks.fuzz OUT [--count 1000000] [--workers 2] [--minutes M] [--target NAME ...] [--seed 0] [--json FILE]``. OUT holds
the state: the same command continues a stopped one, and counts and processor time are summed. Input number k of a target depends on the
seed, the target and k alone. Findings are in OUT/findings, made small, each different one once. A command first runs those again that are
left: one that ends well now is mended if the code has changed, and else it did not come again and is left.

``--summary`` prints the figures of all commands so far, and runs nothing.

``--replay PLACE`` runs one input and says how it ends: ``TARGET/NUMBER``, or a stored file ``FOLDER/TARGET/BASE/NAME/PATH``.

An input may end with a result, or with an error of this project: with a code, and one line. docs/fuzzing.md says what else is watched.
"""

import argparse
import json
import signal
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.fuzzing.campaign import STATE, TARGETS, Campaign
from benchmarks.fuzzing.cases import Case
from benchmarks.fuzzing.watching import FindingKind
from stable_data.errors import ConfigError, StableDataError, one_line


@dataclass(frozen=True, slots=True)
class FuzzFigure:
    """The figures of a target.

    Attributes:
        target: The target.
        planned: Inputs that it is to have.
        inputs: Inputs that were run.
        accepted: Share of them with a result.
        reasons: Different codes of refusals.
        per_second: Inputs for each second of processor time.
        core_seconds: Processor time, seconds.
        findings: Different findings.
        left: Those of them that are not mended.
    """

    target: str
    planned: int
    inputs: int
    accepted: float
    reasons: int
    per_second: float
    core_seconds: float
    findings: int
    left: int


def figures(campaign: Campaign) -> list[FuzzFigure]:
    """Returns the figures of all targets that have inputs."""
    found = []
    for name, counts in campaign.state.targets.items():
        of_target = [known for known in campaign.state.findings.values() if known.target == name]
        share, rate = counts.accepted / max(counts.done, 1), counts.done / max(counts.seconds, 1e-9)
        found.append(
            FuzzFigure(
                name,
                counts.planned,
                counts.done,
                round(share, 4),
                len(counts.codes),
                round(rate, 1),
                round(counts.seconds, 1),
                len(of_target),
                sum(not known.is_mended for known in of_target),
            )
        )
    return found


def by_kind(campaign: Campaign) -> dict[str, dict[str, int]]:
    """Returns the different findings of each kind: how many were found, mended, are left, and of these did not come again."""
    counts = {str(kind): {"found": 0, "mended": 0, "left": 0, "not_again": 0} for kind in FindingKind}
    for known in campaign.state.findings.values():
        of_kind = counts[str(known.finding.kind)]
        of_kind["found"] += 1
        of_kind["mended" if known.is_mended else "left"] += 1
        of_kind["not_again"] += known.not_again > 0 and not known.is_mended
    return counts


def show(campaign: Campaign) -> None:
    """Prints the figures of all commands in the folder of a campaign: by target, by kind of finding, and in all."""
    found = figures(campaign)
    print(f"{'target':<22}{'inputs':>10}{'accepted':>10}{'reasons':>9}{'per s':>9}{'core s':>10}{'findings':>10}{'left':>6}")
    for one in found:
        share, rate, seconds = f"{100 * one.accepted:.1f} %", f"{one.per_second:.0f}", f"{one.core_seconds:.0f}"
        print(
            f"{one.target:<22}{one.inputs:>10}{share:>10}{one.reasons:>9}{rate:>9}{seconds:>10}{one.findings:>10}{one.left:>6}"
        )
    print(f"{'kind of finding':<22}{'found':>10}{'mended':>10}{'left':>9}{'not again':>10}")
    kinds = by_kind(campaign)
    for kind, counts in kinds.items():
        print(f"{kind:<22}{counts['found']:>10}{counts['mended']:>10}{counts['left']:>9}{counts['not_again']:>10}")
    inputs, seconds_of_all = sum(one.inputs for one in found), sum(one.core_seconds for one in found)
    planned, findings = sum(one.planned for one in found), sum(counts["found"] for counts in kinds.values())
    left = sum(counts["left"] for counts in kinds.values())
    print(
        f"{inputs} of {planned} inputs, seed {campaign.state.seed}, {seconds_of_all / 3600:.2f} core hours, "
        f"{findings} different findings, {left} left"
    )


def totals(campaign: Campaign) -> dict[str, Any]:
    """Returns all figures as values of JSON."""
    found = figures(campaign)
    return {
        "seed": campaign.state.seed,
        "inputs": sum(one.inputs for one in found),
        "core_hours": round(sum(one.core_seconds for one in found) / 3600, 3),
        "kinds": by_kind(campaign),
        "findings": [
            {"place": known.folder, "inputs": known.count, "is_mended": known.is_mended, "not_again": known.not_again}
            for known in campaign.state.findings.values()
        ],
        "targets": [asdict(one) for one in found],
    }


def placed_case(campaign: Campaign, place: str) -> tuple[str, Case]:
    """Returns the target and the input that ``--replay`` names.

    Raises:
        ConfigError: There is none (``case_unknown``).
    """
    parts = Path(place).parts
    if len(parts) == 2 and parts[1].isdecimal() and parts[0] in campaign.targets:
        return parts[0], campaign.targets[parts[0]].case(campaign.state.seed, int(parts[1]))
    path = Path(place)
    for k in range(len(parts) - 3):
        target = campaign.targets.get(parts[k])
        if path.is_file() and target is not None and parts[k + 1] in target.bases:
            return parts[k], Case(parts[k + 1], "/".join(parts[k + 3 :]), path.read_bytes())
    expected = "TARGET/NUMBER, or a file FOLDER/TARGET/BASE/NAME/PATH"
    raise ConfigError(f"--replay is {place!r}, expected {expected}; targets are {', '.join(campaign.targets)}", "case_unknown")


def main(arguments: Sequence[str] | None = None, registry: str = TARGETS) -> int:
    """Runs the command; the status is 1 if findings are left, and 2 if it could not start."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the state and of the findings")
    parser.add_argument("--count", type=int, default=1_000_000, help="inputs in all, with those of earlier commands")
    parser.add_argument("--workers", type=int, default=2, help="processes that run inputs")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="time after which no further inputs are started")
    parser.add_argument("--target", action="append", default=[], metavar="NAME", help="only these targets; the count is theirs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--replay", metavar="PLACE", help="run one input: TARGET/NUMBER, or a stored file")
    parser.add_argument("--summary", action="store_true", help="print the figures of all commands in OUT; run nothing")
    parser.add_argument("--list", action="store_true", help="list the targets")
    parser.add_argument("--json", type=Path, help="output file of the figures")
    options = parser.parse_args(arguments)
    try:
        if options.summary and not (options.out / STATE).is_file():
            raise ConfigError(f"{options.out}: has no {STATE}, expected the folder of a campaign", "campaign_invalid")
        campaign = Campaign(options.out, options.seed, max(1, options.workers), registry)
        if options.list:
            for name, target in campaign.targets.items():
                print(f"{name:<22}{target.share:>8.1f}  {', '.join(target.bases)}")
            return 0
        if options.replay is not None:
            return _replay(campaign, options.replay)
        if not options.summary:
            campaign.plan(options.count, options.target)
            try:
                campaign.recheck(_tell)
                campaign.run(60 * options.minutes, options.target, _tell)
                campaign.reduce(_tell)
            except KeyboardInterrupt:
                print("interrupted; the same command continues", file=sys.stderr)
    except StableDataError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    show(campaign)
    if options.json is not None:
        options.json.write_text(json.dumps(totals(campaign), indent=2) + "\n", "utf-8")
    return int(any(not known.is_mended for known in campaign.state.findings.values()))


def _tell(line: str) -> None:
    print(one_line(line)[:400], flush=True)


def _replay(campaign: Campaign, place: str) -> int:
    name, case = placed_case(campaign, place)
    outcome = campaign.replay(name, case)
    ending = "accepted" if outcome.is_accepted else f"refused: {outcome.code or 'left out'}"
    if outcome.finding is not None:
        ending = f"{outcome.finding.key}\n{outcome.finding.message}\n{outcome.finding.trace}"
    print(f"{name}, base {case.base}, {case.path}, {len(case.content)} bytes, {outcome.seconds:.2f} s: {ending}")
    return int(outcome.finding is not None)


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # also where a shell that started it in the background ignores the first
        signal.signal(number, signal.default_int_handler)
    sys.exit(main())
