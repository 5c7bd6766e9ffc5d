# SPDX-License-Identifier: Apache-2.0
"""Messages of a ROS 1 bag, a ROS 2 bag's folder or an MCAP file, by topic and time (rosbags, mcap)."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple, TypeVar

from ggwarp.datasets.base import DatasetError, FrameError
from ggwarp.io import guarded
from ggwarp.io.printable import printable

T = TypeVar("T")

_HEADER = struct.Struct("<ii")
_HEADER_AT = 4
"""Where a message's header has its time: behind ROS 1's count, or ROS 2's mark of the encoding."""
_LEAST_STAMP = 1.0
"""Seconds; a header of less was never filled."""


class Stamp(NamedTuple):
    """When a message was recorded, nanoseconds, and when it was made by its header, seconds."""

    recorded: int
    made: float


class Bag:
    """A bag that is open; several threads may read it.

    Attributes:
        path: the file, or ROS 2's folder.
        types: topic -> type of its messages, such as ``sensor_msgs/msg/Image``.
        counts: topic -> number of messages.
    """

    path: Path
    types: dict[str, str]
    counts: dict[str, int]

    def __init__(self) -> None:
        self._lock = Lock()

    def raw(self, topic: str, start: int | None = None) -> Iterator[tuple[int, bytes]]:
        """Yield (time in nanoseconds, bytes) of a topic's messages from ``start`` on."""
        raise NotImplementedError

    def parsed(self, topic: str, data: bytes) -> Any:
        """Return the message in ``data``."""
        raise NotImplementedError

    def stamps(self, topic: str) -> list[Stamp]:
        """Return the times of a topic's messages, in the order that they were recorded; reads them all.

        Raises:
            DatasetError: the bag is damaged.
        """

        def read() -> list[Stamp]:
            found = []
            for recorded, data in self.raw(topic):
                made = 0.0
                if len(data) >= _HEADER_AT + _HEADER.size:
                    seconds, nanoseconds = _HEADER.unpack_from(data, _HEADER_AT)
                    made = seconds + nanoseconds * 1e-9
                found.append(Stamp(recorded, made if made > _LEAST_STAMP else recorded * 1e-9))
            return found

        return self._tried(read, DatasetError)

    def message(self, topic: str, recorded: int) -> Any:
        """Return a topic's message of the time ``recorded``.

        Raises:
            FrameError: it cannot be read.
        """

        def read() -> Any:
            for at, data in self.raw(topic, recorded):
                if at != recorded:
                    break
                return self.parsed(topic, data)
            raise FrameError(f"{self.path}: {printable(topic)} has no message of its time; copy it again")

        return self._tried(read, FrameError)

    def first(self, topic: str) -> Any:
        """Return a topic's first message.

        Raises:
            DatasetError: it cannot be read.
        """

        def read() -> Any:
            for _, data in self.raw(topic):
                return self.parsed(topic, data)
            raise DatasetError(f"{self.path}: {printable(topic)} has no message")

        return self._tried(read, DatasetError)

    def all(self, topic: str) -> list[tuple[int, Any]]:
        """Return a topic's messages, of which there are few, with their times in nanoseconds."""
        return self._tried(
            lambda: [(at, self.parsed(topic, data)) for at, data in self.raw(topic)], DatasetError
        )

    def _tried(self, read: Callable[[], T], kind: type[DatasetError]) -> T:
        """Return what ``read`` does, whose errors for damaged bytes are of dozens of types."""
        try:
            with self._lock:
                return read()
        except (DatasetError, MemoryError):
            raise
        except Exception as error:
            raise kind(f"{self.path}: is damaged ({_reason(error)}); copy it again") from None


def _reason(error: Exception) -> str:
    return printable(str(error).splitlines()[0])[:120] if str(error) else type(error).__name__


def open_bag(path: Path) -> Bag:
    """Open a ``.bag``, ``.mcap`` or ``.db3`` file, or the folder of a ROS 2 bag.

    Raises:
        DatasetError: the library is not installed, or the bag is damaged.
    """
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError:
        raise DatasetError(f"{path}: needs the ROS extra; pip install 'ggwarp[ros]'") from None
    try:  # the libraries would wait for a pipe, and read a device without end
        for file in sorted(path.iterdir()) if path.is_dir() else [path]:
            guarded.check_file(file, guarded.VIDEO)
    except guarded.FileError as error:
        raise DatasetError(str(error)) from error
    try:
        return {".mcap": _Mcap, ".db3": _Sqlite}.get(path.suffix.lower(), _RosBag)(path)
    except (DatasetError, MemoryError):
        raise
    except Exception as error:
        raise DatasetError(f"{path}: is no bag that can be read ({_reason(error)}); copy it again") from None


