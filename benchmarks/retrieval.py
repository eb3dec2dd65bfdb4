"""Retrieval: a batch of queries at once, against one query after the other as in MesaTask.

``python -m benchmarks.retrieval DATASET [--assets 12000] [--queries 1000] [--json FILE] [--large N]``. The library is the dataset's own,
repeated with a little noise on features and boxes until it is as large as that of MesaTask-10K. The queries are the words of
assets drawn from it, with noise of the same kind and boxes up to 20 % off. Both sides get the same encoded queries; the encoding
is timed separately. Run with ``OMP_NUM_THREADS=1``.

Then objects of the dataset's scenes are searched in its library by their words and boxes, by other words if the annotations have
some (``captions``), one object of each category by its noun, and objects that are on no table. The figures: how often the same
asset is found, and how often the floor of the score rejects all assets.

``--large 100000`` measures a large library instead: a run with so many synthetic rows, with sizes and stored sentence embeddings, is
written to a temporary folder and opened in a new process. The figures: seconds until it has answered a first query, the milliseconds
of a query by its kind, alone and in batches of one scene's objects, and the largest memory of the process.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from models.text_encoder import load_default
from pipelines.sources.assets import AssetLibraries
from stable_data.assets.catalog import Asset, AssetLibrary, RestingTilt
from stable_data.assets.retrieval import AssetMatch, AssetQuery, Retriever
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.text_embeddings import Rows
from stable_data.errors import SceneError
from stable_data.instructions.wording.words import type_words
from stable_data.mesatask import MesaTaskDataset
from stable_data.mesatask.asset_catalog import library_of_folder
from stable_data.scene import Scene, SceneObject, Vec3
from stable_data.storage.run_folder import RunFolder
from stable_data.storage.schemas import SCHEMAS, Row

_NOISE = 0.005  # standard deviation of a feature's components before it is normalised: copies have a cosine of 0.99
_ROUNDS = 5
_ROWS = 4096  # of a shard of the large run
_METRE = 0.1  # metres of a mesh unit in the large run
_SCENE = 14  # objects of a scene, which are searched together
_ANY_SIZE = (0.2, 0.2, 0.2)
_TOO_LARGE = (5.0, 5.0, 5.0)

_ABSENT = """
elephant, motorcycle, sofa, airplane, swimming pool, bicycle, grand piano, refrigerator, stethoscope,
violin, fire extinguisher, skateboard, telescope, microscope, rifle, sewing machine, quadcopter,
sleeping cat, tennis racket, umbrella, running shoe, car tyre, traffic cone, bathtub, human skull,
guitar, lawn mower, printer, vacuum cleaner, syringe, backpack, pizza, hamburger, typewriter, aquarium,
gas mask, teddy bear, brass bell, yoga mat, toy drum, ladder, tent
"""
ABSENT = tuple(kind.strip() for kind in _ABSENT.split(","))
"""Kinds of objects that are on no table of the embedded world or of the development sets."""


@dataclass(frozen=True, slots=True)
class RetrievalFigure:
    """The figures of one way of retrieval.

    Attributes:
        name: The way.
        num_assets: Size of the library.
        num_queries: Size of the batch.
        seconds: Processor time of the batch without encoding; the best of some rounds.
        ratio: Speed relative to one query after the other.
        found: Share of queries that get an asset of their own category.
    """

    name: str
    num_assets: int
    num_queries: int
    seconds: float
    ratio: float
    found: float


@dataclass(frozen=True, slots=True)
class Recall:
    """The assets found for some queries.

    Attributes:
        name: The kind of queries.
        num_queries: Number of queries.
        matched: Share that gets any asset.
        same_asset: Share that gets the original asset.
        same_words: Share that gets an asset of the same description.
        same_category: Share that gets an asset of the same category.
    """

    name: str
    num_queries: int
    matched: float
    same_asset: float
    same_words: float
    same_category: float


class KnownRows:
    """A text encoder that looks up its rows, so that encoding takes no time."""

    fingerprint = "known"

    def __init__(self, texts: Sequence[str], rows: Rows) -> None:
        self._place, self._rows = {text: k for k, text in enumerate(texts)}, rows

    def __call__(self, texts: Sequence[str], /) -> Rows:
        """Returns the rows of known texts."""
        return self._rows[[self._place[text] for text in texts]]


def enlarged(library: AssetLibrary, num: int, rng: np.random.Generator) -> AssetLibrary:
    """Returns a library of ``num`` assets: those of another one, repeated with small differences."""
    assert library.features is not None
    chosen = np.arange(num) % len(library)
    assets = [
        replace(_jittered(library.assets[k], rng), asset_id=f"{library.assets[k].asset_id}-{n}") for n, k in enumerate(chosen)
    ]
    return replace(library, assets=tuple(assets), features=_noisy(library.features[chosen], rng), encoder_fingerprint="known")


def _jittered(asset: Asset, rng: np.random.Generator) -> Asset:
    factors = rng.uniform(0.9, 1.1, 3).tolist()
    tilts = tuple(RestingTilt(t.quat_xyzw, _times(t.extents, factors), t.count) for t in asset.tilts)
    return replace(asset, extents=_times(asset.extents, factors), tilts=tilts)


def _times(extents: Vec3, factors: Sequence[float]) -> Vec3:
    x, y, z = (e * f for e, f in zip(extents, factors, strict=True))
    return (x, y, z)


def _noisy(rows: Rows, rng: np.random.Generator) -> Rows:
    moved = rows + rng.normal(0.0, _NOISE, rows.shape)
    unit: Rows = (moved / np.linalg.norm(moved, axis=1, keepdims=True)).astype(np.float32)
    return unit


def one_by_one(library: AssetLibrary, rows: Rows, queries: Sequence[AssetQuery]) -> list[str | None]:
    """Retrieves as published: the best 20 by text, of these the best 5 by text and size, of these the first that is offered."""
    assert library.features is not None
    found: list[str | None] = []
    for row, query in zip(rows, queries, strict=True):
        text = library.features @ row
        wanted = np.array(query.size)
        scored = []
        for k in np.argsort(-text)[:20].tolist():
            box = np.array(library.assets[k].extents)
            size = float(wanted @ box / (np.linalg.norm(wanted) * np.linalg.norm(box)))
            scored.append((0.9 * float(text[k]) + 0.1 * size, k))
        best = [k for _, k in sorted(scored, reverse=True)[:5]]
        found.append(next((library.assets[k].asset_id for k in best if library.assets[k].is_offered), None))
    return found


def measure(data: Path, num_assets: int, num_queries: int) -> tuple[list[RetrievalFigure], float]:
    """Measures all ways on the same library and queries, the published one first, and the seconds of encoding the queries."""
    rng = np.random.default_rng(0)
    encoder = load_default()
    library = enlarged(library_of_folder(data).embedded(encoder), num_assets, rng)
    assert library.features is not None
    drawn = rng.choice([k for k, asset in enumerate(library.assets) if asset.is_offered], num_queries)
    rows = _noisy(library.features[drawn], rng)
    queries = [
        AssetQuery(f"{n}", _times(library.assets[k].tilts[0].extents, rng.uniform(0.8, 1.2, 3).tolist()))
        for n, k in enumerate(drawn.tolist())
    ]
    known = KnownRows([query.sentence() for query in queries], rows)
    texts = [f"{library.assets[k].words}, number {n}" for n, k in enumerate(drawn.tolist())]
    start = time.process_time()
    encoder(texts)
    encoding = time.process_time() - start
    category = {asset.asset_id: asset.category for asset in library.assets}
    wanted = [library.assets[k].category for k in drawn.tolist()]

    def batch(settings: RetrievalSettings) -> Callable[[], list[str | None]]:
        retriever = Retriever([library], known, settings)
        return lambda: [a.asset_id if isinstance(a, AssetMatch) else None for a in retriever.retrieve(queries)]

    ways = {
        "one query after the other, as published": (lambda: one_by_one(library, rows, queries), 1),
        "a batch": (batch(RetrievalSettings()), _ROUNDS),
        "a batch, of the twenty nearest by text": (batch(RetrievalSettings(top_k_text=20)), _ROUNDS),
    }
    figures: list[RetrievalFigure] = []
    for name, (way, rounds) in ways.items():
        found, seconds = _best_of(way, rounds)
        right = sum(uid is not None and category[uid] == kind for uid, kind in zip(found, wanted, strict=True)) / num_queries
        ratio = figures[0].seconds / seconds if figures else 1.0
        figures.append(RetrievalFigure(name, num_assets, num_queries, round(seconds, 4), round(ratio, 1), round(right, 4)))
    return figures, encoding


def recall(data: Path, num_objects: int) -> list[Recall]:
    """Searches objects of scenes, drawn evenly from the dataset, and objects that the dataset does not have."""
    dataset, encoder = MesaTaskDataset(data), load_default()
    scenes, objects = list[Scene](), list[SceneObject]()
    offered = {a.asset_id: a for a in library_of_folder(data).assets if a.is_offered}
    order = np.random.default_rng(0).permutation(len(dataset.scene_ids)).tolist()
    for k in order:
        if len(objects) >= num_objects:
            break
        try:
            scenes.append(dataset.read(dataset.scene_ids[k])[0])
        except SceneError:
            continue
        objects += [o for o in scenes[-1].objects if o.asset_id in offered]
    objects = objects[:num_objects]
    retriever = Retriever([library_of_folder(data, scenes=scenes).embedded(encoder)], encoder)
    assets = [offered[o.asset_id or ""] for o in objects]
    ways = {"own words": [o.description or a.words for o, a in zip(objects, assets, strict=True)]}
    captions = [dataset.annotation(a.asset_id).raw.get("captions", []) for a in assets]
    if all(len(texts) > 1 for texts in captions):
        ways["other words"] = [texts[1 + n % (len(texts) - 1)] for n, texts in enumerate(captions)]
    found: list[Recall] = []
    for name, texts in ways.items():
        for is_named in (True, False):
            kinds = [o.category if is_named else None for o in objects]
            queries = [
                AssetQuery(t, o.size, kind, str(n)) for n, (t, o, kind) in enumerate(zip(texts, objects, kinds, strict=True))
            ]
            answers = [
                (offered[x.asset_id] if isinstance(x, AssetMatch) else None, a)
                for x, a in zip(retriever.retrieve(queries), assets, strict=True)
            ]
            same = [
                (x.asset_id == a.asset_id, x.words == a.words, x.category == a.category) for x, a in answers if x is not None
            ]
            shares = np.array(same, np.float64).reshape(-1, 3).sum(axis=0) / len(objects)
            title = f"{name}{' and category' if is_named else ''}"
            found.append(Recall(title, len(objects), len(same) / len(objects), *np.round(shares, 4).tolist()))
    nouns = sorted({a.category for a in offered.values() if a.category})
    named = [AssetQuery(f"a {' '.join(type_words(kind))}", _ANY_SIZE, kind) for kind in nouns]
    matches = [
        (a.category, kind) for a, kind in zip(retriever.retrieve(named), nouns, strict=True) if isinstance(a, AssetMatch)
    ]
    right = sum(category == kind for category, kind in matches)
    found.append(
        Recall("each category by its noun", len(nouns), *(round(n / len(nouns), 4) for n in (len(matches), 0, 0, right)))
    )
    for is_named in (True, False):
        queries = [AssetQuery(f"a {kind}", _ANY_SIZE, kind if is_named else None) for kind in ABSENT]
        matched = sum(isinstance(x, AssetMatch) for x in retriever.retrieve(queries)) / len(ABSENT)
        found.append(Recall(f"not there{', with category' if is_named else ''}", len(ABSENT), round(matched, 4), 0.0, 0.0, 0.0))
    return found


@dataclass(frozen=True, slots=True)
class LargeLibrary:
    """The figures of a large library.

    Attributes:
        num_assets: Number of assets.
        open_seconds: Processor time until the library has answered a first query.
        query_ms: Processor time of a query, by kind of query and size of the batch.
        imported_mb: Memory of the process before the library is opened.
        peak_mb: Largest memory of the process.
    """

    num_assets: int
    open_seconds: float
    query_ms: dict[str, float]
    imported_mb: float
    peak_mb: float


def write_large_run(data: Path, out: Path, num_assets: int) -> None:
    """Writes a run with the assets of a dataset, repeated with small differences, with sizes and the features of their sentences."""
    encoder, rng = load_default(), np.random.default_rng(0)
    library, run = library_of_folder(data).embedded(encoder), RunFolder(str(out))
    assert library.features is not None
    blank = {table: dict.fromkeys(SCHEMAS[table].names) for table in ("assets", "meshes")}
    for start in range(0, num_assets, _ROWS):
        numbers = np.arange(start, min(num_assets, start + _ROWS))
        features = _noisy(library.features[numbers % len(library)], rng).astype(np.float16)
        rows: dict[str, list[Row]] = {"assets": [], "meshes": []}
        for n, feature in zip(numbers.tolist(), features, strict=True):
            asset = _jittered(library.assets[n % len(library)], rng)
            longest = _METRE * max(asset.extents)
            tilts = [{"tilt_quat_xyzw": list(t.quat_xyzw), "count": max(1, t.count)} for t in asset.tilts]
            own = {"asset_id": f"{asset.asset_id}-{n}"}
            words = {"category": asset.category, "description": asset.description, "licence": "CC-BY-4.0"}
            size = {"extents": list(asset.extents), "size_low": 0.7 * longest, "size_high": 1.4 * longest}
            text = {"sentence_embedding": feature, "sentence_encoder": encoder.fingerprint}
            rows["assets"].append(blank["assets"] | own | words | size | text | {"resting_tilts": tilts, "on_table": True})
            rows["meshes"].append(blank["meshes"] | own | {"sha256": f"{n:064x}", "glb": b""})
        for table, found in rows.items():
            run.write_shard(table, f"{start:016x}", found)


def measure_large(run: Path, num_queries: int) -> LargeLibrary:
    """Opens a run as a library and searches it."""
    imported = _memory_mb("VmRSS")
    load_default()(["a word"])
    began = time.process_time()
    libraries = AssetLibraries([str(run)])
    retriever = libraries.retriever()
    retriever.retrieve([AssetQuery("a word", _ANY_SIZE)])
    seconds = time.process_time() - began
    (library,) = libraries.libraries
    rng = np.random.default_rng(1)
    drawn = [library.assets[k] for k in rng.integers(0, len(library), num_queries).tolist()]
    boxes = [_times(a.tilts[0].extents, (_METRE * rng.uniform(0.8, 1.2, 3)).tolist()) for a in drawn]
    own, absent = [a.category for a in drawn], [ABSENT[k % len(ABSENT)] for k in range(len(drawn))]
    (frequent, _), *_ = Counter(a.category for a in library.assets).most_common(1)
    words, too_large = [a.words for a in drawn], [_TOO_LARGE] * len(drawn)
    kinds: dict[str, Iterable[tuple[str, Vec3, str | None]]] = {
        "category of the library": zip(words, boxes, own, strict=True),
        "its most frequent category": zip(words, boxes, [frequent] * len(drawn), strict=True),
        "larger than all such assets": zip(words, too_large, own, strict=True),
        "category that the library lacks": zip(words, boxes, absent, strict=True),
        "words that the library lacks": zip([f"a {kind}" for kind in absent], boxes, absent, strict=True),
        "category unknown": zip(words, boxes, [None] * len(drawn), strict=True),
    }
    figures = {}
    for name, asked in kinds.items():
        queries = [AssetQuery(text, box, kind, str(k)) for k, (text, box, kind) in enumerate(asked)]
        retriever.retrieve(queries)  # encodes the sentences
        alone = []
        for query in queries:
            began = time.process_time()
            retriever.retrieve([query])
            alone.append(time.process_time() - began)
        figures[f"{name}, one at a time (median)"] = round(1000 * float(np.median(alone)), 2)
        began = time.process_time()
        for start in range(0, len(queries), _SCENE):
            retriever.retrieve(queries[start : start + _SCENE])
        figures[f"{name}, {_SCENE} at a time (mean)"] = round(1000 * (time.process_time() - began) / len(queries), 2)
    return LargeLibrary(len(library), round(seconds, 2), figures, round(imported), round(_memory_mb("VmHWM")))


def _memory_mb(name: str) -> float:
    lines = Path("/proc/self/status").read_text("utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith(f"{name}:"))


def _print_large(data: Path, num_assets: int, num_queries: int) -> None:
    with TemporaryDirectory() as folder:
        write_large_run(data, Path(folder) / "run", num_assets)
        # A new process, because writing the run needs memory too.
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            found = pool.submit(measure_large, Path(folder) / "run", num_queries).result()
    print(
        f"{found.num_assets} assets: open after {found.open_seconds} s; {found.peak_mb} MB, of which {found.imported_mb} for the code"
    )
    for name, milliseconds in found.query_ms.items():
        print(f"{name:60} {milliseconds:6.2f} ms a query")


def _best_of(way: Callable[[], list[str | None]], rounds: int) -> tuple[list[str | None], float]:
    """Returns the result, and the seconds of the fastest round."""
    found: list[str | None] = []
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        found = way()
        seconds.append(time.process_time() - start)
    return found, min(seconds)


def main() -> None:
    """Prints the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="a dataset in the MesaTask-10K format")
    parser.add_argument("--assets", type=int, default=12_000)
    parser.add_argument("--queries", type=int, default=1_000)
    parser.add_argument("--large", type=int, help="measure a library of so many synthetic assets instead")
    parser.add_argument("--json", type=Path, help="file for the figures")
    arguments = parser.parse_args()
    if arguments.large:
        _print_large(arguments.data, arguments.large, arguments.queries)
        return
    figures, encoding = measure(arguments.data, arguments.assets, arguments.queries)
    print(f"{arguments.queries} queries, {arguments.assets} assets; encoding the queries takes {encoding:.2f} s")
    print(f"{'retrieval':44} {'seconds':>8} {'ratio':>8} {'own category':>13}")
    for figure in figures:
        print(f"{figure.name:44} {figure.seconds:8.3f} {figure.ratio:7.1f}x {figure.found:13.1%}")
    recalls = recall(arguments.data, arguments.queries)
    print(f"\n{'asked for':30} {'queries':>7} {'matched':>8} {'asset':>7} {'words':>7} {'category':>9}")
    for r in recalls:
        shares = f"{r.matched:8.1%} {r.same_asset:7.1%} {r.same_words:7.1%} {r.same_category:9.1%}"
        print(f"{r.name:30} {r.num_queries:7} {shares}")
    if arguments.json:
        speed, known = ([asdict(figure) for figure in table] for table in (figures, recalls))
        content = {"encoding_seconds": round(encoding, 3), "figures": speed, "recall": known}
        arguments.json.write_text(json.dumps(content, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
