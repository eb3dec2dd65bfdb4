"""Layouts get their assets; what has none is left out with what rests on it."""

from stable_data.assets.assignment import assign_assets
from stable_data.assets.retrieval import Retriever
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
