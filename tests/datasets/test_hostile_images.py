# SPDX-License-Identifier: Apache-2.0
"""Images that claim too much or hold too little."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ggwarp.datasets import FrameError
from ggwarp.datasets.formats.jpeg import JpegError, check_markers, decode_jpeg
from ggwarp.datasets.formats.mask_file import read_mask
from ggwarp.datasets.images import read_colour, read_depth

HEIGHT, WIDTH = 37, 51
FORMS = {
    "baseline": [],
    "restarts": [cv2.IMWRITE_JPEG_RST_INTERVAL, 3],
    "optimised": [cv2.IMWRITE_JPEG_OPTIMIZE, 1],
    "full colour": [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444],
}
PROGRESSIVE = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]


def picture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 255, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    return cv2.GaussianBlur(noise, (0, 0), 1.5)


def encoded(suffix: str, image: np.ndarray, options: list[int] | None = None) -> bytes:
    return cv2.imencode(suffix, image, options or [])[1].tobytes()


def save(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("grey", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_a_whole_jpeg_is_decoded_as_by_opencv(form: str, grey: bool) -> None:
    image = picture()[..., 0] if grey else picture()
    data = encoded(".jpg", image, FORMS[form])
    check_markers(data)
    np.testing.assert_array_equal(decode_jpeg(data), cv2.imdecode(np.frombuffer(data, np.uint8), -1))
    assert decode_jpeg(encoded(".jpg", np.full_like(image, 128), FORMS[form])) is not None


@pytest.mark.parametrize("share", [0.45, 0.6, 0.75, 0.9])
@pytest.mark.parametrize("form", FORMS)
def test_a_jpeg_cut_short_and_ended_is_refused(tmp_path: Path, form: str, share: float) -> None:
    """The end marker is there, the picture's lower part is not."""
    whole = encoded(".jpg", picture(), [*FORMS[form], cv2.IMWRITE_JPEG_QUALITY, 98])
    begin = whole.index(b"\xff\xda") + 20
    path = save(tmp_path / "a.jpg", whole[: begin + int(share * (len(whole) - begin))] + b"\xff\xd9")
    with pytest.raises(FrameError, match=r"a\.jpg: is truncated"):
        read_colour(path)


@pytest.mark.parametrize("form", FORMS)
def test_a_jpeg_damaged_in_its_middle_is_refused(tmp_path: Path, capfd, form: str) -> None:
    """Of 40 places where a piece is left out, all but a few: the codes may fall into step again."""
    whole = encoded(".jpg", cv2.resize(picture(), (300, 200)), FORMS[form])
    begin, refused = whole.index(b"\xff\xda") + 20, 0
    places = np.linspace(begin, len(whole) - 300, 40).astype(int).tolist()
    for at in places:
        path = save(tmp_path / "a.jpg", whole[:at] + whole[at + 256 :])
        try:
            read_colour(path)
        except FrameError as error:
            refused += "is damaged" in str(error) or "is truncated" in str(error)
    assert refused >= 0.9 * len(places) and capfd.readouterr().err == ""


@pytest.mark.parametrize("padding", [b"\0" * 7, b"\xff\0\0"])
def test_codes_that_a_camera_padded_are_whole(tmp_path: Path, capfd, padding: bytes) -> None:
    data = encoded(".jpg", picture())
    want = read_colour(save(tmp_path / "a.jpg", data))
    padded = data[:-2] + padding + data[-2:]
    np.testing.assert_array_equal(read_colour(save(tmp_path / "b.jpg", padded)), want)
    with pytest.raises(FrameError, match=r"b\.jpg: is damaged \(2 extraneous bytes"):
        read_colour(save(tmp_path / "b.jpg", data[:-2] + b"too many!" + data[-2:]))
    assert capfd.readouterr().err == ""


def test_a_progressive_jpeg_without_its_last_scans_is_refused(tmp_path: Path) -> None:
    whole = encoded(".jpg", picture(), PROGRESSIVE)
    read_colour(save(tmp_path / "a.jpg", whole))
    for share in (0.4, 0.6, 0.8):
        path = save(tmp_path / "a.jpg", whole[: int(share * len(whole))] + b"\xff\xd9")
        with pytest.raises(FrameError, match=r"is (truncated|damaged)"):
            read_colour(path)


def test_a_grey_corner_alone_is_no_damage(tmp_path: Path) -> None:
    image = picture()
    image[16:, 16:] = 128
    assert read_colour(save(tmp_path / "a.jpg", encoded(".jpg", image))).shape == image.shape


