"""Small mesh files for tests, as text."""

import io

from PIL import Image

SQUARE = "v 0 0 0\nv 2 0 0\nv 2 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
CUBE_STL = (
    "solid cube\n"
    + "".join(
        f"facet normal 0 0 0\nouter loop\n{''.join(f'vertex {x} {y} {z}{chr(10)}' for x, y, z in corners)}endloop\nendfacet\n"
        for corners in (
            ((0, 0, 0), (0, 1, 0), (1, 1, 0)),
            ((0, 0, 0), (1, 1, 0), (1, 0, 0)),
            ((0, 0, 1), (1, 0, 1), (1, 1, 1)),
            ((0, 0, 1), (1, 1, 1), (0, 1, 1)),
            ((0, 0, 0), (1, 0, 0), (1, 0, 1)),
            ((0, 0, 0), (1, 0, 1), (0, 0, 1)),
            ((0, 1, 0), (0, 1, 1), (1, 1, 1)),
            ((0, 1, 0), (1, 1, 1), (1, 1, 0)),
            ((0, 0, 0), (0, 0, 1), (0, 1, 1)),
            ((0, 0, 0), (0, 1, 1), (0, 1, 0)),
            ((1, 0, 0), (1, 1, 0), (1, 1, 1)),
            ((1, 0, 0), (1, 1, 1), (1, 0, 1)),
        )
    )
    + "endsolid cube\n"
)
"""The cube of side 1 with a corner in the origin, ASCII."""


def png(side: int = 2) -> bytes:
    """A small picture."""
    content = io.BytesIO()
    Image.new("RGB", (side, side), (200, 30, 30)).save(content, "PNG")
    return content.getvalue()


def dae(
    *,
    asset: str = "",
    nodes: str = '<node id="n" name="part"><instance_geometry url="#g"><bind_material><technique_common>'
    '<instance_material symbol="m" target="#m"/></technique_common></bind_material></instance_geometry></node>',
    image: str = "",
    index: str = "0 0 1 1 2 2 3 3",
    positions: str = "0 0 0 2 0 0 2 1 0 0 1 0",
    library: str = "",
) -> str:
    """A COLLADA of one polygon of four corners, 2 × 1, with one material."""
    diffuse = '<texture texture="s" texcoord="UV"/>' if image else "<color>1 0 0 1</color>"
    sampler = (
        '<newparam sid="f"><surface type="2D"><init_from>i</init_from></surface></newparam>'
        '<newparam sid="s"><sampler2D><source>f</source></sampler2D></newparam>'
    )
    sampler = sampler if image else ""
    count = len(positions.split())
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><asset>{asset}</asset>
<library_images>{f'<image id="i"><init_from>{image}</init_from></image>' if image else ""}</library_images>
<library_effects><effect id="e"><profile_COMMON>
{sampler}
<technique sid="t"><lambert><diffuse>{diffuse}</diffuse></lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>
<library_geometries><geometry id="g" name="form"><mesh>
<source id="p"><float_array id="pa" count="{count}">{positions}</float_array><technique_common>
<accessor source="#pa" count="{count // 3}" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<source id="t"><float_array id="ta" count="8">0 0 1 0 1 1 0 1</float_array><technique_common>
<accessor source="#ta" count="4" stride="2"><param name="S" type="float"/><param name="T" type="float"/></accessor>
</technique_common></source><vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="1" material="m"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="TEXCOORD" source="#t" offset="1" set="0"/><vcount>4</vcount><p>{index}</p></polylist>
</mesh></geometry></library_geometries>{library}
<library_visual_scenes><visual_scene id="sc">{nodes}</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#sc"/></scene></COLLADA>"""
