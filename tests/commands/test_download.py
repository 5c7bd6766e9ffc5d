# SPDX-License-Identifier: Apache-2.0
"""ggwarp download against a server on this machine: resuming, refusing, unpacking."""

import errno
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from rich.console import Console

from archive_server import TUM, Handler, Server, files_of, make_tgz, make_zip
from ggwarp.commands import download


@pytest.fixture(autouse=True)
def no_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(download, "_PAUSE", 0.0)


@pytest.fixture
def server() -> Iterator[Server]:
    with Server(("127.0.0.1", 0), Handler) as server:
        server.requests, server.break_after = [], []
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def run(*arguments: object) -> int:
    return download.main([str(argument) for argument in arguments])


def test_a_tum_sequence_lands_under_the_data_root(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.content = make_tgz(files_of(TUM))
    assert run("tum", "fr1/xyz", "--data", tmp_path, "--url", server.url("xyz.tgz")) == 0
    for name, data in files_of(TUM).items():
        assert (tmp_path / "TUM" / name).read_bytes() == data
    assert [path.name for path in (tmp_path / "TUM").iterdir()] == [TUM]
    out = capsys.readouterr().out
    assert "CC BY 4.0" in out and f"--seq {TUM}" in out


def test_a_replica_scene_is_unpacked_alone_and_the_archive_serves_the_next(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenes = {f"Replica/{scene}/traj.txt": scene.encode() for scene in ("office0", "office1")}
    server.content = make_zip({"Replica/cam_params.json": b"{}", **scenes})
    arguments = ("--data", tmp_path, "--url", server.url("Replica.zip"))
    assert run("replica", "office0", *arguments) == 0
    assert (tmp_path / "Replica/office0/traj.txt").read_bytes() == b"office0"
    assert (tmp_path / "Replica/cam_params.json").is_file()
    assert not (tmp_path / "Replica/office1").exists()
    assert "non-commercial" in capsys.readouterr().out
    assert run("replica", "office1", *arguments) == 0
    assert (tmp_path / "Replica/office1").is_dir() and (tmp_path / "Replica/office0").is_dir()
    assert len(server.requests) == 1


def test_what_is_there_is_not_fetched_again(server: Server, tmp_path: Path) -> None:
    (tmp_path / "TUM" / TUM).mkdir(parents=True)
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 0
    assert not server.requests


def test_a_broken_connection_is_resumed(server: Server, tmp_path: Path) -> None:
    server.content = make_tgz(files_of(TUM))
    server.break_after = [1000, 2000]
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 0
    assert [wanted for _, wanted in server.requests] == [None, "bytes=1000-", "bytes=3000-"]
    assert (tmp_path / "TUM" / TUM / "rgb/1.png").read_bytes() == files_of(TUM)[f"{TUM}/rgb/1.png"]


def test_a_later_run_resumes(server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    server.content = make_tgz(files_of(TUM))
    server.break_after = [700, 0, 0, 0, 0, 0]
    arguments = ("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz"))
    assert run(*arguments) == 2
    error = capsys.readouterr().err
    assert f"ended after 700 of {len(server.content)} bytes; run the same command" in error
    assert error.count("\n") == 1
    server.requests.clear()
    assert run(*arguments) == 0
    assert [wanted for _, wanted in server.requests] == ["bytes=700-"]


def test_a_server_without_ranges_starts_over(server: Server, tmp_path: Path) -> None:
    server.content, server.knows_ranges = make_tgz(files_of(TUM)), False
    server.break_after = [1000]
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 0
    assert len(server.requests) == 2


def test_an_archive_that_changed_meanwhile_is_not_spliced(server: Server, tmp_path: Path) -> None:
    part = tmp_path / "TUM/.a.tgz.part"
    part.parent.mkdir()
    part.write_bytes(b"of the old archive")
    (part.parent / f"{part.name}.version").write_text('"0"')
    server.content = make_tgz(files_of(TUM))
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 0


def test_a_part_longer_than_the_archive_starts_over(server: Server, tmp_path: Path) -> None:
    server.content = make_tgz(files_of(TUM))
    part = tmp_path / "TUM/.a.tgz.part"
    part.parent.mkdir()
    part.write_bytes(bytes(len(server.content) + 1))
    (part.parent / f"{part.name}.version").write_text(server.version)
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 0


@pytest.mark.parametrize(("status", "tries"), [(404, 1), (403, 1), (503, 5)])
def test_a_refusal_is_one_line(
    server: Server,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    status: int,
    tries: int,
) -> None:
    server.status = status
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 2
    error = capsys.readouterr().err
    assert str(status) in error and server.url("a.tgz") in error and error.count("\n") == 1
    assert len(server.requests) == tries


def test_no_server_is_one_line(server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    url = server.url("a.tgz")
    server.server_close()
    assert run("tum", TUM, "--data", tmp_path, "--url", url) == 2
    assert "refused" in capsys.readouterr().err


def corrupted(data: bytes) -> bytes:
    return data[:2000] + bytes([data[2000] ^ 255]) + data[2001:]


@pytest.mark.parametrize("damage", [lambda data: data[:-4000], lambda data: data[:-4], corrupted])
@pytest.mark.parametrize("kind", ["tum", "replica"])
def test_a_damaged_archive_leaves_nothing(
    server: Server,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    kind: str,
    damage,
) -> None:
    name, file = (TUM, "a.tgz") if kind == "tum" else ("office0", "a.zip")
    files = files_of(TUM if kind == "tum" else "Replica/office0")
    server.content = damage(make_tgz(files) if kind == "tum" else make_zip(files))
    assert run(kind, name, "--data", tmp_path, "--url", server.url(file)) == 2
    assert "is damaged" in capsys.readouterr().err
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    "path", ["../evil.txt", "/evil.txt", f"{TUM}/../../evil.txt", "C:evil.txt", "..\\evil.txt"]
)
@pytest.mark.parametrize("make", [make_tgz, make_zip])
def test_nothing_is_written_outside_the_data_root(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str], path: str, make
) -> None:
    server.content = make({**files_of(TUM), path: b"evil"})
    data = tmp_path / "deep" / "data"
    file = "a.zip" if make is make_zip else "a.tgz"
    assert run("tum", TUM, "--data", data, "--url", server.url(file)) == 2
    assert "unsafe path" in capsys.readouterr().err
    assert not list(tmp_path.rglob("*evil*")) and not list(tmp_path.rglob("rgb.txt"))


def test_links_are_refused(server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    server.content = make_tgz(files_of(TUM), link="/etc/passwd")
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 2
    assert "a link or device" in capsys.readouterr().err


@pytest.mark.parametrize("length", ["abc", "-5", "\u0665", "9" * 5000])
def test_a_length_that_is_none_is_no_traceback(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str], length: str
) -> None:
    """Without one the archive itself says whether it is whole."""
    server.content = make_tgz(files_of(TUM))
    server.length = length.encode().decode("latin-1")
    code = run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz"))
    assert code == 0 or (code == 2 and capsys.readouterr().err.count("\n") == 1)


def test_what_the_disk_cannot_hold_is_not_fetched(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.length = str(10**18)
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 2
    assert "1,000,000,000,000,000,000 bytes more are needed" in capsys.readouterr().err


@pytest.mark.parametrize(
    "url", ["http://[", "http://a b/x.tgz", "http://" + "x" * 300 + "/a.tgz", "http:///.."]
)
def test_addresses_that_are_none(tmp_path: Path, capsys: pytest.CaptureFixture[str], url: str) -> None:
    assert run("tum", TUM, "--data", tmp_path, "--url", url) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_an_archive_of_something_else(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    server.content = make_tgz({"other/a.txt": b""})
    assert run("tum", TUM, "--data", tmp_path, "--url", server.url("a.tgz")) == 2
    assert f"holds no {TUM}" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("replica", "room9"), "no such Replica scene; there are room0"),
        (("tum", "desk"), "no such TUM sequence"),
        (("tum", TUM, "--url", "file:///etc/passwd"), "is no http:// or https:// address"),
    ],
)
def test_wrong_arguments_are_one_line(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], says: str
) -> None:
    assert run(*arguments) == 2
    assert says in capsys.readouterr().err


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "data").touch()
    assert run("tum", TUM, "--data", tmp_path / "data", "--url", "http://127.0.0.1:9/a.tgz") == 2
    error = capsys.readouterr().err
    assert "Not a directory" in error and "Traceback" not in error


