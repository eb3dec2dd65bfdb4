"""The card of a published run: README.md, with the head that Hugging Face reads."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from stable_data.errors import plain_markdown
from stable_data.storage.row_groups import SPLITS

UNSPLIT = "unsplit"
"""Stands for the split of rows that have none."""

KEYWORDS = ("tabletop", "3d-scenes", "simulation", "robotics", "mujoco", "stable-data")
"""What a dataset is found by."""

_NO_WORD = re.compile(r"[^A-Za-z0-9_]+")
_LONGEST_SPLIT = 40  # characters

NOT_KNOWN, ROWS_NOT_STATED = "not known", "not stated for the rows"
"""Stand for a licence in lists of licences."""

LICENCE_FILE, ATTRIBUTION_FILE, CROISSANT_FILE = "licences.parquet", "ATTRIBUTION.md", "croissant.json"

_HUB_LICENCES = {
    **{name: name.lower() for name in ("CC0-1.0", "MIT", "Apache-2.0", "BSD-2-Clause", "BSD-3-Clause", "Zlib", "Unlicense")},
    **{
        f"CC-{kind}-{version}": f"cc-{kind.lower()}-{version}"
        for kind in ("BY", "BY-SA", "BY-NC", "BY-NC-SA", "BY-ND", "BY-NC-ND")
        for version in ("2.0", "3.0", "4.0")
    },
    "ODC-By-1.0": "odc-by",
}
"""SPDX identifier -> the name by which Hugging Face knows the licence."""

_SIZES = (
    (10**3, "n<1K"),
    (10**4, "1K<n<10K"),
    (10**5, "10K<n<100K"),
    (10**6, "100K<n<1M"),
    (10**7, "1M<n<10M"),
    (10**8, "10M<n<100M"),
    (10**9, "100M<n<1B"),
    (10**10, "1B<n<10B"),
    (10**11, "10B<n<100B"),
    (10**12, "100B<n<1T"),
)

ABOUT = {
    "scenes": "tabletop scenes with their verdicts",
    "rejected": "scenes that were made but not accepted",
    "corrections": "what the correction did to each scene",
    "turns": "what the reasoner was asked and what it answered",
    "settled": "poses after the scenes settled in MuJoCo",
    "grasps": "grasps that a robot tried",
    "ratings": "ratings of scenes",
    "samples": "training samples of the reasoner, one for each stage of a scene",
    "edits": "edits of scenes by instructions",
    "assets": "assets with their mass properties and surface points",
    "sdf": "signed-distance grids of assets",
    "features": "point features of assets",
    "meshes": "meshes of assets, with convex parts",
    "measured": "sizes of assets whose unit was estimated",
    "textures": "images of the looks of meshes",
    "episodes": "episodes of a robot",
    "views": "pictures of scenes and their features",
    "warnings": "remarks on rows that deserve a look",
    "failures": "items that could not be used, with the reason",
}
"""Name of a table -> what a row of it is."""


@dataclass(frozen=True, slots=True)
class PublishedTable:
    """A table of a published run.

    Attributes:
        name: The table.
        rows: Number of rows by the name of a split (:class:`SplitNames`).
        num_bytes: Size of its files.
    """

    name: str
    rows: Mapping[str, int]
    num_bytes: int

    @property
    def num_rows(self) -> int:
        """Number of all rows."""
        return sum(self.rows.values())

    def data_files(self) -> list[tuple[str, str]]:
        """Returns the name of a split for a hub, and the pattern of its files; a table without splits is one, ``train``."""
        if set(self.rows) <= {UNSPLIT}:
            return [("train", f"{self.name}/part-{UNSPLIT}.*.parquet")]
        names = sorted(self.rows, key=lambda name: (SPLITS.index(name) if name in SPLITS else len(SPLITS), name))
        return [(split, f"{self.name}/part-{split}.*.parquet") for split in names]


class SplitNames:
    """The names of splits that dataset hubs and names of files allow: of letters, digits and underscores.

    A usual name stays. ``all`` is no name, because it stands for all splits together, and no two names differ in case alone.
    """

    def __init__(self) -> None:
        self._names = dict[str, str]()

    def of(self, split: str | None) -> str:
        """Returns the name for a value of the column ``split``; :data:`UNSPLIT` if it is null or empty."""
        split = split or ""
        if split not in self._names:
            first = _NO_WORD.sub("_", split).strip("_")[:_LONGEST_SPLIT] or UNSPLIT
            taken, name, number = {other.casefold() for other in self._names.values()} | {"all"}, first, 1
            while name.casefold() in taken:
                number += 1
                name = f"{first}_{number}"
            self._names[split] = name
        return self._names[split]


@dataclass(frozen=True, slots=True)
class CardContent:
    """What a card says.

    Attributes:
        title: Title of the dataset.
        origin: The manifest of the run that was published, without what is private.
        tables: Its tables, those with rows.
        licences: Number of assets by licence, :data:`NOT_KNOWN` among them.
        row_licence: Licence of the rows themselves, as an SPDX identifier; None if the publisher states none.
        verdict: What ``verify`` said of the run.
        figures: Lines on the verdicts of the scenes.
        previews: Names of pictures in the folder.
        citation: How to cite the dataset; empty if the publisher does not say.
    """

    title: str
    origin: Mapping[str, Any]
    tables: Sequence[PublishedTable]
    licences: Mapping[str, int]
    row_licence: str | None
    verdict: str
    figures: Sequence[str]
    previews: Sequence[str]
    citation: str = ""

    @property
    def main(self) -> PublishedTable:
        """The table that a hub shows first."""
        first = ("scenes", "episodes", "ratings", "views", "edits", "assets")
        by_name = {table.name: table for table in self.tables}
        return next((by_name[name] for name in first if name in by_name), self.tables[0])


def _without_verdicts(tables: Sequence[PublishedTable]) -> str:
    """The option for a run whose verdicts cannot be computed again: its meshes were in a dataset beside it."""
    names = {table.name for table in tables}
    return " --verdicts none" if "scenes" in names and "meshes" not in names else ""


def card_text(content: CardContent) -> str:
    """Returns the content of ``README.md``."""
    return f"---\n{_yaml(_head(content))}---\n\n{_body(content)}"


def hub_licence(content: CardContent) -> dict[str, str]:
    """Returns the entries of a card's head that state the licence: a known name if all content has it, else all in one word."""
    every = list_licences(content)
    if every == [ROWS_NOT_STATED] and not content.licences:
        return {"license": "unknown"}
    if len(every) == 1 and every[0] in _HUB_LICENCES:
        return {"license": _HUB_LICENCES[every[0]]}
    link = ATTRIBUTION_FILE if content.licences else "README.md"
    name = re.sub(r"[^a-z0-9.]+", "-", " and ".join(every).lower()).strip("-")  # the hub takes one word
    return {"license": "other", "license_name": name, "license_link": link}


