"""The tables of the paper from figures: what is measured, what is published, and what is missing with its command."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from benchmarks.paper_tables import RESULTS, TABLES, fill_page, main
from pipelines.evaluate.figures import FIGURES, Repetition, estimate_figures
from stable_data.scores.detection import DetectionScore

PAGE = RESULTS.parents[1] / "docs" / "paper_tables.md"


def printed(folder: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, str]:
    """The printed tables by title."""
    main([str(folder)])
    parts = capsys.readouterr().out.split("== ")[1:]
    return {part.partition("\n")[0]: part for part in parts}


def evaluation() -> dict[str, Any]:
    row = {figure.key: 1.0 for figure in FIGURES} | {"oc": None}
    found = estimate_figures({"stable": [Repetition(("a", "b"), {"a": row, "b": row}, {})], "files": []})
    systems = {
        label: {
            "system": label,
            "row": "Ours",
            "repetitions": int(label == "stable"),
            "figures": {key: asdict(value) for key, value in figures.items()},
            "notes": ["not run: needs PLACE"] if label == "files" else [],
        }
        for label, figures in found.items()
    }
    names = {"frechet": "FID", "kernel": "KID", "judge": "symbolic"}
    return {"num_tasks": 2, "names": names, "notes": [], "systems": systems}


def test_what_is_missing_is_named_with_its_command_beside_what_is_published(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    found = printed(tmp_path, capsys)
    assert len(found) == len(TABLES) == 9
    for table in TABLES:
        text = found[table.title]
        assert f"not measured; {table.command_for(tmp_path)}" in text
        assert "FOLDER" not in text
        assert bool(table.published) == ("not measured here:" in text)
    assert "99.4" in found["Table 1: systems"]


def test_measured_figures_stand_before_published_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "systems").mkdir()
    (tmp_path / "systems" / "evaluation.json").write_text(json.dumps(evaluation()))
    layouts = [{"method": "start", "bucket": "0-10", "num_collisions": n, "num_objects": 5, "num_dropped": n} for n in (0, 3)]
    (tmp_path / "correction.json").write_text(json.dumps(layouts))
    scores = [asdict(DetectionScore("mug", 4, 4, {0.5: 1.0, 0.75: 0.5}, {0.5: 1.0, 0.75: 0.5}))]
    (tmp_path / "boxes.json").write_text(json.dumps(scores))
    card = {"jitter": {"raw": {"oc_sdf": 0.2, "float_gap": 0.3, "oc": 0.1, "float_rate": None}}}
    arms = [{"name": "no support", "card": card}, {"name": "no support", "card": {"swap": card["jitter"]}}]
    (tmp_path / "corrector_ablation.json").write_text(json.dumps(arms))
    fixed = {"method": "lego_net", "moved_category": 0.2, "emd_category": 0.3, "clean": None, "scenes": 20, "failed": 2}
    figures = [{**fixed, "oc_sampled": oc, "oc": oc / 2} for oc in (0.1, 0.3)]
    (tmp_path / "rearrangement.json").write_text(json.dumps({"figures": figures}))
    summary = {"right": 1, "edits": 2, "right_by_kind": {"add": 1, "move": 0}, "edits_by_kind": {"add": 1, "move": 1}}
    (tmp_path / "edits.json").write_text(json.dumps({"engines": {"embedded": {"summary": summary}}}))
    found = printed(tmp_path, capsys)
    measured, published = found["Table 1: systems"].split("published (")
    (ours,) = (line for line in measured.splitlines() if line.startswith("stable (Ours)"))
    assert "unknown" in ours  # OC
    assert "99.4" not in measured
    assert "99.4" in published
    assert "files: not run: needs PLACE" in measured
    lines = found["All figures of the systems (not in the paper)"].splitlines()
    assert lines[1].split() == ["stable"]  # files was not run
    assert not any(line.startswith("exact OC, %") for line in lines)  # unknown for all
    assert next(line for line in lines if line.startswith("AwT, %")).split()[2] == "100.0"
    (start,) = (
        line for line in found["Table 2: layouts without collisions, by collisions at the start"].splitlines() if "1/2" in line
    )
    assert start.endswith("3 of 10")
    text = found["Table 3 (a): the losses of the Physics Corrector"]
    arm = next(line for line in text.splitlines() if line.startswith("without L_sup"))
    assert arm.split()[-8:] == ["20.0", "±0.0", "30.0", "±0.0", "10.0", "±0.0", "unknown", "2"]
    assert "not run" in found["Table 3 (b): one request or stages"]
    row = next(line for line in found["Rearrangement"].splitlines() if line.startswith("lego_net"))
    assert row.split()[1:] == [
        "0.200",
        "±0.000",
        "0.300",
        "±0.000",
        "20.00",
        "±127.06",
        "10.00",
        "±63.53",
        "unknown",
        "40",
        "4",
        "2",
    ]
    assert "0.50" in found["Manipulability"]
    assert "1/2" in found["Editing (the paper shows pictures)"]


def test_a_file_with_other_content_is_named_and_the_other_tables_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "correction.json").write_text("{]")
    (tmp_path / "boxes.json").write_text('{"a": 1}')
    found = printed(tmp_path, capsys)
    assert "has other content than expected" in found["Table 2: layouts without collisions, by collisions at the start"]
    assert "has other content than expected" in found["Manipulability"]
    assert len(found) == len(TABLES)


@pytest.mark.parametrize(("words", "status"), [(["--all"], 2), (["--help"], 0), (["a", "b"], 2)])
def test_other_words_are_answered_with_what_it_needs(words: list[str], status: int, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(words)
    assert caught.value.code == status
    assert "FOLDER" in "".join(capsys.readouterr())


def test_a_folder_that_is_not_there_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path / "none")])
    assert "no such folder" in capsys.readouterr().err


def test_the_figures_of_the_repository_can_be_read(capsys: pytest.CaptureFixture[str]) -> None:
    main([])
    printed_text = capsys.readouterr().out
    assert "other content than expected" not in printed_text
    described = (RESULTS / "README.md").read_text("utf-8")
    for path in RESULTS.rglob("*.json"):
        assert f"`{path.relative_to(RESULTS).as_posix()}`" in described
    for table in TABLES:
        assert (RESULTS / table.file).is_file() == (f"not measured; {table.command_for(RESULTS)}" not in printed_text)


def test_the_page_of_all_tables_has_the_figures_of_the_repository() -> None:
    text = PAGE.read_text("utf-8")
    assert fill_page(text, RESULTS) == text, "write it again: python -m benchmarks.paper_tables --page docs/paper_tables.md"


def test_a_page_gets_the_tables_of_a_folder_and_keeps_its_sentences(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("".join(f"## {table.title}\n\nA sentence.\n\n```text\nold\n```\n\n" for table in TABLES))
    main([str(tmp_path), "--page", str(page)])
    text = page.read_text()
    assert text.count("not measured;") == text.count("A sentence.") == len(TABLES)
    assert "old" not in text
    main([str(tmp_path), "--page", str(page)])
    assert page.read_text() == text


def test_a_page_without_a_section_for_a_table_is_refused_and_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"## {TABLES[0].title}\n\nno block\n")
    with pytest.raises(SystemExit, match="2"):
        main([str(tmp_path), "--page", str(page)])
    assert f"no section '## {TABLES[0].title}'" in capsys.readouterr().err
    assert page.read_text() == f"## {TABLES[0].title}\n\nno block\n"
