"""The catalogue of the embedded world: every asset by category and variant, with what it is made of and how it may rest."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType

from stable_data.scene import UPRIGHT, QuatXyzw
from stable_data.synth import belongings as b
from stable_data.synth import tableware as t
from stable_data.synth.solids import Solid

_HALF = 0.7071067811865476
LAID: QuatXyzw = (_HALF, 0.0, 0.0, _HALF)
"""What stands on its end laid on its side, its top towards -y."""

STANDING = (UPRIGHT,)
EITHER = (UPRIGHT, LAID)
LYING = (LAID,)

DENSITY: Mapping[str, float] = MappingProxyType(
    {
        "ceramic": 2300.0,
        "glass": 1200.0,  # bottles are hollow or full of something lighter
        "metal": 2700.0,
        "tin": 1000.0,
        "wood": 650.0,
        "plastic": 950.0,
        "paper": 750.0,
        "cardboard": 250.0,
        "fruit": 850.0,
        "food": 350.0,
        "wax": 900.0,
        "electronics": 1300.0,
    }
)
"""Effective density of each material, kilograms per cubic metre."""


@dataclass(frozen=True, slots=True)
class AssetSpec:
    """How an asset is made.

    Attributes:
        category: Its kind, words joined by ``_``.
        variant: Tells the assets of a category apart.
        build: Makes the solid, metres, standing on z = 0.
        material: A key of ``DENSITY``.
        caption: A sentence about it.
        is_container: Whether things can lie in it.
        tilts: Its usual resting tilts; the first is the most usual.
        unit: Metres in one unit of its file: files come in all units.
        is_z_up: Its file keeps the mesh z up under a node that turns it, as many exporters do.
    """

    category: str
    variant: str
    build: Callable[[], Solid]
    material: str
    caption: str
    is_container: bool = False
    tilts: tuple[QuatXyzw, ...] = STANDING
    unit: float = 1.0
    is_z_up: bool = False

    @property
    def key(self) -> str:
        """``category/variant``, unique in the catalogue."""
        return f"{self.category}/{self.variant}"


def _spec(key: str, build: Callable[[], Solid], material: str, caption: str, **rest: object) -> AssetSpec:
    category, variant = key.split("/")
    return AssetSpec(category, variant, build, material, caption, **rest)  # type: ignore[arg-type]


CATALOGUE: Mapping[str, AssetSpec] = MappingProxyType(
    {
        spec.key: spec
        for spec in (
            _spec("mug/tall", partial(t.mug, 0.040, 0.098), "ceramic", "A tall ceramic mug with a handle.", is_container=True),
            _spec(
                "mug/wide",
                partial(t.mug, 0.047, 0.078),
                "ceramic",
                "A wide ceramic mug with a handle.",
                is_container=True,
                unit=0.01,
            ),
            _spec(
                "cup/tumbler",
                partial(t.tumbler, 0.038, 0.110),
                "plastic",
                "A smooth tumbler, wider at the rim.",
                is_container=True,
            ),
            _spec("bowl/deep", partial(t.bowl, 0.082, 0.070), "ceramic", "A deep round bowl on a foot.", is_container=True),
            _spec(
                "bowl/fruit",
                partial(t.bowl, 0.135, 0.085),
                "ceramic",
                "A large round fruit bowl.",
                is_container=True,
                unit=0.5,
                is_z_up=True,
            ),
            _spec("plate/dinner", partial(t.plate, 0.130), "ceramic", "A round dinner plate with a raised rim."),
            _spec(
                "plate/side", partial(t.plate, 0.095, 0.018), "ceramic", "A small round plate with a raised rim.", unit=0.001
            ),
            _spec(
                "tray/serving",
                partial(t.tray, 0.42, 0.30),
                "wood",
                "A rectangular serving tray with a sloping rim.",
                is_container=True,
            ),
            _spec("spoon/table", partial(t.spoon, 0.19), "metal", "A metal table spoon.", unit=0.01),
            _spec("knife/kitchen", partial(t.knife, 0.26), "metal", "A kitchen knife with a broad blade.", is_z_up=True),
            _spec(
                "bottle/wine",
                partial(t.bottle, 0.038, 0.30, 0.014, 0.60),
                "glass",
                "A tall bottle with a long neck.",
                tilts=EITHER,
            ),
            _spec(
                "bottle/sauce",
                partial(t.bottle, 0.032, 0.19, 0.012, 0.66),
                "glass",
                "A small sauce bottle with a cap.",
                tilts=EITHER,
                unit=0.0254,
            ),
            _spec("jar/jam", partial(t.jar, 0.038, 0.095), "glass", "A jam jar with a wide lid.", unit=0.05),
            _spec("jar/cream", partial(t.jar, 0.034, 0.052), "plastic", "A low jar of cream with a lid.", is_z_up=True),
            _spec("can/soup", partial(t.can, 0.0335, 0.101), "tin", "A tin can of soup.", unit=0.001),
            _spec("can/tuna", partial(t.can, 0.042, 0.040), "tin", "A low tin can of tuna."),
            _spec(
                "saucepan/small", partial(t.saucepan, 0.09, 0.085), "metal", "A saucepan with a long handle.", is_container=True
            ),
            _spec("cutting_board/oak", partial(t.cutting_board, 0.34, 0.23), "wood", "A wooden cutting board with a grip."),
            _spec("apple/red", partial(t.fruit, 0.038, 0.90, stem=True), "fruit", "A round apple with a stem.", unit=0.1),
            _spec("orange/ripe", partial(t.fruit, 0.037, 0.97, stem=False), "fruit", "A round orange."),
            _spec("lemon/small", partial(t.fruit, 0.027, 1.12, stem=False), "fruit", "A small lemon.", tilts=LYING),
            _spec("banana/ripe", partial(t.banana, 0.18), "fruit", "A bent banana.", unit=0.02),
            _spec("bread/loaf", partial(t.bread, 0.22), "food", "A loaf of bread with a round top.", is_z_up=True),
            _spec(
                "crate/wooden",
                partial(t.crate, 0.32, 0.24, 0.13),
                "wood",
                "An open wooden crate with grips.",
                is_container=True,
            ),
            _spec(
                "basket/low",
                partial(b.basket, 0.26, 0.19, 0.085),
                "wood",
                "A low basket with sloping walls.",
                is_container=True,
                unit=0.2,
            ),
            _spec(
                "box/storage", partial(b.cardboard_box, 0.20, 0.14, 0.10), "cardboard", "A cardboard storage box with a lid."
            ),
            _spec("box/cereal", partial(b.carton, 0.17, 0.06, 0.25), "cardboard", "A tall box of cereal.", unit=0.01),
            _spec("book/novel", partial(b.book, 0.135, 0.200, 0.028), "paper", "A closed book, a novel."),
            _spec(
                "book/atlas",
                partial(b.book, 0.210, 0.280, 0.022),
                "paper",
                "A large closed book, an atlas.",
                unit=0.3,
                is_z_up=True,
            ),
            _spec("book/pocket", partial(b.book, 0.110, 0.170, 0.018), "paper", "A small closed pocket book.", unit=0.001),
            _spec("notebook/a5", partial(b.notebook, 0.148, 0.210, 0.012), "paper", "A flat notebook."),
            _spec("pen/ball", partial(b.pen, 0.142, 0.0052), "plastic", "A ballpoint pen.", tilts=LYING),
            _spec("pencil/hexagonal", partial(b.pencil, 0.175), "wood", "A six-sided pencil.", tilts=LYING, unit=0.01),
            _spec("pen_holder/round", partial(b.pen_holder, 0.041, 0.098), "metal", "A round pen holder.", is_container=True),
            _spec("laptop/open", partial(b.laptop, 0.32, 0.22), "electronics", "An open laptop."),
            _spec("lamp/desk", partial(b.desk_lamp, 0.40), "cardboard", "A desk lamp with a round shade.", unit=0.37),
            _spec("stapler/long", partial(b.stapler, 0.14), "metal", "A stapler.", is_z_up=True),
            _spec("soap/bar", partial(b.soap, 0.088), "wax", "A bar of soap."),
            _spec("toothbrush/soft", partial(b.toothbrush, 0.185), "plastic", "A toothbrush.", tilts=LYING, unit=0.01),
            _spec("soap_dispenser/pump", partial(b.pump_bottle, 0.034, 0.18), "plastic", "A soap dispenser with a pump."),
            _spec(
                "perfume/square", partial(b.perfume, 0.065, 0.105), "glass", "A flat perfume bottle with a stopper.", unit=0.001
            ),
            _spec("candle/pillar", partial(b.candle, 0.035, 0.085), "wax", "A pillar candle."),
            _spec("vase/slender", partial(b.vase, 0.055, 0.22), "glass", "A slender vase.", unit=0.15),
            _spec("mirror/round", partial(b.mirror, 0.09), "metal", "A round mirror on a stand.", is_z_up=True),
        )
    }
)
"""Every asset, by key."""