def list_licences(content: CardContent) -> list[str]:
    """Returns every licence of the content: that of the rows, then those of the assets, each once; also that one is not known."""
    return list(dict.fromkeys([content.row_licence or ROWS_NOT_STATED, *sorted(content.licences)]))


def size_category(count: int) -> str:
    """Returns the size of a dataset in the words of Hugging Face."""
    return next((name for limit, name in _SIZES if count < limit), "n>1T")


def _head(content: CardContent) -> dict[str, Any]:
    configs: list[dict[str, Any]] = []
    for table in content.tables:
        files = [{"split": split, "path": path} for split, path in table.data_files()]
        configs.append({"config_name": table.name, "data_files": files} | ({"default": True} if table is content.main else {}))
    if content.licences:
        configs.append({"config_name": "licences", "data_files": [{"split": "train", "path": LICENCE_FILE}]})
    return {
        "pretty_name": content.title,
        **hub_licence(content),
        "task_categories": ["robotics"],
        "tags": [*KEYWORDS, "croissant"],
        "size_categories": [size_category(content.main.num_rows)],
        "configs": configs,
    }


def _body(content: CardContent) -> str:
    origin, main = content.origin, content.main
    dataset = plain_markdown(str(origin.get("dataset")))
    lines = [
        f"# {plain_markdown(content.title)}",
        "",
        f"{main.num_rows:,} rows of {ABOUT[main.name]}, made by `{origin.get('job')}` of stable-data from {dataset}.",
        "",
        *(f"![{name}]({name})" for name in content.previews),
        *([""] if content.previews else []),
        f"Checked before it was published: {plain_markdown(content.verdict)}",
        "",
        *(f"- {line}" for line in content.figures),
        *([""] if content.figures else []),
        "## Tables",
        "",
        "| table | a row is | rows | splits | MB |",
        "|---|---|---|---|---|",
    ]
    for table in content.tables:
        splits = ", ".join(f"{name} {count:,}" for name, count in table.rows.items()) if set(table.rows) != {UNSPLIT} else ""
        lines.append(
            f"| {table.name} | {ABOUT.get(table.name, '')} | {table.num_rows:,} | {splits} | {table.num_bytes / 1e6:.1f} |"
        )
    lines += [
        "",
        "`schemas/tables.json` gives meaning, type and unit of every column. Unknown is null, and never a pass. Frame of a scene: the "
        "table top is z = 0 with its near-left corner at the origin, +x right, +y away from the viewer, z up; metres, kilograms, radians; "
        "quaternions are x, y, z, w.",
        "",
        "## Use",
        "",
        "```python",
        "from datasets import load_dataset",
        "",
        f'rows = load_dataset("this folder or its name on the hub", "{main.name}")',
        "```",
        "",
        "The folder is also a run of stable-data: its tables load with `pyarrow`, `polars` and `duckdb`, and "
        f"`stable-data verify{_without_verdicts(content.tables)}` checks it. `SHA256SUMS` has the checksum of every file "
        "(`sha256sum -c SHA256SUMS`).",
        "",
        "## How it was made",
        "",
        "```json",
        json.dumps(origin, indent=1, sort_keys=True, ensure_ascii=False),
        "```",
        "",
        "## Licences",
        "",
        f"Of the rows themselves: {plain_markdown(content.row_licence or '') or 'not stated by the publisher'}.",
        "",
    ]
    if content.licences:
        lines += [
            f"Of the assets, one by one, in `{LICENCE_FILE}`; {ATTRIBUTION_FILE} says what they ask for. Meshes are repaired ones.",
            "",
            "| licence | assets |",
            "|---|---|",
            *(f"| {plain_markdown(licence)} | {count:,} |" for licence, count in sorted(content.licences.items())),
            "",
        ]
    if content.citation:
        lines += ["## Citation", "", content.citation, ""]
    return "\n".join(lines)


def _yaml(value: Mapping[str, Any], indent: str = "") -> str:
    """Returns a mapping as YAML; texts are written as JSON, which YAML contains."""
    lines = []
    for key, entry in value.items():
        if isinstance(entry, list):
            lines.append(f"{indent}{key}:")
            for item in entry:
                if isinstance(item, dict):
                    first, *rest = _yaml(item, f"{indent}  ").splitlines()
                    lines += [f"{indent}- {first.strip()}", *rest]
                else:
                    lines.append(f"{indent}- {_scalar(item)}")
        else:
            lines.append(f"{indent}{key}: {_scalar(entry)}")
    return "".join(f"{line}\n" for line in lines)


def _scalar(value: object) -> str:
    return json.dumps(value, ensure_ascii=False)
