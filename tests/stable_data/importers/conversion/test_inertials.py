"""Given and estimated masses."""

import numpy as np
import pytest

from stable_data.geometry.mass_properties import mass_properties
from stable_data.geometry.mesh_repair import repair_mesh
from stable_data.importers.conversion import inertials
from stable_data.importers.conversion.inertials import DEFAULT_DENSITY, AssetInertial, inertial_of, material_of
from stable_data.importers.source import GivenInertial
from stable_data.scene import FloatArray
from tests.stable_data.importers.conversion.sources import CUP, box, revolved

BOX, REPORT, _ = repair_mesh(box(0.1, 0.2, 0.3), "a")
VOLUME = 0.1 * 0.2 * 0.3


def of_box(
    given: GivenInertial | None, category: str = "zorble", words: tuple[str, ...] = (), center: FloatArray | None = None
) -> tuple[AssetInertial, list[str]]:
    found, notices = inertial_of(given, BOX, REPORT, asset_id="a", category=category, words=words, center=center)
    return found, [n.code for n in notices]


def test_a_given_mass_and_its_place_move_with_the_frame_of_the_mesh() -> None:
    true = mass_properties(BOX, mass=2.0)
    given = GivenInertial(2.0, (1.01, 2.0, 3.0), true.inertia)
    found, codes = of_box(given, center=np.array([1.0, 2.0, 3.0]))
    assert (found.mass, found.mass_source, codes) == (2.0, "given", [])
    assert found.center_of_mass == pytest.approx([0.01, 0, 0])
    assert found.inertia == pytest.approx(true.inertia)


@pytest.mark.parametrize(
    "inertia",
    [np.diag([1e-3, 1e-3, 0.0]), np.diag([1e-3, 1e-3, 3e-3]), np.diag([1e-3, np.nan, 1e-3]), -np.eye(3)],
)
def test_an_inertia_that_no_body_has_is_replaced(inertia: FloatArray) -> None:
    found, codes = of_box(GivenInertial(2.0, (0.0, 0.0, 0.0), inertia))
    assert (found.mass, found.inertia, codes) == (2.0, None, ["inertia_replaced"])


def test_a_centre_of_mass_far_outside_is_replaced_with_its_inertia() -> None:
    found, codes = of_box(GivenInertial(2.0, (0.0, 0.0, 0.4), np.eye(3) * 1e-2))
    assert (found.center_of_mass, found.inertia, codes) == (None, None, ["inertia_replaced"])
    found, codes = of_box(GivenInertial(2.0, (0.0, 0.0, 0.155), None))
    assert (codes, found.center_of_mass is None) == ([], False)


@pytest.mark.parametrize(
    ("mass", "codes"),
    [(VOLUME * 4824, []), (VOLUME * 96, []), (VOLUME * 2, ["mass_implausible"]), (600.0, ["mass_implausible"])],
)
def test_an_unlikely_density_is_warned_and_kept(mass: float, codes: list[str]) -> None:
    found, told = of_box(GivenInertial(mass))
    assert (found.mass, found.mass_source, told) == (mass, "given", codes)


def test_a_mass_that_was_not_weighed_is_not_trusted() -> None:
    found, codes = of_box(GivenInertial(0.01, is_weighed=False))
    assert (found.mass_source, codes) == ("default", [])
    assert found.mass == pytest.approx(DEFAULT_DENSITY * VOLUME)
    found, codes = of_box(GivenInertial(0.0))
    assert (found.mass_source, codes) == ("default", ["mass_implausible"])


def test_densities_follow_from_material_or_category() -> None:
    wooden, _ = of_box(None, words=("a", "wooden", "crate"))
    assert (wooden.mass_source, wooden.material) == ("material", "wood")
    assert wooden.mass == pytest.approx(650 * VOLUME)
    apple, _ = of_box(None, "red_apple")
    assert apple.mass_source == "category"
    assert apple.mass == pytest.approx(850 * VOLUME)
    bottle, _ = of_box(None, "thermos", ("steel", "thermos"))
    assert bottle.mass_source == "material"
    assert bottle.mass < 2700 * VOLUME


def test_a_solid_model_of_a_thing_with_walls_weighs_no_more_than_its_walls() -> None:
    """A cup is a quarter of its hull; a solid one must not weigh four times as much."""
    thin, solid = (repair_mesh(revolved(profile), "a") for profile in (CUP, [*CUP[:3], (0.0, 0.09)]))
    masses = []
    for mesh, report, _ in (thin, solid):
        assert report.is_solid
        masses.append(inertial_of(None, mesh, report, asset_id="a", category="mug")[0].mass / report.volume)
    assert masses[0] > 1000, "of the clay itself"
    assert masses[1] < 0.4 * masses[0]
    plate, _ = of_box(None, "plate")
    assert plate.mass == pytest.approx(2300 * 0.33 * 1.1 * VOLUME)
    clay, _ = of_box(None, "plate", ("clay",))
    assert clay.mass == pytest.approx(plate.mass)


def test_every_density_is_sound() -> None:
    names = set()
    for row in inertials._rows():
        names.add((row["kind"], row["name"]))
        assert 20 < float(row["density"]) < 10_000
        assert (row["fill"] != "") == (row["kind"] == "category")
        assert row["fill"] == "" or 0 < float(row["fill"]) <= 1
    assert len(names) == len(inertials._rows())


def test_several_materials_are_none() -> None:
    assert material_of(("glass", "metal")) is None
    assert material_of(("steel", "iron")) == "metal"


def test_an_open_mesh_weighs_as_a_shell() -> None:
    sheet, report, _ = repair_mesh(revolved(CUP[:3]), "a")
    assert report.is_sheet
    found = inertial_of(None, sheet, report, asset_id="a", category="zorble")[0]
    assert found.mass == pytest.approx(DEFAULT_DENSITY * report.area * 2e-3)