class _RosBag(Bag):
    def __init__(self, path: Path) -> None:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        super().__init__()
        self.path = path
        store = get_typestore(Stores.ROS2_HUMBLE) if path.is_dir() else None
        self._reader = AnyReader([path], default_typestore=store)
        self._reader.open()
        self._connections = {c.topic: [] for c in self._reader.connections}
        for connection in self._reader.connections:
            self._connections[connection.topic].append(connection)
        self.types = {c.topic: c.msgtype for c in self._reader.connections}
        self.counts = {t: sum(c.msgcount for c in found) for t, found in self._connections.items()}

    def raw(self, topic: str, start: int | None = None) -> Iterator[tuple[int, bytes]]:
        for _, at, data in self._reader.messages(self._connections[topic], start=start):
            yield at, bytes(data)

    def parsed(self, topic: str, data: bytes) -> Any:
        return self._reader.deserialize(data, self.types[topic])


class _Sqlite(Bag):
    """A single ``.db3`` file of a ROS 2 bag, as RealSense's recorder writes since librealsense 2.58."""

    def __init__(self, path: Path) -> None:
        from rosbags.typesys import Stores, get_typestore

        super().__init__()
        self.path = path
        self._base = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, check_same_thread=False)
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        rows = self._base.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        rows = [row for row in rows if row[3] == "cdr" and row[2] in self._store.fielddefs]
        self._numbers: dict[str, int] = {name: number for number, name, _, _ in rows}
        self.types = {name: kind for _, name, kind, _ in rows}
        counts = self._base.execute("SELECT topic_id, COUNT(*) FROM messages GROUP BY topic_id").fetchall()
        self.counts = {name: dict(counts).get(number, 0) for name, number in self._numbers.items()}

    def raw(self, topic: str, start: int | None = None) -> Iterator[tuple[int, bytes]]:
        query = "SELECT timestamp, data FROM messages WHERE topic_id = ? AND timestamp >= ?"
        yield from self._base.execute(f"{query} ORDER BY timestamp, id", (self._numbers[topic], start or 0))

    def parsed(self, topic: str, data: bytes) -> Any:
        return self._store.deserialize_cdr(data, self.types[topic])


class _Mcap(Bag):
    """A single MCAP file of ROS messages; a ROS 2 bag's folder is no such."""

    def __init__(self, path: Path) -> None:
        from mcap.reader import make_reader
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        super().__init__()
        self.path = path
        self._file = path.open("rb")
        self._reader = make_reader(self._file)
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise DatasetError(f"{path}: has no summary: it was not closed; mend it with 'mcap recover'")
        self._store = get_typestore(Stores.EMPTY)
        self._is_ros1: dict[str, bool] = {}
        self.types, self.counts = {}, {}
        definitions: dict[str, Any] = {}
        for number, channel in summary.channels.items():
            schema = summary.schemas.get(channel.schema_id)
            if schema is None or schema.encoding not in ("ros1msg", "ros2msg"):
                continue
            name = schema.name if "/msg/" in schema.name else schema.name.replace("/", "/msg/", 1)
            definitions |= get_types_from_msg(schema.data.decode("utf-8", "replace"), name)
            self.types[channel.topic] = name
            self.counts[channel.topic] = summary.statistics.channel_message_counts.get(number, 0)
            self._is_ros1[channel.topic] = channel.message_encoding == "ros1"
        self._store.register(definitions)

    def raw(self, topic: str, start: int | None = None) -> Iterator[tuple[int, bytes]]:
        for _, _, message in self._reader.iter_messages(topics=[topic], starting_at=start):
            yield message.log_time, message.data

    def parsed(self, topic: str, data: bytes) -> Any:
        store, name = self._store, self.types[topic]
        return (store.deserialize_ros1 if self._is_ros1[topic] else store.deserialize_cdr)(data, name)
