"""Targets: texts that people write: conditions, tasks, edits, instructions, goals, settings, limits, and documents of the project."""

import json
from dataclasses import asdict
from functools import lru_cache
from pathlib import Path
from types import NoneType
from typing import Any

import pyarrow as pa

from benchmarks.fuzzing.cases import Base, Target
from benchmarks.fuzzing.targets.results import DATA, check_finite, check_notices, check_scene
from models.scene_rating.usual_layouts import UsualLayouts
from models.semantic_reasoner.edit_planning.planner import EditPlanner
from models.semantic_reasoner.editing import EditPrompt, apply_edit, edit_prompt_of
from models.semantic_reasoner.engines.protocol import Completion
from models.semantic_reasoner.engines.response_cache import ResponseCache
from models.semantic_reasoner.engines.scripted_engine import ScriptedEngine
from models.semantic_reasoner.factory import embedded_interpreter
from models.semantic_reasoner.language.category_statistics import FILE, CategoryStatistics
from pipelines.settings import JOBS, resolve_settings
from pipelines.sources.edits import read_edits
from pipelines.sources.tasks import read_tasks
from stable_data.condition import ConditionKind
from stable_data.config_diff import flatten_config
from stable_data.errors import ConfigError, Notice
from stable_data.instructions.task_info import resolve_task_objects
from stable_data.json_text import document_of
from stable_data.limits import read_limits
from stable_data.scene import Scene, SceneObject, Tabletop
from stable_data.scene_graph.relations import contacts_of, scene_graph
from stable_data.scores.detection import read_detections, read_labels, score_detections
from stable_data.storage.filter_expression import parse_filter
from stable_data.storage.schemas import SCHEMAS
from stable_data.tasks.compiling import compile_goal
from stable_data.tasks.geometry import TaskGeometry
from stable_data.tasks.goal import goal_document, goal_of

_CONDITION_WORDS = (
    *(
        "and",
        "or",
        "not",
        "in",
        "is",
        "None",
        "True",
        "False",
        "clean",
        "stable",
        "num_objects",
        "table_type",
        "aws",
        "oc",
        "scene_id",
        "split",
    ),
    *(
        "==",
        "!=",
        "<=",
        ">=",
        "<",
        ">",
        "(",
        ")",
        "[",
        "]",
        ",",
        "lambda x: x",
        "x if x else y",
        "f'{aws}'",
        "clean()",
        "a.b",
        "a[0]",
        "{1: 2}",
    ),
    *(
        "1e999",
        "-1",
        "2**63",
        "0x7f",
        "1j",
        "'a'",
        'b"a"',
        "...",
        ":=",
        "*",
        "await x",
        "yield",
        "\\\n",
        "#",
        "objects",
        "not not",
        "1 < 2 < 3",
    ),
)
_CONDITIONS = (
    "clean",
    "stable and num_objects >= 2",
    'table_type in ["office_table", "desk"] or not clean',
    "aws is None or 0.5 < aws <= 1.0",
    "scene_id != 'a' and (split == \"train\" or float_rate == 0) and not (oc > 0.1)",
    "num_stacked in (1, 2, 3) and max_penetration_mm < 0.5",
)


def _conditions() -> list[Base]:
    return [Base(f"condition_{k}", {"condition.txt": text.encode()}) for k, text in enumerate(_CONDITIONS)]


@lru_cache(maxsize=1)
def _rows() -> pa.Table:
    schema = SCHEMAS["scenes"]
    flat = pa.schema([field for field in schema if not pa.types.is_nested(field.type)])
    rows = [
        dict.fromkeys(flat.names),
        dict.fromkeys(flat.names) | {"scene_id": "a", "num_objects": 3, "clean": True, "aws": 0.7},
    ]
    return pa.Table.from_pylist(rows, schema=flat)


