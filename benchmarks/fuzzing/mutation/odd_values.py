"""Values that break readers: numbers at the ends of ranges, texts that are no text, names of files that lie elsewhere."""

import math
from collections.abc import Sequence
from random import Random
from typing import Any

OUTSIDE = "/tmp/stable-data-fuzz"  # noqa: S108 - a fixed name, so that inputs are the same everywhere; it holds no secret
"""A folder outside of all inputs; its files are watched. Inputs name them."""

OUTSIDE_FILES = ("picture.png", "mesh.stl", "mesh.obj", "model.xml", "layer.usda", "buffer.bin", "colours.mtl", "rows.parquet")
"""The files in it."""

LONG = 100_000  # characters of a long text
NUMBERS: Sequence[float | int] = (
    *(0, 1, -1, 2, 0.5, -0.0, 1e-9, 1e-30, 5e-324, 1e30, 1e38, 3.5e38, 1e154, 1e308, -1e308, math.nan, math.inf, -math.inf),
    *(127, 128, 255, 256, 65_535, 65_536, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**53 + 1, 2**63 - 1, 2**63, -(2**63), 2**64),
    *(10**9, 10**18, 10**30, 10**400, -(10**400)),
)
"""Numbers; JSON has no NaN and no infinities, but Python's parser reads them."""

TEXTS: Sequence[str] = (
    *(
        "",
        " ",
        "\0",
        "\n",
        "\t",
        "\u2028",
        "\u202e",
        "\ufeff",
        "\ud800",
        "\udfff",
        "e\u0301",
        "ß",
        "İ",
        "🫖",
        "\x1b[2J\x1b[31m",
    ),
    *("nan", "NaN", "inf", "-Infinity", "1e999", "0x10", "1_000", "٣", "1,5", "true", "null", "None", "-"),
    *(
        "../x",
        "..",
        ".",
        "/",
        "~",
        "~/x",
        "C:\\x",
        "\\\\host\\x",
        "file:///etc/passwd",
        "http://127.0.0.1:9/x",
        "data:,x",
        "a" * 300,
    ),
    *("<script>alert(1)</script>", "'\"><img src=x>", "{{7*7}}", "${jndi:x}", "%s%n%x", "{0.__class__}", "<|im_end|>", "]]>"),
    *("__import__('os').system('touch /tmp/stable-data-fuzz/executed')", "`id`", "$(id)", "; id", "\\u0000"),
)
"""Short texts."""


def outside_path(rng: Random) -> str:
    """Returns the name of a file outside of the folder, as an input could state it."""
    name = rng.choice(OUTSIDE_FILES)
    return rng.choice(
        (
            f"{OUTSIDE}/{name}",
            f"../{name}",
            f"../../outside/{name}",
            f"../outside/{name}",
            f"file://{OUTSIDE}/{name}",
            f"..\\..\\outside\\{name}",
            f"x/../../outside/{name}",
            f"%2e%2e/outside/{name}",
            f"//{OUTSIDE}/{name}",
            f"./{OUTSIDE}/{name}",
            f"/proc/self/cwd/../outside/{name}",
            "/dev/zero",
            "/dev/stdin",
            "/proc/self/environ",
        )
    )


def odd_number(rng: Random) -> float | int:
    """Returns a number at an end of a range, or any number."""
    if rng.random() < 0.8:
        return rng.choice(NUMBERS)
    return rng.choice((rng.uniform(-1, 1), rng.uniform(-1e6, 1e6), rng.randrange(-10, 1000), 10.0 ** rng.uniform(-40, 40)))


def near_number(value: float | int, rng: Random) -> float | int:
    """Returns a number near another one: many readers accept it."""
    try:
        number = float(value)
    except OverflowError:
        return 0
    factor = rng.choice((-1, 0.1, 0.5, 0.99, 1.0000001, 1.01, 2, 10, 100))
    changed = rng.choice((number * factor, number + rng.choice((-1, 1, 1e-6, 0.01, 90, 360))))
    return round(changed) if isinstance(value, int) and math.isfinite(changed) and rng.random() < 0.8 else changed


def odd_text(rng: Random, words: Sequence[str] = ()) -> str:
    """Returns an odd text, a name of a file elsewhere, a word of the grammar, or a long text."""
    kind = rng.random()
    if words and kind < 0.35:
        return rng.choice(words)
    if kind < 0.75:
        return rng.choice(TEXTS)
    if kind < 0.9:
        return outside_path(rng)
    if kind < 0.95:
        return rng.choice(("a", "é", " ", "../", "(", "\\", "0", '"')) * rng.choice((70, 300, 3000, LONG // 3))
    return "".join(chr(rng.randrange(1, 0xD7FF)) for _ in range(rng.randrange(1, 40)))


def odd_value(rng: Random, words: Sequence[str] = ()) -> Any:
    """Returns an odd value of JSON."""
    kind = rng.random()
    if kind < 0.45:
        return odd_number(rng)
    if kind < 0.7:
        return odd_text(rng, words)
    return rng.choice(
        (None, True, False, [], {}, [[]], [None], {"": None}, [0.0] * 3, ["a", "a"], [{}, {}], {"a": {"a": {}}}, [[0, 0]])
    )
