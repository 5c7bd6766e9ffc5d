# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ggwarp.io.toml import TomlError, merged, read_toml, write_toml


@dataclass(frozen=True)
class Inner:
    rate: float = 0.5
    steps: tuple[int, ...] = (1, 2)
    span: tuple[float, float] = (0.1, 0.2)


@dataclass(frozen=True)
class Outer:
    name: str | None = None
    count: int = 3
    on: bool = True
    folder: Path | None = None
    mode: Literal["a", "b"] = "a"
    pace: float | Literal["free"] | None = None
    inner: Inner = field(default_factory=Inner)


def _round_trip(config: Outer, path: Path) -> Outer:
    write_toml(config, path)
    return merged(Outer(), read_toml(path), where=str(path))


def test_round_trip(tmp_path):
    config = Outer("x", -4, False, Path("/a b"), "b", 2.0, Inner(1e-15, (), (float("inf"), 2.0)))
    assert _round_trip(config, tmp_path / "c.toml") == config
    assert _round_trip(Outer(), tmp_path / "c.toml") == Outer()
    assert _round_trip(Outer(pace="free"), tmp_path / "c.toml") == Outer(pace="free")


@given(text=st.text(st.characters(exclude_categories=["Cs"])), rate=st.floats(allow_nan=False))
def test_any_text_and_number_survive(tmp_path_factory, text, rate):
    config = Outer(name=text, inner=Inner(rate=rate))
    assert _round_trip(config, tmp_path_factory.mktemp("toml") / "c.toml") == config


def test_a_part_leaves_the_rest():
    assert merged(Outer(count=9), {"inner": {"rate": 2}}, where="f") == Outer(count=9, inner=Inner(rate=2.0))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"colour": 1}, "f: unknown key 'colour'"),
        ({"inner": {"ratee": 1}}, "f: unknown key 'inner.ratee'"),
        ({"inner": 3}, "section \\[inner\\]"),
        ({"count": 1.5}, "count = 1.5, but int is needed"),
        ({"pace": "fre"}, "pace = 'fre', but float or one of free is needed"),
        ({"count": True}, "count = True, but int is needed"),
        ({"on": 1}, "on = 1, but bool is needed"),
        ({"name": 7}, "name = 7, but str is needed"),
        ({"mode": "c"}, "mode = 'c', but one of a, b is needed"),
        ({"inner": {"rate": True}}, "inner.rate = True, but float is needed"),
        ({"inner": {"span": [1.0]}}, "inner.span"),
        ({"inner": {"steps": ["x"]}}, "inner.steps"),
    ],
)
def test_mistakes_are_named(values, message):
    with pytest.raises(TomlError, match=message):
        merged(Outer(), values, where="f")


def test_bad_files_are_named(tmp_path):
    with pytest.raises(TomlError, match=r"none\.toml: no such file"):
        read_toml(tmp_path / "none.toml")
    (tmp_path / "bad.toml").write_text("a = = 1")
    with pytest.raises(TomlError, match=r"bad\.toml: "):
        read_toml(tmp_path / "bad.toml")
    with pytest.raises(TomlError, match=str(tmp_path)):
        read_toml(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("count = " + "9" * 5000, "a number has thousands of digits"),
        ("count = 0x" + "f" * 5000, "count = a int beyond all bounds, but no number is that large"),
        ("count = 1" + "0" * 400, "but no number is that large"),
        ("inner.rate = 1" + "0" * 400, "but no number is that large"),
        ("pace = 1" + "0" * 400, "but no number is that large"),
        ("x = " + "[" * 100_000, "nested too deeply"),
        ("x = " + "{a=" * 50_000, "nested too deeply"),
        ("a." * 50_000 + "b = 1", "more than 16 parts"),
        ("[" + "a . " * 50_000 + "b]", "more than 16 parts"),
        ("'a'.\"b\"." * 5000 + "c = 1", "more than 16 parts"),
        ("x = {" + "a." * 5000 + "b = 1}", "more than 16 parts"),
        ("#" * (1 << 20) + "\n", "at most 1,048,576"),
        ('folder = "a\\u0000b"', "no file's name holds a NUL"),
        ('"a\\u001b[31m\\n" = 1', r"unknown key 'a\\x1b\[31m\\n'"),
        ("name = 'a\x1b'", "Illegal character|Invalid|Found invalid"),
        ("mode = [[[[[[]]]]]]", "mode = .*, but one of a, b"),
    ],
)
def test_hostile_files_end_in_one_line(tmp_path, text, message):
    (tmp_path / "c.toml").write_text(text)
    with pytest.raises(TomlError, match=message) as error:
        merged(Outer(), read_toml(tmp_path / "c.toml"), where="c.toml")
    assert str(error.value).isprintable() and len(str(error.value)) < 400


@pytest.mark.parametrize(
    "name", ["-_" * 200_000, '"' * 200_001, "'a' " * 100_000, "a \t" * 100_000, ". " * 200_000]
)
def test_looking_for_deep_keys_takes_no_time(tmp_path, name):
    """Neither to find one nor to find none; what is wrong otherwise is the parser's to say."""
    (tmp_path / "c.toml").write_text(name)
    with pytest.raises(TomlError):
        read_toml(tmp_path / "c.toml")


def test_a_pipe_is_no_configuration(tmp_path):
    os.mkfifo(tmp_path / "c.toml")
    with pytest.raises(TomlError, match="is a pipe"):
        read_toml(tmp_path / "c.toml")


def test_names_that_are_not_utf_8_leave_a_file_that_is_read(tmp_path):
    write_toml(Outer(name="a\udcff"), tmp_path / "c.toml")
    assert read_toml(tmp_path / "c.toml")["name"] == "a?"


leaves = st.integers() | st.floats() | st.booleans() | st.text(max_size=4) | st.just(10**400)
tables = st.recursive(
    leaves,
    lambda v: (
        st.lists(v, max_size=3)
        | st.dictionaries(st.sampled_from(["inner", "rate", "count", "x"]), v, max_size=3)
    ),
    max_leaves=8,
)


@given(values=st.dictionaries(st.sampled_from(["name", "count", "folder", "mode", "pace", "inner"]), tables))
def test_any_values_are_a_configuration_or_an_error_that_names_them(values):
    try:
        merged(Outer(), values, where="f")
    except TomlError as error:
        assert str(error).startswith("f: ") and str(error).isprintable()