def _text(path: Path) -> str:
    """The text of a file as a command line has it: bytes that are no UTF-8 become lone surrogates."""
    return path.read_bytes().decode("utf-8", "surrogateescape")


def _read_condition(folder: Path, base: str) -> bool:
    table = _rows()
    found = parse_filter(_text(folder / "condition.txt"), SCHEMAS["scenes"])
    passed = found.rows(table)
    for row in table.to_pylist():
        found.passes(row, table.schema)
    return bool(passed.num_rows <= table.num_rows)


_TASK_ROWS = (
    {"scene_id": "a_1", "instruction": "Put the mug on the plate.", "table_type": "office_table", "table_size_cm": [120, 60]},
    {
        "instruction": "Stack the books.",
        "table_type": "Dining table",
        "table_size_cm": "90 x 90",
        "restricted_zone_cm": [0, 20, 0, 30],
    },
)


def _tasks() -> list[Base]:
    import io

    import pyarrow.parquet as pq

    lines = "".join(json.dumps(row) + "\n" for row in _TASK_ROWS)
    head = "scene_id,instruction,table_type,table_size_cm,restricted_zone_cm\n"
    rows = 'a_1,"Put the mug, now.",office_table,120 x 60,\n,Stack the books.,desk,"90,90","0,20,0,30"\n'
    sink = io.BytesIO()
    table = pa.table(
        {
            "scene_id": ["a", "b"],
            "instruction": ["Lift it.", "Push it."],
            "table_type": ["desk", "desk"],
            "table_size_cm": [[120.0, 60.0], [90.0, 50.0]],
        }
    )
    pq.write_table(table, sink)
    contents = {"tasks.jsonl": lines.encode(), "tasks.csv": (head + rows).encode(), "tasks.parquet": sink.getvalue()}
    return [Base(path.rpartition(".")[2], {path: content}) for path, content in contents.items()]


def _read_tasks(folder: Path, base: str) -> bool:
    found = list(read_tasks(folder / f"tasks.{base}"))
    check_notices(item for item in found if isinstance(item, Notice))
    return any(not isinstance(item, Notice) for item in found)


def _edit_files() -> list[Base]:
    rows = (
        {"scene_id": "office_1", "instruction": "Remove the mug."},
        {"scene_id": "office_1", "instruction": "Move it.", "edit_id": "x", "reply": {"remove": [], "objects": []}},
        {"scene_id": "desk/2", "instruction": "Add a lamp.", "reply": '{"objects":[]}'},
    )
    return [Base("edits", {"edits.jsonl": "".join(json.dumps(row) + "\n" for row in rows).encode()})]


def _read_edits(folder: Path, base: str) -> bool:
    found = read_edits(folder / "edits.jsonl", {"office_1", "desk/2"})
    check_notices(found.failures)
    return bool(found.edits)


_DEFAULTS = {verb: location.defaults() for verb, location in JOBS.items()}  # it imports the jobs, once for all workers


def _settings() -> list[Base]:
    found = []
    for verb, default in _DEFAULTS.items():
        values = flatten_config(asdict(default)).items()
        lines = [f"{key} = {json.dumps(value)}" for key, value in values if isinstance(value, (int, float, str, bool))][:12]
        found.append(Base(f"{verb}_toml", {"settings.toml": f"[{verb.replace('-', '_')}]\n{chr(10).join(lines)}\n".encode()}))
        found.append(Base(f"{verb}_set", {"set.txt": "\n".join(line.replace(" = ", "=") for line in lines[:4]).encode()}))
    return found


def _read_settings(folder: Path, base: str) -> bool:
    verb, _, form = base.rpartition("_")
    default = _DEFAULTS[verb]
    if form == "toml":
        resolve_settings(type(default), verb.replace("-", "_"), folder / "settings.toml", (), default)
    else:
        resolve_settings(type(default), verb.replace("-", "_"), None, _text(folder / "set.txt").split("\n"), default)
    return True


