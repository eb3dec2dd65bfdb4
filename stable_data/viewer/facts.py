"""What is shown beside a scene: its objects, relations, task and verdicts, as HTML.

All text comes from data and is escaped. A value that is not known is shown as unknown.
"""

from collections import OrderedDict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from html import escape
from importlib.resources import files
from typing import Any

from stable_data.assets.run_assets import RowsOfAssets
from stable_data.scene import Scene, SceneObject
from stable_data.simulation.scene_geometry import SceneGeometry
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row
from stable_data.storage.table_rows import card_columns

UNKNOWN = '<span class="unknown">unknown</span>'

_ASSET_COLUMNS = ("asset_id", "licence", "source", "author", "source_url")
_ASSETS_KEPT = 10_000  # rows of assets in memory
_LISTED = 400  # objects or relations of a scene that are listed
_LONGEST = 600  # characters of a text that are shown
_HEADLINE = (
    "clean",
    "stable",
    "num_objects",
    "max_penetration_mm",
    "table_penetration_mm",
    "float_rate",
    "out_of_bounds_rate",
    "settle_move_max_mm",
)
"""Columns of the metric card that are shown first."""

_COLOURS = (
    "--ink: #1d2430; --soft: #667085; --line: #e3e7ee; --page: #fbfbfa; --accent: #35618e; --bad: #b3473c; --good: #3b7d5a; "
    "--unknown: #8a6d1f;"
)

_FAULTS = {
    "floats": "floats",
    "leaves_table": "leaves the table",
    "enters_restricted_zone": "in the restricted zone",
}


@cache
def style(scope: str | None = None) -> str:
    """Returns the style sheet of the HTML that this module makes.

    Args:
        scope: Selector of the element that contains the HTML, on a page of another program; None: it is for the whole page.
    """
    rules = files("stable_data.viewer").joinpath("facts.css").read_text("utf-8")
    return f":root {{ {_COLOURS} }}\n{rules}" if scope is None else f"{scope} {{ {_COLOURS} padding: 6px 12px;\n{rules} }}"