def test_what_follows_a_jpeg_is_left_alone(tmp_path: Path) -> None:
    """Some cameras append a film, or a second picture."""
    data = encoded(".jpg", picture())
    want = read_colour(save(tmp_path / "a.jpg", data))
    np.testing.assert_array_equal(
        read_colour(save(tmp_path / "b.jpg", data + bytes(9000) + data[:500])), want
    )


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(at=st.floats(0, 1), value=st.integers(0, 255), form=st.sampled_from([*FORMS, "progressive"]))
def test_a_changed_byte_never_breaks_the_checks(at: float, value: int, form: str) -> None:
    data = bytearray(encoded(".jpg", picture(), FORMS.get(form, PROGRESSIVE)))
    data[min(int(at * len(data)), len(data) - 1)] = value
    for check in (check_markers, decode_jpeg):
        try:
            check(bytes(data))
        except JpegError as error:
            assert "is truncated" in str(error) or "is damaged" in str(error)


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int, *, bits: int = 16, colour: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    data = chunk(b"PLTE", bytes(768)) if colour == 3 else b""
    data += chunk(b"IDAT", zlib.compress(bytes(1000)))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + data + chunk(b"IEND", b"")


def bmp(width: int, height: int) -> bytes:
    return struct.pack("<2sIHHIIiiHHIIiiII", b"BM", 100, 0, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)


def jpeg(width: int, height: int) -> bytes:
    data = bytearray(encoded(".jpg", picture()))
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    return bytes(data)


@pytest.mark.parametrize(
    "data",
    [
        png(40_000, 40_000),
        png(2**31 - 1, 1),
        png(0, 5),
        png(16_384, 16_384),
        bmp(30_000, 4),
        bmp(12_000, -12_000),
        bmp(-5, 5),
        jpeg(65_500, 65_500),
        jpeg(0, 10),
        b"P6 20000 20000 255\n",
        b"P6\n# a comment\n999999999\n1\n255\n",
    ],
)
def test_a_claimed_size_is_checked_before_anything_is_decoded(
    tmp_path: Path, data: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(FrameError, match="claims to be"):
        read_colour(save(tmp_path / "a.png", data))


@pytest.mark.parametrize("make", [png, bmp, jpeg, lambda w, h: f"P6 {w} {h} 255\n".encode()])
def test_another_size_is_found_before_decoding(tmp_path: Path, make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    with pytest.raises(FrameError, match="60x40, but 51x37 is needed"):
        read_depth(save(tmp_path / "a.png", make(60, 40)), scale=1000, size=(WIDTH, HEIGHT))


@pytest.mark.parametrize(
    "data", [b"GIF89a" + bytes(50), b"II*\x00" + bytes(50), b"P7\n", b"BM", b"\xff\xd8\xff"]
)
def test_kinds_without_a_known_header_are_refused(tmp_path: Path, data: bytes) -> None:
    with pytest.raises(FrameError, match="is not an image of a kind that is read"):
        read_colour(save(tmp_path / "a.png", data))


def test_errors_of_opencv_stay_inside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> None:
        raise cv2.error("out of memory")

    monkeypatch.setattr(cv2, "imdecode", fails)
    with pytest.raises(FrameError, match=r"a\.png: is not an image that OpenCV can read"):
        read_colour(save(tmp_path / "a.png", encoded(".png", picture())))


@pytest.mark.parametrize("bits", [0, 3, 16, 255])
def test_a_palette_of_strange_depth_is_refused(tmp_path: Path, bits: int) -> None:
    with pytest.raises(FrameError):
        read_mask(save(tmp_path / "a.png", png(5, 5, bits=bits, colour=3)))


FILES = {suffix: encoded(suffix, picture()) for suffix in (".jpg", ".png", ".bmp", ".ppm")} | {
    "depth.png": encoded(".png", picture()[..., 0].astype(np.uint16) * 200)
}


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(sorted(FILES)),
    edits=st.lists(st.tuples(st.integers(0, 60), st.integers(0, 255)), min_size=1, max_size=4),
    keep=st.none() | st.floats(0, 1),
)
def test_a_damaged_header_gives_an_image_or_a_frame_error(
    tmp_path: Path, kind: str, edits: list[tuple[int, int]], keep: float | None
) -> None:
    data = bytearray(FILES[kind])
    for at, value in edits:
        data[at] = value
    if kind.endswith(".png"):  # its checksum made good again, so that more than that is tried
        data[29:33] = struct.pack(">I", zlib.crc32(bytes(data[12:29])))
    path = save(tmp_path / "a.png", bytes(data) if keep is None else bytes(data[: int(keep * len(data))]))
    for read in (read_colour, read_mask, lambda p: read_depth(p, scale=1000.0)):
        try:
            read(path)
        except FrameError as error:
            assert str(path) in str(error) and "\n" not in str(error)