def _limits() -> list[Base]:
    return [Base("limits", {"limits.txt": b"mesh.max_faces=5000000, item.max_memory_bytes=17179869184,layout.max_reach = 2.5"})]


def _read_limits(folder: Path, base: str) -> bool:
    read_limits(_text(folder / "limits.txt"))
    return True


_INSTRUCTIONS = (
    "Put the red mug on the plate, left of the laptop.",
    "Stack the three books by size and hand me the pen.",
    "Clear the table: everything goes into the box except the lamp.",
    "Please move the glass 10 cm to the right and turn the bottle upright.",
    "Swap the cup and the bowl, then place the fork between them.",
)
_EDITS = (
    "Remove the white mug.",
    "Add a lamp behind the laptop.",
    "Replace the book with a plate and move the blue mug onto it.",
    "Turn the laptop by 90 degrees and make it blue.",
    "Swap the plate and the box.",
)
_SENTENCE_WORDS = (
    *(
        "mug",
        "plate",
        "book",
        "laptop",
        "everything",
        "it",
        "them",
        "the other one",
        "not",
        "left of",
        "on",
        "in",
        "between",
        "front edge",
    ),
    *(
        "thirty-two",
        "10 cm",
        "a hundred",
        "and",
        ", then",
        "instead of",
        "except",
        "mugs",
        "cup's",
        "nearest",
        "hand me",
        "pour",
        "swap",
    ),
    *(
        "both",
        "all but",
        "the corner",
        "upside down",
        "by size",
        "twice",
        "90 degrees",
        "blue",
        "a",
        "an",
        "my",
        "where it was",
        "nowhere",
    ),
)


def _instructions() -> list[Base]:
    found = [Base(f"instruction_{k}", {"text.txt": text.encode()}) for k, text in enumerate(_INSTRUCTIONS)]
    return found + [Base(f"edit_{k}", {"text.txt": text.encode()}) for k, text in enumerate(_EDITS)]


@lru_cache(maxsize=1)
def _scene() -> Scene:
    """A desk with a few things."""
    places = {
        "0_laptop_0": ("laptop", (0.6, 0.35, 0.01), (0.32, 0.22, 0.02), "a grey laptop"),
        "1_book_0": ("book", (0.25, 0.2, 0.015), (0.2, 0.14, 0.03), "a thick red book"),
        "2_mug_0": ("mug", (0.25, 0.2, 0.08), (0.08, 0.08, 0.1), "a white mug"),
        "3_mug_1": ("mug", (0.9, 0.15, 0.05), (0.08, 0.08, 0.1), "a blue mug"),
        "4_plate_0": ("plate", (0.9, 0.45, 0.01), (0.18, 0.18, 0.02), "a plate"),
        "5_box_0": ("box", (0.15, 0.45, 0.06), (0.2, 0.2, 0.12), "a cardboard box"),
    }
    objects = tuple(
        SceneObject(
            name, category, position, 0.0, size, description=words, support="1_book_0" if name == "2_mug_0" else "table"
        )
        for name, (category, position, size, words) in places.items()
    )
    return Scene("office", Tabletop("office_table", (1.2, 0.6)), objects)


@lru_cache(maxsize=1)
def _planner() -> tuple[Any, EditPlanner, EditPrompt]:
    from models.semantic_reasoner.engines.registry import EMBEDDED

    interpret = embedded_interpreter()
    return interpret, EditPlanner(interpret, CategoryStatistics.load(EMBEDDED)), edit_prompt_of(_scene())


def _read_instruction(folder: Path, base: str) -> bool:
    from models.semantic_reasoner.replies.to_scene import attach_task_info
    from models.semantic_reasoner.text.prompt import check_instruction

    interpret, planner, prompt = _planner()
    text = check_instruction(_text(folder / "text.txt"))
    if base.startswith("edit"):
        result = apply_edit(prompt, planner(prompt.question(text)))
        check_scene(result.scene)
        return True
    meant = interpret(text)
    check_notices(meant.notices)
    scene = attach_task_info(_scene(), text, _scene().objects, interpret)
    assert scene.task is not None
    return meant.reference is not None


