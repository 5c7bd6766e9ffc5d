# SPDX-License-Identifier: Apache-2.0
import pytest

from ggwarp.io.table import write_table


def test_cells(tmp_path):
    path = tmp_path / "t.csv"
    write_table(path, ["a", "b"], [{"a": 1, "b": 0.25}, {"b": float("nan")}, {"a": None, "b": "x, y"}])
    assert path.read_text().splitlines() == ["a,b", "1,0.250000", ",", ',"x, y"']


def test_a_value_without_a_column_is_refused(tmp_path):
    with pytest.raises(ValueError, match="'c'"):
        write_table(tmp_path / "t.csv", ["a"], [{"c": 1}])
    assert not list(tmp_path.iterdir())
