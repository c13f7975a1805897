"""The journal: whole lines only, of one key the last, and nothing but keys in memory."""

from __future__ import annotations

import json

import pytest

from flockopt import SettingsError
from flockopt.batches.journal import ROWS, Journal, table


def opened(folder, **keywords):
    return Journal(folder, {"seed": 0}, "numbers", ("value",), **keywords)


def test_records_are_read_again_from_the_disk(tmp_path):
    with opened(tmp_path) as journal:
        for number in range(50):
            journal.append(f"{number}", {"value": number / 3})
            journal.append("0", {"value": "changes nothing"})
            assert journal["0"] == {"value": 0.0}
        assert journal["31"] == {"value": 31 / 3}
    with opened(tmp_path) as journal:
        assert len(journal) == 50 and "49" in journal and "50" not in journal
        assert [journal[key]["value"] for key in journal] == [number / 3 for number in range(50)]
        journal.append("50", {"value": None})
        assert journal["50"] == {"value": None}


def test_a_line_that_a_kill_cut_is_cut_off_and_its_place_written_anew(tmp_path):
    with opened(tmp_path) as journal:
        journal.append("a", {"value": "first"})
        journal.append("b", {"value": "x" * 10_000})
    path = tmp_path / ROWS
    path.write_bytes(path.read_bytes()[:-9_000])
    with opened(tmp_path) as journal:
        assert [*journal] == ["a"]
        journal.append("c", {"value": "y" * 10_000})
        assert journal["c"]["value"] == "y" * 10_000
    assert [json.loads(line)["key"] for line in path.read_text().splitlines()] == ["a", "c"]


def test_what_does_not_stand_may_be_written_again_and_the_last_counts(tmp_path):
    for value in ("bad", "good", "bad"):
        with opened(tmp_path, stands=lambda record: record["value"] != "bad") as journal:
            journal.append("a", {"value": value})
    with opened(tmp_path) as journal:
        assert journal["a"] == {"value": "good"}


@pytest.mark.parametrize(
    ("line", "words"),
    [("{", "line 2 is not JSON"), ('{"key": "b"}', "line 2.value is missing"), ('{"key": 3, "value": 1}', "line 2.key is 3"),
     ('{"key": "b", "valu": 1}', "did you mean value"), ("[]", r"line 2 is \[\]")],
)  # fmt: skip
def test_what_somebody_else_wrote_is_named(tmp_path, line, words):
    (tmp_path / ROWS).write_text(f'{{"key": "a", "value": 1}}\n{line}\n')
    with pytest.raises(SettingsError, match=words):
        opened(tmp_path)
    (tmp_path / ROWS).unlink()
    with opened(tmp_path):  # the folder is not held by the one that failed
        pass


def test_a_folder_is_one_runs_on_one_set_of_terms(tmp_path):
    with opened(tmp_path), pytest.raises(SettingsError, match="in use"):
        opened(tmp_path)
    with pytest.raises(SettingsError, match="holds numbers with seed 0; this run has 1"):
        Journal(tmp_path, {"seed": 1}, "numbers", ("value",))


def test_a_table_leaves_empty_what_is_not_known():
    assert table(("a", "b"), [{"a": 1 / 3, "c": 9}, {"b": "x,y"}]) == 'a,b\n0.333333333,\n,"x,y"\n'
