"""Topics and messages in the files of rosbag2 recordings, MCAP and SQLite, in the order of the file.

MCAP, with or without indexes (https://mcap.dev/spec), is read here, because libraries unpack a chunk of any
size: 33 kB may become gigabytes.
"""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from struct import Struct
from typing import Any, BinaryIO
from zlib import crc32

import apsw  # unlike sqlite3, limits the size of values in Python 3.10, too
import lz4.frame  # type: ignore[import-untyped]
from backports import zstd

from yolov5_lifecycle.printable import in_one_line

CDR = "cdr"
"""The encoding of ROS 2."""
MAX_MESSAGE_BYTES = 256 << 20
"""Of a message that is read: an RGB image of 89 megapixels."""
MAX_CHUNK_BYTES = 2 * MAX_MESSAGE_BYTES
"""Of a chunk of messages, packed or not; writers begin another one after a megabyte or a message."""
MAX_TOPICS = 10_000
MAX_NAME_BYTES = 4096
MESSAGES_OF_ANY_FILE = 100_000
BYTES_PER_MESSAGE = 4
"""Of a longer file, for each message beyond MESSAGES_OF_ANY_FILE: even packed ones need as many."""
_MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = range(1, 7)
_STATISTICS, _DATA_END = 0x0B, 0x0F
_FOOTER_BYTES = 9 + 20 + len(_MAGIC)

_U16, _U32, _U64 = Struct("<H"), Struct("<I"), Struct("<Q")
_RECORD = Struct("<BQ")  # opcode, bytes
_CHANNEL_START = Struct("<HH")  # id, id of its schema
_MESSAGE_START = Struct("<HIQQ")  # channel, number, time of recording, time of publication
_CHUNK_START = Struct("<QQQI")  # first and last time, unpacked bytes, their CRC-32 or 0
_STATISTICS_START = Struct("<QHIIIIQQ")  # messages, schemas, channels, then others that are not used
_COUNT = Struct("<HQ")  # channel, messages
_TOPICS = f"SELECT id, name, type, serialization_format FROM topics LIMIT {MAX_TOPICS + 1}"
_COUNTS = f"""
    SELECT topic_id, count(*) FROM messages
    WHERE topic_id IN (SELECT id FROM topics LIMIT {MAX_TOPICS}) GROUP BY topic_id"""
_MESSAGES = """
    SELECT timestamp, length(data), CASE WHEN length(data) <= ? THEN data END FROM messages
    WHERE topic_id IN (SELECT id FROM topics WHERE name = ? AND type = ?) ORDER BY rowid"""


class StorageError(ValueError):
    """A file of a recording that is not read; the message says what it has, and what to do.

    Other errors, such as ValueError, stand for a file that is damaged and may be repaired.
    """


@dataclass(frozen=True)
class StoredTopic:
    """A topic in one file, where several may have one name, or of a whole recording."""

    name: str
    type_name: str
    encoding: str
    count: int = 0
    """Messages on it, as the recording claims; a damaged one may have fewer."""


