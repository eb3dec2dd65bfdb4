"""Retrieval: from words and a requested box to an asset, its resting tilt and its scale.

``score = 0.9 · text + 0.1 · size``: the dot product of unit text features, and the cosine of the proportions of the requested
box and the asset's box at the resting tilt that fits best, less a loss where the asset may not be so large or so small. An asset of
the wanted category always matches, another one only if its text score reaches the floor. If there is no match, the answer names the
nearest asset. A choice depends on the query, the seed and the libraries, never on other queries of the call.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from stable_data.assets.box_fitting import stretched_scale, turned_box
from stable_data.assets.catalog import Asset, AssetLibrary, asset_sentence
from stable_data.assets.licences import is_licence_allowed
from stable_data.assets.noun_fit import NounFit, is_named_in
from stable_data.assets.ranking import AssetScores, RankedAssets, tie_break_number
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.assets.text_embeddings import Rows, TextEncoder, check_rows
from stable_data.errors import ConfigError, SceneError
from stable_data.json_text import quote_value
from stable_data.scene import QuatXyzw, Vec3

_PROBED = 32  # assets whose words are encoded again to check whether features of unknown origin are from this encoder
_MOST_TEXTS = 20_000  # texts whose features are cached: 31 MB with 384 numbers each
_PASSES = ((NounFit.KIND, True), (NounFit.KIND, False), (NounFit.POSSIBLE, False), (NounFit.OTHER, False))
"""Searches of all libraries, in order: how well the noun must fit at least, and whether the asset must fit in size and use too."""

_RELATED = 0.5  # minimum mean cosine in this check; with another encoder it is about 0


@dataclass(frozen=True, slots=True)
class AssetQuery:
    """An object that needs an asset.

    Attributes:
        text: Description of the object; if it is empty, the category is used alone.
        size: Box in the yaw frame, metres.
        category: Category, if known: encoded with the text. Assets whose own category fits it
            (:class:`~stable_data.assets.noun_fit.NounFit`) are preferred, but not required.
        key: Decides between equally good assets together with the seed. With different keys, such as ``scene_id/instance``,
            equal queries may get different assets; with one key for a scene they get the same asset.
        leans: Whether another object supports it, so that it may lean; otherwise only observed tilts are used.
        holds: Whether another object is in it, so that an asset which is known to be no container does not fit.
        without: Ids of excluded assets.
    """

    text: str
    size: Vec3
    category: str | None = None
    key: str = ""
    leans: bool = False
    holds: bool = False
    without: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        """Checks the size."""
        if len(self.size) != 3 or not all(map(math.isfinite, self.size)) or min(self.size) < 0 or max(self.size) <= 0:
            found = f"query {quote_value(self.text)} has size {self.size}"
            raise SceneError(f"{found}, expected width, depth and height in metres", "size_invalid")

    def sentence(self, *, names_category: bool = True) -> str:
        """Returns the sentence to encode: category and text, or without ``names_category`` the text alone if there is one."""
        is_named = names_category or not self.text.strip()
        return asset_sentence(self.text, (self.category or "") if is_named else "")


@dataclass(frozen=True, slots=True)
class BarredAsset:
    """An asset that would serve if its licence were allowed.

    Attributes:
        asset_id: Identifier of the asset.
        library: Name of its library.
        licence: Its licence as it is stated; None if unknown.
    """

    asset_id: str
    library: str
    licence: str | None

    def __str__(self) -> str:
        licence = "is unknown" if self.licence is None else f"{quote_value(self.licence)} is not allowed"
        return f"asset {self.asset_id} of library {self.library}, whose licence {licence}"


@dataclass(frozen=True, slots=True)
class AssetMatch:
    """The asset for a query.

    Attributes:
        asset_id: Identifier of the asset.
        library: Name of its library.
        category: Category of the asset. If the library does not state it, the wanted one if the words of the asset name it; else empty.
        score: Weighted sum of the two scores.
        text_score: Dot product of the text features.
        size_score: Cosine of the proportions, at the resting tilt that fits best.
        tilt_quat_xyzw: The chosen resting tilt.
        scale: Metres per mesh unit along the axes of the mesh.
        size: Box at that tilt and scale, metres, yaw frame.
        is_turned: Whether the asset is modelled along the other side of the requested box, as a knife that lies along x and not along
            y: the object with this asset is turned by 90 degrees.
        note: Why the scale is uniform although the settings require stretching; else empty.
        barred: A better match whose licence is not allowed; None if there is none.
    """

    asset_id: str
    library: str
    category: str
    score: float
    text_score: float
    size_score: float
    tilt_quat_xyzw: QuatXyzw
    scale: Vec3
    size: Vec3
    is_turned: bool = False
    note: str = ""
    barred: "BarredAsset | None" = None


@dataclass(frozen=True, slots=True)
class UnmatchedQuery:
    """The answer to a query without a match.

    Attributes:
        reason: Explanation in one line.
        nearest: Id of the asset with the highest text score; empty if the query has no words.
        library: Name of the library of the nearest asset.
        text_score: Text score of the nearest asset.
        barred: A match whose licence is not allowed; None if there is none.
    """

    reason: str
    nearest: str = ""
    library: str = ""
    text_score: float = 0.0
    barred: "BarredAsset | None" = None


Answer: TypeAlias = AssetMatch | UnmatchedQuery


class Retriever:
    """Finds assets in libraries, which are searched in order.

    All libraries are searched for the wanted thing or a kind of it whose size is near the requested one, and which can hold what is in
    it; then for any one;
    then for what may be the thing; and only then for another thing.

    Args:
        libraries: In order of preference, with features of the same encoder.
        encoder: The text encoder.
        settings: How assets are chosen.

    Raises:
        ConfigError: There is no library, a library has no features or those of another encoder, two libraries have the same
            name, or the licences exclude all assets.
    """

    def __init__(
        self, libraries: Sequence[AssetLibrary], encoder: TextEncoder, settings: RetrievalSettings | None = None
    ) -> None:
        self.settings = settings or RetrievalSettings()
        self._encoder = encoder
        if not libraries:
            raise ConfigError("no asset library, expected at least one; pass a library", "library_empty")
        names = [library.name for library in libraries]
        if len(set(names)) < len(names):
            raise ConfigError(f"libraries are named {', '.join(names)}, expected different names; pass name=", "library_name")
        for library in libraries:
            _check_encoder(library, encoder)
        self._places = {name: place for place, name in enumerate(names)}
        self._libraries = _scores(libraries, self.settings)
        if not self._libraries:
            licences = "any" if self.settings.licences is None else ", ".join(sorted(self.settings.licences)) or "none"
            message = f"libraries {', '.join(names)} offer no asset under the licences {licences}"
            raise ConfigError(f"{message}, expected at least one; allow more licences or add a library", "library_unusable")
        self._known: dict[str, Rows] = {}
        self._licence_of = {
            (library.name, a.asset_id): a.licence
            for library in libraries
            for a in library.assets
            if a.is_offered and not is_licence_allowed(a.licence, self.settings.licences)
        }
        # Where the licences exclude assets, the same search among all assets tells which match they exclude.
        self._all = _scores(libraries, replace(self.settings, licences=None)) if self._licence_of else []

    def retrieve(self, queries: Sequence[AssetQuery], seed: int = 0) -> list[Answer]:
        """Finds an asset for each query, or the reason why there is none.

        Args:
            queries: The queries; the answer to each does not depend on the others.
            seed: Decides between equally good assets: with the same seed a query always gets the same asset.

        Returns:
            One answer for each query.

        Raises:
            ConfigError: The encoder does not return unit rows of the libraries' length.
        """
        kinds = {scores.names_category for _, scores in self._libraries}
        texts = list(dict.fromkeys(q.sentence(names_category=kind) for kind in sorted(kinds) for q in queries if q.sentence()))
        if not texts:
            return [_wordless() for _ in queries]
        rows = self._encoded(texts)
        found = self._answers(queries, rows, seed, self._libraries)
        if self._all:
            every = self._answers(queries, rows, seed, self._all)
            return [self._with_barred(one, other) for one, other in zip(found, every, strict=True)]
        return [answer for answer, _ in found]

    def _encoded(self, texts: Sequence[str]) -> dict[str, Rows]:
        """Returns the row (D,) of each text, from a cache, since scenes repeat the same descriptions."""
        found = {text: self._known[text] for text in texts if text in self._known}
        if unknown := [text for text in texts if text not in found]:
            rows = check_rows(self._encoder(unknown), len(unknown), "the text encoder")
            if rows.shape[1] != (wanted := self._libraries[0][1].width):
                message = f"the text encoder returns {rows.shape[1]} numbers per text, expected {wanted} as in the libraries"
                raise ConfigError(f"{message}; embed the libraries with this encoder", "features_of_another_encoder")
            new = {text: row.copy() for text, row in zip(unknown, rows, strict=True)}
            found |= new
            self._known |= new
            for text in list(self._known)[: max(0, len(self._known) - _MOST_TEXTS)]:
                del self._known[text]
        return found

    def _answers(
        self, queries: Sequence[AssetQuery], rows: dict[str, Rows], seed: int, libraries: Sequence[tuple[str, AssetScores]]
    ) -> list[tuple[Answer, int]]:
        """Returns the answers, and the number of the search that found each: searches of earlier passes and libraries have lower ones."""
        answers: list[tuple[Answer, int]] = [(_wordless(), 0) for _ in queries]
        waiting = [k for k, query in enumerate(queries) if query.sentence()]
        for number, (least, must_fit) in enumerate(_PASSES):
            for name, scores in libraries:
                # Without a category any noun fits, so that one search is enough. Where nothing is limited, everything fits.
                asked = [k for k in waiting if queries[k].category or least is NounFit.OTHER]
                if not asked or (number == 1 and not scores.is_limited):
                    continue
                asked_queries = [queries[k] for k in asked]
                choices = scores.choose(
                    np.stack([rows[query.sentence(names_category=scores.names_category)] for query in asked_queries]),
                    np.array([query.size for query in asked_queries], np.float64),
                    [query.category for query in asked_queries],
                    np.array([tie_break_number(seed, query.key, query.sentence()) for query in asked_queries], np.uint64),
                    np.array([query.leans for query in asked_queries], np.bool_),
                    np.array([query.holds for query in asked_queries], np.bool_),
                    [query.without for query in asked_queries],
                    least=least,
                    must_fit=must_fit,
                )
                order = number * len(self._places) + self._places[name]
                for k, answer in zip(asked, self._read(name, scores, choices, asked_queries), strict=True):
                    previous = answers[k][0]
                    if answer is not None and (
                        isinstance(answer, AssetMatch)
                        or not isinstance(previous, UnmatchedQuery)
                        or not previous.nearest
                        or answer.text_score > previous.text_score
                    ):
                        answers[k] = answer, order
                waiting = [k for k in waiting if not isinstance(answers[k][0], AssetMatch)]
        return answers

    def _with_barred(self, found: tuple[Answer, int], every: tuple[Answer, int]) -> Answer:
        """Returns an answer with the better match among all assets, if its licence excludes it."""
        (answer, order), (best, earlier) = found, every
        if not isinstance(best, AssetMatch) or (best.library, best.asset_id) not in self._licence_of:
            return answer
        if isinstance(answer, AssetMatch) and earlier == order and best.score <= answer.score + self.settings.margin:
            return answer  # as good as the barred one
        return replace(answer, barred=BarredAsset(best.asset_id, best.library, self._licence_of[best.library, best.asset_id]))

    def _read(
        self, name: str, scores: AssetScores, choices: RankedAssets, queries: Sequence[AssetQuery]
    ) -> list[Answer | None]:
        """Converts the choices of one library to answers; None where it has no match and no nearest asset was searched for."""
        wanted = [turned_box(q.size) if turned else q.size for q, turned in zip(queries, choices.is_turned, strict=True)]
        scales = scores.scales(choices.asset, choices.tilt, wanted).tolist()
        answers: list[Answer | None] = []
        for k, (query, index, nearest) in enumerate(
            zip(queries, choices.asset.tolist(), choices.nearest.tolist(), strict=True)
        ):
            text, size = float(choices.text[k]), float(choices.size[k])
            if index >= 0:
                asset = scores.assets[index]
                match = self._match(asset, int(choices.tilt[k]), scales[k], wanted[k])
                if not asset.category and query.category and is_named_in(asset.words, query.category):
                    match = replace(match, category=query.category)
                score = self.settings.text_weight * text + self.settings.size_weight * size
                found = replace(match, library=name, score=score, text_score=text, size_score=size)
                answers.append(replace(found, is_turned=bool(choices.is_turned[k])))
            elif nearest < 0:
                answers.append(None)
            elif scores.assets[nearest].asset_id in query.without:
                answers.append(UnmatchedQuery("the query excludes all assets of the libraries"))
            else:
                answers.append(self._unmatched(name, scores.assets[nearest], text, query))
        return answers

    def _match(self, asset: Asset, tilt: int, factor: float, wanted: Vec3) -> AssetMatch:
        """The match without its scores."""
        rest, note = asset.tilts[tilt], ""
        x, y, z = rest.extents
        scale, box = (factor, factor, factor), (factor * x, factor * y, factor * z)
        if self.settings.stretch:
            stretched, distortion = stretched_scale(wanted, rest.extents, rest.quat_xyzw)
            if not self._may_be_stretched(asset, stretched):
                note = "is scaled uniformly: stretching would give it a size that such an asset does not have"
            elif stretched is not None and distortion <= self.settings.max_distortion:
                scale, box = stretched, wanted
            elif stretched is None:
                note = "is scaled uniformly: it is flat or leans, so it cannot be stretched to a box"
            else:
                allowed = f"expected at most {self.settings.max_distortion:g}"
                note = f"is scaled uniformly: stretching would distort it by a factor of {distortion:.2g}, {allowed}"
        return AssetMatch(asset.asset_id, "", asset.category, 0.0, 0.0, 0.0, rest.quat_xyzw, scale, box, note=note)

    def _may_be_stretched(self, asset: Asset, scale: Vec3 | None) -> bool:
        """Whether an asset has a free size, or a range of sizes that includes the stretched one."""
        if asset.size_range is None or scale is None:
            return True
        (low, high), slack = asset.size_range, self.settings.metric_slack
        longest = max(s * e for s, e in zip(scale, asset.extents, strict=True))
        return low < high and low / slack <= longest <= high * slack

    def _unmatched(self, name: str, nearest: Asset, text: float, query: AssetQuery) -> UnmatchedQuery:
        found = f"{quote_value(nearest.words)} of library {name} at {text:.2f}"
        wanted = quote_value(query.sentence())
        reason = f"no asset is similar to {wanted}: the nearest is {found}, expected at least {self.settings.floor:g}"
        return UnmatchedQuery(reason, nearest.asset_id, name, text)


def _scores(libraries: Sequence[AssetLibrary], settings: RetrievalSettings) -> list[tuple[str, AssetScores]]:
    """The libraries that offer an asset, with their names."""
    found = ((library.name, AssetScores(library, settings)) for library in libraries)
    return [(name, scores) for name, scores in found if scores.assets]


def _wordless() -> UnmatchedQuery:
    return UnmatchedQuery("the query has neither words nor a category, expected at least one of them")


def _check_encoder(library: AssetLibrary, encoder: TextEncoder) -> None:
    """Checks that the features of a library are from an encoder; features of unknown origin are compared with new ones."""
    if library.features is None:
        message = f"library {library.name} has no text features; call embedded(encoder) on it first"
        raise ConfigError(message, "features_missing")
    if library.encoder_fingerprint == encoder.fingerprint:
        return
    what = f"library {library.name}: its features"
    hint = "call embedded(encoder) on it, or use the encoder that made them"
    if library.encoder_fingerprint:
        found = f"{what} come from encoder {library.encoder_fingerprint}, expected {encoder.fingerprint}"
        raise ConfigError(f"{found}; {hint}", "features_of_another_encoder")
    step = math.ceil(len(library) / _PROBED)
    probed = list(range(0, len(library), step))
    words = [library.assets[k].words for k in probed]
    rows = check_rows(encoder(words), len(words), "the text encoder")
    if rows.shape[1] != library.features.shape[1]:
        found = f"{what} have {library.features.shape[1]} numbers, but this encoder returns {rows.shape[1]}"
        raise ConfigError(f"{found}; {hint}", "features_of_another_encoder")
    likeness = float((rows * library.features[probed]).sum(axis=1).mean())
    if likeness < _RELATED:
        found = f"{what} and this encoder's features of the same words have mean cosine {likeness:.2f}, expected at least {_RELATED}"
        raise ConfigError(f"{found}; {hint}", "features_of_another_encoder")
