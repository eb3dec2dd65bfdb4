"""Edits of ZIP archives: of the content, the names and the packing of their members."""

import io
import warnings
import zipfile
import zlib
from collections.abc import Callable
from random import Random

from benchmarks.fuzzing.mutation.byte_edits import edited_bytes
from benchmarks.fuzzing.mutation.odd_values import outside_path

_NAMES = ("../x", "/x", "", "a/" * 200 + "x", "data.pkl", "x\0y", "é.usda", ".", "0.png")


def edited_archive(content: bytes, rng: Random, edit: Callable[[str, bytes], bytes]) -> bytes | None:
    """Returns an archive with one edit; None if it is none.

    Args:
        content: The archive.
        rng: Chooses the edit.
        edit: Edits the content of a member, given its name.
    """
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = [(info.filename, archive.read(info)) for info in archive.infolist()]
    except (zipfile.BadZipFile, ValueError, OSError, EOFError, NotImplementedError, RuntimeError, zlib.error):
        return None
    if not members or rng.random() < 0.1:
        return edited_bytes(content, rng)
    k, kind = rng.randrange(len(members)), rng.random()
    name, inner = members[k]
    packing = zipfile.ZIP_STORED
    if kind < 0.7:
        members[k] = name, edit(name, inner)
    elif kind < 0.8:
        members[k] = rng.choice((*_NAMES, outside_path(rng))), inner
    elif kind < 0.88:
        members.insert(rng.randrange(len(members) + 1), members[k])
    elif kind < 0.93:
        del members[k]
    else:
        packing = zipfile.ZIP_DEFLATED
    sink = io.BytesIO()
    with warnings.catch_warnings(), zipfile.ZipFile(sink, "w", packing) as archive:
        warnings.simplefilter("ignore")  # that a name occurs twice
        for other, inside in members:
            archive.writestr(zipfile.ZipInfo(other or "x"), inside, packing)
    return sink.getvalue()