_GOALS: tuple[dict[str, Any], ...] = (
    {
        "Task": "Put the mug on the plate.",
        "Goal": ["The mug is on the plate.", "The book is left of the laptop."],
        "Objects cluster": ["mug", "plate"],
    },
    {"Task": "Tidy up.", "Action Sequence": ["Pick(book)", "PlaceOn(plate)", "Push(laptop, left, 10)"]},
    {
        "Task": "Sort.",
        "Goal": [
            "The book and the plate are in one row, the smallest on the left.",
            "The laptop faces the box",
            "Nothing is on the book",
        ],
    },
    {
        "Task": "Do it.",
        "task_objects": ["2_mug_0", "5_box_0"],
        "conditions": [
            {"subject": "2_mug_0", "kind": "in", "target": "5_box_0"},
            {"subject": "1_book_0", "kind": "apart", "target": "0_laptop_0", "distance": 0.2},
            {"subject": "2_mug_0, 3_mug_1", "kind": "together", "target": ""},
        ],
    },
)


def _goals() -> list[Base]:
    goal = {
        "kind": "place_on",
        "conditions": [{"subject": "a", "kind": "on", "target": "b", "distance": None, "is_negated": False}],
        "steps": [{"action": "pick", "subject": "a", "conditions": []}],
    }
    found = [Base(f"task_{k}", {"task.json": json.dumps(task).encode()}) for k, task in enumerate(_GOALS)]
    return [*found, Base("goal", {"goal.json": json.dumps(goal).encode()})]


@lru_cache(maxsize=1)
def _geometry() -> TaskGeometry:
    from stable_data.geometry.shape import Shape

    scene = _scene()
    shapes = tuple(Shape.box(o.size) for o in scene.objects)
    containers = {o.instance: o.category in ("mug", "box") for o in scene.objects}
    return TaskGeometry(scene, shapes, containers)


def _read_goal(folder: Path, base: str) -> bool:
    from dataclasses import replace

    from stable_data.mesatask.task_info import read_task_info

    if base == "goal":
        try:
            document = document_of((folder / "goal.json").read_bytes())
        except ValueError as error:
            raise ConfigError(f"no JSON: {str(error)[:200]!r}", "json_invalid") from error
        if isinstance(document, dict):
            goal_document(goal_of(document))
        return isinstance(document, dict)
    task = read_task_info((folder / "task.json").read_bytes(), "office")
    space = _geometry()
    known = replace(space.scene, task=task)
    graph = scene_graph(known, contacts_of(known), containers=space.containers)
    found, notices = resolve_task_objects(task, known, graph)
    check_notices(notices)
    compile_goal(replace(space, scene=replace(known, task=found)))
    return True


def _detections() -> list[Base]:
    labels = [
        {
            "image": "images/a.png",
            "width": 640,
            "height": 640,
            "category": "mug",
            "conversations": [{"value": "Where is the handle of the mug?"}, {"value": "[0.1, 0.2, 0.3, 0.4]"}],
        }
    ]
    found = [
        {"image": "a.png", "category": "mug", "box": [0.1, 0.2, 0.3, 0.4], "score": 0.9},
        {"image": "a.png", "category": "mug", "format_answer": "no"},
    ]
    results = [{"image_id": 1, "category_id": 1, "bbox": [64, 128, 128, 128], "score": 0.9}]
    asked = json.dumps(labels).encode()
    answers = {"boxes": found, "coco": results}
    return [Base(name, {"labels.json": asked, "found.json": json.dumps(said).encode()}) for name, said in answers.items()]