class AssetNotes:
    """Licence and origin of the assets of a run, read on demand. A run may lack the table ``assets``: then all are unknown.

    Args:
        run: The run.
    """

    def __init__(self, run: RunFolder) -> None:
        others = [name for name in SCHEMAS["assets"].names if name not in _ASSET_COLUMNS]
        here = RunFolder(run.root) if run.is_local else run  # a job may have another working folder by now
        self._rows = RowsOfAssets(here, "assets", others) if run.files("assets") else None
        self._recent: OrderedDict[str, Row | None] = OrderedDict()

    def of(self, asset_id: str | None) -> Row | None:
        """Returns licence, source, author and address of an asset; None if they are not known."""
        if asset_id is None or self._rows is None:
            return None
        if asset_id not in self._recent:
            self._recent[asset_id] = self._rows.row(asset_id)
            if len(self._recent) > _ASSETS_KEPT:
                self._recent.popitem(last=False)
        return self._recent[asset_id]


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """What is known of a scene beside its geometry.

    Attributes:
        scene: The scene.
        has_mesh: Whether each object has a mesh, in the order of the scene; a box replaces a missing one.
        assets: Licence and origin of the asset of each object, in the same order; None if unknown.
        card: Columns of the metric card; None if the scene was not judged.
        verdicts: Instance -> its row of the column ``verdicts``.
        pairs: Rows of the column ``pairs``.
        remark: Why a scene was rejected, or another remark; empty without one.
    """

    scene: Scene
    has_mesh: Sequence[bool]
    assets: Sequence[Row | None]
    card: Mapping[str, Any] | None = None
    verdicts: Mapping[str, Mapping[str, Any]] | None = None
    pairs: Sequence[Mapping[str, Any]] = ()
    remark: str = ""

    @classmethod
    def of(cls, geometry: SceneGeometry, notes: AssetNotes, row: Mapping[str, Any] | None = None) -> "SceneFacts":
        """Returns the facts of a scene.

        Args:
            geometry: The scene with its geometry.
            notes: The assets of its run.
            row: Its row of ``scenes`` or ``rejected``; or a metric card alone, as columns; None if it was not judged.
        """
        scene, row = geometry.scene, row or {}
        return cls(
            scene,
            [mesh is not None for mesh in geometry.meshes],
            [notes.of(o.asset_id) for o in scene.objects],
            card_columns(row) if row else None,
            {verdict["instance"]: verdict for verdict in row.get("verdicts") or ()},
            row.get("pairs") or (),
            str(row.get("reason") or ""),
        )

    def html(self) -> str:
        """Returns all of it as HTML."""
        return self.task_html() + self.objects_html() + self.verdicts_html() + self.relations_html()

    def task_html(self) -> str:
        """Returns the instruction, the table and the main verdicts as HTML."""
        task, table = self.scene.task, self.scene.table
        said = f'<p class="said">{_text(task.task)}</p>' if task is not None and task.task else ""
        goals = "".join(f"<li>{_text(goal)}</li>" for goal in (task.goal if task is not None else ()))
        lines = [
            ("table", f"{_text(table.table_type)}, {table.size_xy[0]:.2f} × {table.size_xy[1]:.2f} m"),
            ("objects", str(len(self.scene.objects))),
        ]
        if table.restricted_zone is not None:
            a, b, c, d = table.restricted_zone
            lines.append(("restricted zone", f"x {a:.2f} to {b:.2f} m, y {c:.2f} to {d:.2f} m"))
        if (frame := self.scene.frame) is not None:
            lines.append(("stands on", f"{_text(frame.surface)} of {_text(frame.support)}"))
        if task is not None and task.environment:
            lines.append(("place", _text(task.environment)))
        if task is not None and task.task_objects:
            lines.append(("task objects", ", ".join(map(_text, task.task_objects))))
        listed = "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in lines)
        remark = f'<p class="remark">{_text(self.remark)}</p>' if self.remark else ""
        goal = f"<ul class=goal>{goals}</ul>" if goals else ""
        return f"<p class=chips>{self._chips()}</p>{said}{remark}{goal}<dl>{listed}</dl>"

    def _chips(self) -> str:
        chips = []
        for name in ("clean", "stable"):
            value = None if self.card is None else self.card.get(name)
            kind, words = {True: ("good", name), False: ("bad", f"not {name}"), None: ("unknown", f"{name}: unknown")}[value]
            chips.append(f'<span class="chip {kind}" title="{escape(_meaning(name))}">{words}</span>')
        return "".join(chips)

    def objects_html(self) -> str:
        """Returns the list of objects as HTML; ``data-at`` of a row is the top of the object's box, metres, glTF axes."""
        rows, fixed = list[str](), list[str]()
        for k, o in enumerate(self.scene.objects[:_LISTED]):
            (fixed if o.instance in self.scene.fixed else rows).append(self._object_html(k, o))
        count = len(self.scene.objects)
        parts = f"<details><summary>{len(fixed)} fixed in the surroundings</summary>{_list(fixed)}</details>" if fixed else ""
        return f"<h3>Objects <span>{count}</span></h3>{_list(rows)}{parts}{_more(count)}"

    def _object_html(self, index: int, o: SceneObject) -> str:
        x, y, _ = o.position
        facts = [" × ".join(f"{100 * side:.1f}" for side in o.size) + " cm"]
        facts.append("no stage" if o.stage is None else f"{o.stage} stage")
        if o.instance in self.scene.fixed:
            facts.append("fixed")
        facts.append(f"on {_text(o.support)}" if o.support else f"support {UNKNOWN}")
        faults = "".join(f'<em class="bad">{fault}</em>' for fault in self._faults(o))
        mesh = "" if self.has_mesh[index] else '<em class="unknown">no mesh: a box</em>'
        described = f"<span class=is>{_text(o.description)}</span>" if o.description else ""
        return (
            f'<li data-at="{x:.4f} {o.top:.4f} {-y:.4f}" data-centre="{x:.4f} {o.position[2]:.4f} {-y:.4f}">'
            f"<button type=button><b>{breakable(o.instance)}</b> <i>{_text(o.category)}</i>{faults}{mesh}{described}"
            f"<small>{' · '.join(facts)}</small>{self._asset_html(index, o)}</button></li>"
        )

    def _faults(self, o: SceneObject) -> list[str]:
        verdict = (self.verdicts or {}).get(o.instance, {})
        faults = [words for name, words in _FAULTS.items() if verdict.get(name)]
        if (verdict.get("table_penetration_mm") or 0.0) > 0.5:
            faults.append(f"{verdict['table_penetration_mm']:.1f} mm in the table")
        deep = [p["penetration_mm"] for p in self.pairs if o.instance in (p["first"], p["second"]) and p["penetration_mm"]]
        if deep and max(deep) > 0.5:
            faults.append(f"collides, {max(deep):.1f} mm")
        return faults

    def _asset_html(self, index: int, o: SceneObject) -> str:
        if o.asset_id is None:
            return "<small>no asset</small>"
        note = self.assets[index] or {}
        said = [f"licence {_text(note['licence']) if note.get('licence') else UNKNOWN}"]
        said += [_text(note[name]) for name in ("source", "author") if note.get(name)]
        return f'<small class=asset title="asset {_text(o.asset_id)}">{" · ".join([*said, _text(o.asset_id)])}</small>'

    def relations_html(self) -> str:
        """Returns the relations as HTML; those that the instruction states come first."""
        stated = () if self.scene.task is None else self.scene.task.relations
        rows = [(r, " class=stated") for r in stated] + [(r, "") for r in self.scene.relations if r not in set(stated)]
        if not rows:
            return "<h3>Relations</h3><p class=note>None.</p>"
        listed = "".join(
            f"<tr{kind}><td>{_text(r.subject)}</td><td>{_text(r.kind)}</td><td>{_text(r.target)}</td></tr>"
            for r, kind in rows[:_LISTED]
        )
        hint = "<p class=note>The instruction states the marked ones.</p>" if stated else ""
        return f"<h3>Relations <span>{len(rows)}</span></h3>{hint}<table>{listed}</table>{_more(len(rows))}"

    def verdicts_html(self) -> str:
        """Returns the metric card as HTML, with units and meanings."""
        if self.card is None:
            return "<h3>Verdicts</h3><p class=note>This scene was not judged: all verdicts are unknown.</p>"
        others = [name for name in self.card if name not in _HEADLINE]
        return (
            f"<h3>Verdicts</h3>{self._figures(name for name in _HEADLINE if name in self.card)}"
            f"<details><summary>{len(others)} more figures</summary>{self._figures(others)}</details>"
        )

    def _figures(self, names: Iterable[str]) -> str:
        assert self.card is not None
        rows = "".join(
            f"<dt>{escape(name)}</dt><dd>{_value(self.card[name], name)}</dd><dd class=meaning>{escape(_meaning(name))}</dd>"
            for name in names
        )
        return f"<dl class=figures>{rows}</dl>"


def breakable(name: str) -> str:
    """Returns a name as HTML that may go on in the next line after an underscore."""
    return _text(name).replace("_", "_<wbr>")


def _meaning(name: str) -> str:
    return str(SCHEMAS["scenes"].field(name).metadata[b"meaning"].decode())


def _value(value: object, name: str) -> str:
    if value is None:
        return UNKNOWN
    if isinstance(value, bool):
        return "yes" if value else "no"
    unit = SCHEMAS["scenes"].field(name).metadata[b"unit"].decode()
    text = f"{value:.4g}" if isinstance(value, float) else str(value)
    return escape(f"{text} {unit}".strip())


def _list(rows: Sequence[str]) -> str:
    return f'<ul class="objects">{"".join(rows)}</ul>'


def _more(count: int) -> str:
    return f"<p class=note>{count - _LISTED} more are not listed.</p>" if count > _LISTED else ""


def _text(value: object) -> str:
    """A text from data: escaped, on one line, bounded in length."""
    text = " ".join(str(value).split())
    return escape(text if len(text) <= _LONGEST else text[: _LONGEST - 1] + "…")