@pytest.mark.parametrize(
    ("name", "url"),
    [
        ("fr1/xyz", f"https://cvg.cit.tum.de/rgbd/dataset/freiburg1/{TUM}.tgz"),
        (
            "freiburg3_long_office_household",
            "https://cvg.cit.tum.de/rgbd/dataset/freiburg3/rgbd_dataset_freiburg3_long_office_household.tgz",
        ),
    ],
)
def test_official_addresses(tmp_path: Path, name: str, url: str) -> None:
    assert download.find_source("tum", name, tmp_path).url == url
    assert download.find_source("replica", "room0", tmp_path).url == download.REPLICA_URL


def test_the_library_call_says_where_the_sequence_is(server: Server, tmp_path: Path) -> None:
    server.content = make_tgz(files_of(TUM))
    source = download.find_source("tum", TUM, tmp_path, server.url("a.tgz"))
    assert download.fetch(source, Console(quiet=True)) == tmp_path / "TUM" / TUM


def test_a_disk_that_refuses_is_said_in_one_line(tmp_path, monkeypatch, capsys):
    def refuse(source, console):
        raise OSError(errno.EROFS, "Read-only file system", str(tmp_path / "Replica"))

    monkeypatch.setattr(download, "fetch", refuse)
    assert download.main(["replica", "office0", "--data", str(tmp_path)]) == 2
    assert capsys.readouterr().err == f"ggwarp download: {tmp_path / 'Replica'}: Read-only file system\n"