class McapFile:
    """An open file, until `stack` closes it. Raises StorageError and OSError, also later."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self._file = stack.enter_context(path.open("rb"))
        self._size = path.stat().st_size
        self._data_start, self._data_end = self._bounds()
        self._channels: dict[int, StoredTopic] = {}
        self._schemas: dict[int, str] = {}
        self._counts = self._summary_counts() or self._counted()

    @property
    def topics(self) -> list[StoredTopic]:
        """A topic for each channel, with as many messages as the statistics claim, or are counted."""
        return [replace(topic, count=self._counts[number]) for number, topic in self._channels.items()]

    def messages(self, name: str, type_name: str) -> Iterator[tuple[int, bytes | None]]:
        """Time of recording in nanoseconds and content, None if larger than MAX_MESSAGE_BYTES."""
        for channel, time_ns, file, size in self._messages():
            topic = self._channels.get(channel)
            if topic is not None and (topic.name, topic.type_name) == (name, type_name):
                yield time_ns, _taken(file, size) if size <= MAX_MESSAGE_BYTES else None

    def _bounds(self) -> tuple[int, int]:
        """Where records begin, and where the footer does; raises StorageError for another format."""
        if self._file.read(len(_MAGIC)) != _MAGIC:
            raise StorageError("it does not begin like an MCAP file")
        opcode, size = _fields(self._file, _RECORD)
        start = self._file.tell()
        if opcode != _HEADER:
            raise ValueError("expected the header of an MCAP file")
        if _text(self._file) == "ros1":
            raise StorageError(
                "its messages are those of ROS 1, which are not read. Convert the .bag that it was made "
                "from: rosbags-convert --src FILE.bag --dst FOLDER"
            )
        end = self._size - _FOOTER_BYTES
        self._file.seek(max(end, 0))
        if end < start + size or not self._file.read().endswith(_MAGIC):
            raise ValueError("its end is missing")
        return start + size, end

    def _summary_counts(self) -> Counter[int] | None:
        """Counts of the summary at the end; None unless it has statistics, and what these say.

        Writers may leave out of it schemas, channels or counts.
        """
        self._file.seek(self._data_end + _RECORD.size)
        (start,) = _fields(self._file, _U64)
        if not self._data_start <= start < self._data_end:
            return None
        self._file.seek(start)
        claimed: tuple[int, int, int] | None = None
        counts = Counter[int]()
        for opcode, _ in _records(self._file, self._data_end):
            if opcode == _STATISTICS:
                claimed, counts = _statistics(self._file)
            else:
                self._describe(opcode, self._file)
        found = counts.total(), len(self._schemas), len(self._channels)
        return counts if found == claimed else None

    def _counted(self) -> Counter[int]:
        """Counts of all messages, which are read for that, as are the channels."""
        self._schemas.clear()
        self._channels.clear()
        return Counter(channel for channel, *_ in self._messages())

    def _messages(self) -> Iterator[tuple[int, int, BinaryIO, int]]:
        """Channel and time of each message, a file that is at its content, and the size of that."""
        left = MESSAGES_OF_ANY_FILE + self._size // BYTES_PER_MESSAGE
        for opcode, file, size in self._data():
            if opcode != _MESSAGE:
                self._describe(opcode, file)
                continue
            if not (left := left - 1):
                raise StorageError("it unpacks to more messages than a recording of its size has")
            channel, _, time_ns, _ = _fields(file, _MESSAGE_START)
            yield channel, time_ns, file, size - _MESSAGE_START.size

    def _data(self) -> Iterator[tuple[int, BinaryIO, int]]:
        """Opcode of each record, also of those in chunks, a file that is at its content, and the size."""
        self._file.seek(self._data_start)
        for opcode, size in _records(self._file, self._data_end):
            if opcode == _DATA_END:
                return
            if opcode != _CHUNK:
                yield opcode, self._file, size
                continue
            chunk, end = _unpacked(self._file)
            for inner, inner_size in _records(chunk, end):
                if inner == _CHUNK:
                    raise ValueError("a chunk within a chunk")
                yield inner, chunk, inner_size

    def _describe(self, opcode: int, file: BinaryIO) -> None:
        """Keep a schema or channel, of which each may occur many times."""
        if opcode == _SCHEMA:
            (number,) = _fields(file, _U16)
            self._schemas.setdefault(number, _text(file))
        elif opcode == _CHANNEL:
            number, schema = _fields(file, _CHANNEL_START)
            name, encoding = _text(file), _text(file)
            self._channels.setdefault(number, StoredTopic(name, self._schemas.get(schema, ""), encoding))
        if max(len(self._schemas), len(self._channels)) > MAX_TOPICS:
            raise StorageError(f"more than {MAX_TOPICS} channels")


def _records(file: BinaryIO, end: int) -> Iterator[tuple[int, int]]:
    """Opcode and size of each record up to the position `end` of `file`, which is then at its content."""
    while file.tell() < end:
        opcode, size = _fields(file, _RECORD)
        left = end - file.tell()
        if size > left:
            raise ValueError(f"a record of {size} bytes where {left} are left")
        next_record = file.tell() + size
        yield opcode, size
        if file.tell() > next_record:
            raise ValueError("a record is shorter than its fields")
        file.seek(next_record)


def _taken(file: BinaryIO, size: int) -> bytes:
    data = file.read(max(size, 0))
    if len(data) != size:
        raise ValueError(f"a record ends after {len(data)} of {size} bytes")
    return data


def _fields(file: BinaryIO, layout: Struct) -> tuple[int, ...]:
    return layout.unpack(_taken(file, layout.size))


def _text(file: BinaryIO) -> str:
    (size,) = _fields(file, _U32)
    if size > MAX_NAME_BYTES:
        raise StorageError(f"a name of {size} bytes, expected at most {MAX_NAME_BYTES}")
    return _taken(file, size).decode("utf-8", "replace")


def _statistics(file: BinaryIO) -> tuple[tuple[int, int, int], Counter[int]]:
    """Claimed number of messages, of schemas, of channels; and of the messages of each channel."""
    messages, schemas, channels, *_ = _fields(file, _STATISTICS_START)
    (size,) = _fields(file, _U32)
    if size > _COUNT.size * MAX_TOPICS:
        raise StorageError(f"statistics of more than {MAX_TOPICS} channels")
    return (messages, schemas, channels), Counter(dict(_COUNT.iter_unpack(_taken(file, size))))


def _unpacked(file: BinaryIO) -> tuple[BinaryIO, int]:
    """The records of the chunk at which `file` is, and their size in bytes."""
    _, _, size, crc = _fields(file, _CHUNK_START)
    compression = _text(file)
    (packed_size,) = _fields(file, _U64)
    if max(size, packed_size) > MAX_CHUNK_BYTES:
        raise StorageError(
            f"a chunk of {max(size, packed_size)} bytes, expected at most {MAX_CHUNK_BYTES >> 20} MiB"
        )
    if compression not in _UNPACKING:
        raise StorageError(f"a chunk is packed as {in_one_line(compression)!r}, expected zstd or lz4")
    with _UNPACKING[compression](io.BytesIO(_taken(file, packed_size))) as packed:
        content = packed.read(size + 1)
    if len(content) != size:
        raise ValueError(
            f"a chunk unpacks to {'more' if len(content) > size else 'fewer'} bytes than it claims"
        )
    if crc and crc32(content) != crc:
        raise ValueError("a chunk is damaged: its checksum is wrong")
    return io.BytesIO(content), size


_UNPACKING: Mapping[str, Callable[[BinaryIO], Any]] = {
    "": lambda packed: packed,
    "lz4": lz4.frame.LZ4FrameFile,
    "zstd": zstd.ZstdFile,
}


class SqliteFile:
    """An open file, until `stack` closes it. Raises StorageError and APSW's errors, also later."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        # As a URI, in which the characters # ? % of a path mean themselves: https://sqlite.org/uri.html
        self._database = apsw.Connection(f"{path.absolute().as_uri()}?immutable=1", flags=flags)
        stack.callback(self._database.close)
        _restrict(self._database)
        counts = dict(self._database.execute(_COUNTS))
        rows = self._database.execute(_TOPICS).fetchall()
        if len(rows) > MAX_TOPICS:
            raise StorageError(f"more than {MAX_TOPICS} topics")
        self.topics = [
            StoredTopic(name, type_name, str(encoding), counts.get(number, 0))
            for number, name, type_name, encoding in rows
            if isinstance(name, str) and isinstance(type_name, str)
        ]

    def messages(self, name: str, type_name: str) -> Iterator[tuple[int, bytes | None]]:
        """Time of recording in nanoseconds and content, None if larger than MAX_MESSAGE_BYTES."""
        rows = self._database.execute(_MESSAGES, (MAX_MESSAGE_BYTES, name, type_name))
        for timestamp_ns, size, data in rows:
            is_large = data is None and isinstance(size, int) and size > MAX_MESSAGE_BYTES
            if not isinstance(timestamp_ns, int) or not (is_large or isinstance(data, bytes)):
                raise StorageError("expected a time and bytes for each message")
            yield timestamp_ns, data


def _restrict(database: Any) -> None:
    """Raise StorageError for anything but tables: views could run forever or return any size."""
    database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
    columns = "SELECT 1 FROM sqlite_master, pragma_table_xinfo(sqlite_master.name) WHERE hidden > 1"
    unusual = "SELECT 1 FROM sqlite_master WHERE type NOT IN ('table', 'index') OR sql LIKE 'CREATE VIRTUAL%'"
    for query in (unusual, columns):
        if database.execute(query).fetchone():
            raise StorageError(
                "the database has views, triggers or computed columns; a recording has only tables"
            )