def _read_detections(folder: Path, base: str) -> bool:
    labels = read_labels(folder / "labels.json")
    for score in score_detections(labels, read_detections(folder / "found.json", labels).boxes):
        check_finite("score", list(score.precision.values()), list(score.running_precision.values()))
    return True


_KEY = "0" * 64


def _stored() -> list[Base]:
    from models.semantic_reasoner.engines.response_cache import _entry

    entry = _entry(_KEY, Completion('{"objects":[]}', 10, 5, cost=0.01))
    script = {"mug": {"objects": []}, "book": "none"}
    layouts = UsualLayouts.load()
    few = {
        "version": json.loads((DATA.parents[1] / "models/weights/scene_rating/usual_layouts.json").read_bytes())["version"],
        "num_scenes": {"desk": 3},
        "least_spread": {"3": 0.2},
        "most_offset": {"3": 0.1},
        "turns": {"mug": {"count": 3, "front": 0.5, "askew": 0.1}},
        "together": {"desk": ["mug book"]},
    }
    assert layouts.num_scenes
    statistics = json.loads((DATA.parents[1] / "models/weights/semantic_reasoner" / FILE).read_bytes())
    names = list(statistics["categories"])[:2]
    statistics |= {
        "categories": {name: statistics["categories"][name] for name in names},
        "words": dict(list(statistics["words"].items())[:3]),
    }
    return [
        Base("cache", {f"00/{_KEY}.json": entry}),
        Base("script", {"script.json": json.dumps(script).encode()}),
        Base("script_list", {"script.json": json.dumps(["a", {"objects": []}]).encode()}),
        Base("usual_layouts", {"layouts.json": json.dumps(few).encode()}),
        Base("statistics", {FILE: json.dumps(statistics).encode()}),
    ]


def _read_stored(folder: Path, base: str) -> bool:
    if base == "cache":
        cache = ResponseCache(folder)
        found = cache.read(_KEY)
        check_notices(cache.notices)
        if found is not None and not (
            isinstance(found.text, str) and isinstance(found.failure, str) and type(found.cost) in (int, float, NoneType)
        ):
            raise TypeError(f"a completion with values of other types: {found!r:.200}")
        return found is not None
    if base == "usual_layouts":
        UsualLayouts.load(folder / "layouts.json")
    elif base == "statistics":
        CategoryStatistics.load(folder)
    else:
        ScriptedEngine.from_file(folder / "script.json")
    return True


TARGETS = (
    Target("condition", 75, _conditions, _read_condition, _CONDITION_WORDS),
    Target(
        "tasks",
        40,
        _tasks,
        _read_tasks,
        ("instruction", "table_type", "table_size_cm", "restricted_zone_cm", "scene_id", "120 x 60"),
    ),
    Target("edits", 60, _edit_files, _read_edits, ("scene_id", "instruction", "edit_id", "reply", "office_1", "desk/2")),
    Target(
        "settings",
        45,
        _settings,
        _read_settings,
        ("true", "inf", "nan", "1979-05-27", "[x]", "[[x]]", "a.b=1", "'''", "0xff", "{a=1}"),
    ),
    Target(
        "limits",
        30,
        _limits,
        _read_limits,
        ("mesh.max_faces", "item.max_memory_bytes", "=", ",", "1_000", "0", "-1", "1e9", "json.max_levels"),
    ),
    Target("instruction", 5, _instructions, _read_instruction, _SENTENCE_WORDS, block=50),
    Target(
        "goal", 35, _goals, _read_goal, (*map(str, ConditionKind), *_SENTENCE_WORDS, "subject", "target", "2_mug_0", "table")
    ),
    Target(
        "detection",
        40,
        _detections,
        _read_detections,
        ("image", "box", "score", "format_answer", "category", "question", "a.png", "image_id", "category_id", "bbox", "width"),
    ),
    Target("stored", 35, _stored, _read_stored, ("version", "categories", "tables", "words", "count", "key", "sum", "text")),
)
"""The targets of this module."""
