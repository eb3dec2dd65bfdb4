"""No folder, bucket or password of the machine that made a run is in a published text."""

import json
import re
from time import process_time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from stable_data.publishing.private_paths import public_value, without_folder, without_folders


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("read /data/a b/cup.glb", "read cup.glb"),
        ("(/a/b/c.glb)", "(c.glb)"),
        (r"C:\Users\me\cup.glb is odd", "cup.glb is odd"),
        ("~/data/cup.glb", "cup.glb"),
        ("see /home/alice", "see ~"),
        ("/root is full", "~ is full"),
        ("/root/x and /rooted/x/y", "x and y"),
        ("file:///home/alice/x.glb", "x.glb"),
        ("D:/Users/alice/x.glb", "x.glb"),
        (r"D:\data\set\x.glb", "x.glb"),
        (r"\\server\alice\x.glb", "x.glb"),
        ("transformers:/home/alice/models/qwen", "transformers:qwen"),
        ("//nas/jane/a", "a"),
        ("/srv//jane//a.glb", "a.glb"),
        ("~jane/data/x.glb", "x.glb"),
        ('"/data/Jane Doe/cup.glb" is odd', '"cup.glb" is odd'),
        ("C:/Users/Jane Doe/x", "x"),
        ('"C:/Users/Jane Doe" is full', '"~" is full'),
        ("/home/jane's/x", "x"),
        ("'/home/jane's/x' is odd", "'x' is odd"),
        ("/home/jane's is full", "~ is full"),
        ("/data/jane (old)/x, y", "x, y"),
        ("/a/b:/c/d", "d"),
        ("[warn] D:\\secret\\jane\\x.glb", "[warn] x.glb"),
        ("[x](/home/jane/x)", "[x](x)"),
    ],
)
def test_absolute_paths_are_reduced_to_their_last_part(text: str, expected: str) -> None:
    assert without_folders(text) == expected
    assert without_folders(expected) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("s3://private-bucket/user/x.glb cannot be read", "x.glb cannot be read"),
        ("s3://private-bucket: cannot be read", "s3://: cannot be read"),
        ("s3://key:secret@bucket/a?endpoint_override=http%3A//10.0.0.5/x", "a"),
        ("gs://b/a/x and hdfs://node:8020/user/jane/y", "x and y"),
        ("abfs://box@account.dfs.core.windows.net/a/x", "x"),
        ("http://user:pass@10.0.0.5:8000/v1 did not answer", "http://10.0.0.5:8000/v1 did not answer"),
        ("HTTPS://me@example.org", "HTTPS://example.org"),
        ("https://example.org/a?file=/home/jane/x", "https://example.org/a?file=x"),
        ("see (https://example.org/a, /home/jane/x)", "see (https://example.org/a, x)"),
    ],
)
def test_addresses_lose_what_is_private(text: str, expected: str) -> None:
    assert without_folders(text) == expected
    assert without_folders(expected) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ('{"file": "/home/alice/layouts/a.json"}', '{"file": "a.json"}'),
        (r'{"file": "C:\\Users\\alice\\a\\b.json"}', r'{"file": "b.json"}'),
        (r'{"p":"D:\\secret\\jane\\x.glb"}', '{"p":"x.glb"}'),
        ('{"p": "/data/a b c d e f/x.glb", "q": 1.50}', '{"p": "x.glb", "q": 1.50}'),
        (json.dumps([json.dumps({"p": r"D:\secret\jane\x.glb"})]), json.dumps([json.dumps({"p": "x.glb"})])),
        (r'{"p": "\ud800 /a/b/c"}', r'{"p": "\ud800 c"}'),
        ('{"p": "/a/b/c', '{"p": "c'),
    ],
)
def test_texts_of_json_are_changed_as_what_they_mean(text: str, expected: str) -> None:
    assert without_folders(text) == expected
    assert without_folders(expected) == expected


@pytest.mark.parametrize(
    "text",
    [
        "3 kg/m/s and and/or, task_0/3, 2 m/s",
        "Layout_info/desk/1/layout.json",
        "../library/a/b.glb",
        "https://example.org/home/alice/x, https://example.org:80/a/b",
        "it is 1/2 /m2 or a / b",
        "<b>a</b> <i>b/c</i>",
        "~5/6 of it",
        r'{"plan": "B:\n\nPut\nThen", "a": "[\n\t{x"}',
        r"{\n\tx}",
    ],
)
def test_other_texts_stay_as_they_are(text: str) -> None:
    assert without_folders(text) == text


