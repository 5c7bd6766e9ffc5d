# SPDX-License-Identifier: Apache-2.0
import pytest

from ggwarp.io.guarded import FileError
from ggwarp.io.table import read_table, write_table


def test_cells(tmp_path):
    path = tmp_path / "t.csv"
    write_table(path, ["a", "b"], [{"a": 1, "b": 0.25}, {"b": float("nan")}, {"a": None, "b": "x, y"}])
    assert path.read_text().splitlines() == ["a,b", "1,0.250000", ",", ',"x, y"']


def test_a_value_without_a_column_is_refused(tmp_path):
    with pytest.raises(ValueError, match="'c'"):
        write_table(tmp_path / "t.csv", ["a"], [{"c": 1}])
    assert not list(tmp_path.iterdir())


def test_what_was_written_is_read(tmp_path):
    path = tmp_path / "t.csv"
    write_table(path, ["a", "b"], [{"a": 1, "b": 0.25}, {"b": "x, y\nz"}])
    assert read_table(path) == [{"a": "1", "b": "0.250000"}, {"a": "", "b": "x, y\nz"}]


@pytest.mark.parametrize("text", ["a,b\n1\n", "a,b\n1,2,3\n", 'a,b\n"1\n'])
def test_a_damaged_table_is_named(tmp_path, text):
    path = tmp_path / "t.csv"
    path.write_text(text)
    with pytest.raises(FileError, match=r"t\.csv:"):
        read_table(path)
