"""Layouts get their assets; what has none is left out with what rests on it."""

from stable_data.assets.assignment import assign_assets
from stable_data.assets.retrieval import Retriever
from stable_data.assets.retrieval_settings import RetrievalSettings
from stable_data.scene import Scene, SceneObject, Stage, Tabletop
from tests.stable_data.assets.bag_of_words import BagOfWords, library, thing


def test_what_rests_on_a_thing_without_an_asset_is_left_out_too() -> None:
    retriever = Retriever([library(thing("mug", "a red mug"))], BagOfWords())

    def placed(name: str, words: str, z: float, support: str, stage: Stage) -> SceneObject:
        return SceneObject(name, name, (0.5, 0.3, z), 0.0, (0.1, 0.1, 0.1), description=words, stage=stage, support=support)

    objects = (
        placed("a", "a red mug", 0.05, "table", Stage.TASK),
        placed("elephant", "an elephant with trunk as long as some river", 0.05, "table", Stage.IMPORTANT),
        placed("b", "a red mug", 0.15, "elephant", Stage.SECONDARY),
    )
    scene = Scene("one", Tabletop("office_table", (1.2, 0.6)), objects)
    (found,) = assign_assets([scene], retriever)
    assert [o.instance for o in found.scene.objects] == ["a"]
    assert set(found.unmatched) == {"elephant"}
    assert [n.code for n in found.notices] == ["carrier_left_out", "asset_unmatched"]
    assert not assign_assets([Scene("two", scene.table, ())], retriever)[0].notices


def test_a_barred_licence_is_a_notice() -> None:
    assets = [thing("best", "a red mug", licence="CC BY-NC 4.0"), thing("other", "a mug", licence="CC0")]
    retriever = Retriever([library(*assets)], BagOfWords(), RetrievalSettings(licences=frozenset({"CC0"})))
    mug = SceneObject("mug_0", "mug", (0.5, 0.3, 0.05), 0.0, (0.1, 0.1, 0.1), description="a red mug", support="table")
    (found,) = assign_assets([Scene("one", Tabletop("office_table", (1.2, 0.6)), (mug,))], retriever)
    (notice,) = found.notices
    assert notice.code == "licence_substitute"
    assert notice.message == (
        "one: mug_0 gets asset other of library first; the best match is asset best of library first, whose licence 'CC BY-NC 4.0' is "
        "not allowed; allow the licence or accept the substitute"
    )


def test_what_has_something_in_it_gets_a_container() -> None:
    flat = thing("flat", "a plate", category="plate", is_container=False)
    deep = thing("deep", "one plate", category="plate", is_container=True)
    retriever = Retriever(
        [library(flat), library(deep, name="second"), library(thing("bowl", "a bowl"), name="third")], BagOfWords()
    )

    def layout(low: float) -> Scene:
        plate = SceneObject("plate_0", "plate", (0.5, 0.3, 0.01), 0.0, (0.2, 0.2, 0.02), description="a plate", support="table")
        bowl = SceneObject(
            "bowl_0", "bowl", (0.5, 0.3, low + 0.03), 0.0, (0.1, 0.1, 0.06), description="a bowl", support="plate_0"
        )
        return Scene("one", Tabletop("office_table", (1.2, 0.6)), (plate, bowl))

    on, within = (assign_assets([layout(low)], retriever)[0].scene.objects[0].asset_id for low in (0.02, 0.008))
    assert (on, within) == ("flat", "deep")