def test_a_path_with_spaces_is_one() -> None:
    assert without_folder("/home/alice/a very secret old project, of mine/data/cup.glb") == "cup.glb"
    assert without_folder("generated") == "generated"
    assert without_folder("s3://bucket/a b c d e f/x?y=/z") == "x"
    assert without_folder("https://me:pass@example.org/a b/c") == "https://example.org/a b/c"
    for home in ("/home/alice", "/home/alice/", "/root", r"C:\Users\alice", "file:///home/alice"):
        assert without_folder(home) == "~"


def test_a_manifest_has_no_addresses() -> None:
    assert public_value({"/home/jane/x": ["s3://bucket/x", "//nas/jane/y"]}) == {"x": ["", "y"]}


# --- any path -----------------------------------------------------------------------------------------------------------------

_SIGNS = "abcXYZ019_-+@()#&=é.;,!"
_EDGES = "abcXYZ019_-é"


def names(spaces: int) -> st.SearchStrategy[str]:
    """Names of folders, each with the letters QZ, which nothing else has, in every word."""
    word = st.tuples(st.text(_SIGNS, max_size=5), st.sampled_from(["QZ", "QZ's"]), st.text(_EDGES, max_size=3)).map("".join)
    plain = word.map(lambda found: found.lstrip(".;,!#@"))
    return st.lists(plain, min_size=1, max_size=spaces + 1).map(" ".join)


_ROOTS = st.sampled_from(["/", "//", "/home/", "/Users/", "~/", "~QZ/", "C:\\", "d:/Users/", "\\\\QZ\\", "file:///", "file:/"])
_STORES = st.sampled_from(["s3://", "gs://", "gcs://", "hdfs://", "abfs://", "abfss://", "s3a://"])
_BUCKETS = st.sampled_from(["QZ", "QZ:8020", "QZ@QZ.dfs.core.windows.net", "QZ:QZ@QZ"])
_STARTS = _ROOTS | st.tuples(_STORES, _BUCKETS).map(lambda found: f"{found[0]}{found[1]}/")


def paths(spaces: int) -> st.SearchStrategy[str]:
    folder = st.tuples(names(spaces), st.sampled_from(["/", "//", "\\", "/\\"])).map("".join)
    folders = st.lists(folder, min_size=1, max_size=4).map("".join)
    return st.tuples(_STARTS, folders, st.sampled_from(["x.glb", "last", "y"])).map("".join)


def is_public(text: str) -> bool:
    return "QZ" not in without_folders(text)


@given(paths(3), st.sampled_from(["{}", "asset x: {} cannot be read", "({})", "a={}, b", "see\n{}: 1/2", "[1] {}"]))
def test_no_folder_survives_in_a_sentence(path: str, sentence: str) -> None:
    text = sentence.format(path)
    assert is_public(text)
    assert without_folders(without_folders(text)) == without_folders(text)


@given(paths(8), st.sampled_from(['"{}"', "'{}' is odd", 'asset x: "{}": odd', "see `{}`", "“{}”"]))
def test_no_folder_survives_in_quotation_marks(path: str, sentence: str) -> None:
    assert is_public(sentence.format(path))


@given(paths(8), st.booleans())
def test_no_folder_survives_in_json(path: str, is_nested: bool) -> None:
    document: object = {"a": [path, {path: 1, "b": f"see {path.replace(' ', '')}"}]}
    text = json.dumps({"c": json.dumps(document)} if is_nested else document)
    changed = without_folders(text)
    assert "QZ" not in changed
    json.loads(changed)


@given(paths(8))
def test_no_folder_survives_in_a_column_of_paths(path: str) -> None:
    assert "QZ" not in without_folder(path)


@given(st.text("QZ0%._~-", min_size=1), st.text("QZ0%._~-:!$", max_size=9), st.sampled_from(["http", "https", "s3"]))
def test_no_user_survives(user: str, password: str, scheme: str) -> None:
    text = f"see {scheme}://QZ{user}:{password}@host/v1, it did not answer"
    assert is_public(text)


@given(st.text("/\\~:.'\" abC{}[]?@s3"))
def test_every_text_is_read(text: str) -> None:
    changed = without_folders(text)
    assert not re.search(r"(?<![\w./\\~:])/home/[ab]", changed)


@pytest.mark.parametrize(
    "piece",
    [
        *(
            "/",
            "\\",
            '"',
            "~",
            "a:",
            "/a ",
            "'/",
            "a/",
            "/a:",
            "s3://",
            "http://",
            "/home/",
            ".a",
            "a.",
            "/a b c d e",
            "/x.glb ",
        ),
        *("C:/", "'s3://a", "s3://a?", "/.glb", "/home/x' ", ".'", "'/x'a", '[\\"', '"\\"', "x"),
    ],
)
@pytest.mark.parametrize("start", ["", "/", "[", "/home/"])
def test_time_is_linear(piece: str, start: str) -> None:
    began = process_time()
    without_folders(start + piece * 20_000)
    assert process_time() - began < 3  # what is quadratic takes minutes
