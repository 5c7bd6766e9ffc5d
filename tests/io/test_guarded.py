# SPDX-License-Identifier: Apache-2.0
"""Files that are none, never end, or hold what nobody expects: one line, whatever they are."""

import os
import socket
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggwarp.io.guarded import CAMERA, FileError, FileKind, inside, read_bytes, read_json, read_text
from ggwarp.io.printable import printable, shown

SMALL = FileKind("a note", 10)


def test_a_file_and_a_link_to_one_are_read(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\xef\xbb\xbftext")
    (tmp_path / "b").symlink_to(tmp_path / "a")
    assert read_text(tmp_path / "b", SMALL) == "text" and len(read_bytes(tmp_path / "a", SMALL)) == 7


def make_pipe(path: Path) -> Path:
    os.mkfifo(path)
    return path


def make_socket(path: Path) -> Path:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(os.path.relpath(path))  # an address has room for a hundred characters
    return path


def make_large(path: Path) -> Path:
    path.write_bytes(bytes(11))
    return path


def make_link(path: Path) -> Path:
    path.symlink_to("/dev/zero")
    return path


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (make_pipe, "is a pipe, where a note should be"),
        (make_socket, "is a socket"),
        (make_link, "is a device"),
        (make_large, "has 11 bytes; a note has at most 10"),
        (lambda path: path.parent, "is a folder"),
        (lambda path: path, r"cannot be read \(No such file"),
        (lambda path: path / ("x" * 300), "cannot be read"),
        (lambda path: Path(f"{path}\0"), r"x\\x00: no file can have this name"),
        (lambda path: Path("/dev/zero"), "is a device"),
    ],
)
def test_what_is_no_such_file_is_refused_before_it_is_opened(tmp_path: Path, make, says: str) -> None:
    with pytest.raises(FileError, match=says) as error:
        read_bytes(make(tmp_path / "x"), SMALL)
    assert "\n" not in str(error.value)


def test_a_file_that_claims_to_be_empty_is_bounded() -> None:
    path = Path("/proc/self/environ")
    if not path.is_file() or path.stat().st_size or len(path.read_bytes()) <= SMALL.limit:
        pytest.skip("this system has no such file")
    with pytest.raises(FileError, match="never ends"):
        read_bytes(path, SMALL)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"\xff\xfe", "is not a text file"),
        (b"{", ":1: is not JSON"),
        (b"[" * 50_000, "nested too deeply"),
        (b"9" * 5000, "a number is too long"),
    ],
)
def test_json_that_cannot_be_read(tmp_path: Path, content: bytes, says: str) -> None:
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(FileError, match=says):
        read_json(tmp_path / "a.json", CAMERA)


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    content=st.binary(max_size=40)
    | st.text('[]{}",:0123456789eE+-.nulltrufas \\u', max_size=40).map(str.encode)
)
def test_any_bytes_are_json_or_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.json").write_bytes(content)
    try:
        read_json(tmp_path / "a.json", CAMERA)
    except FileError as error:
        assert str(error).startswith(str(tmp_path))


@pytest.mark.parametrize("name", ["/etc/passwd", "../a", "b/../../a", "b/../a"])
def test_names_that_lead_out_of_a_folder(tmp_path: Path, name: str) -> None:
    with pytest.raises(FileError, match="lies outside"):
        inside(tmp_path, tmp_path / name)


def test_names_that_stay_in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in (tmp_path, Path("a"), Path("../a")):
        assert inside(folder, folder / "b/c.png") == folder / "b/c.png"
    assert inside(Path("a"), tmp_path / "a/b") == tmp_path / "a/b"


@given(st.text())
def test_printable_text_is_harmless_and_stays(text: str) -> None:
    once = printable(text)
    assert once.isprintable() and printable(once) == once
    once.encode("utf-8")
    assert once == text or not text.isprintable()


def test_what_escapes_look_like() -> None:
    assert printable("a\x1b[31m\n\u202e\udcff é") == "a\\x1b[31m\\n\\u202e\\udcff é"


def test_shown_values_are_short() -> None:
    nested: list = []
    for _ in range(100_000):
        nested = [nested]
    assert shown("a\nb") == "'a\\nb'" and len(shown("x" * 10_000)) < 100
    assert "int" in shown(10**6000) and "list" in shown(nested)
    while nested:  # taken apart by hand: freeing it at once would recurse
        nested = nested.pop()
