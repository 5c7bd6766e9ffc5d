# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

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
