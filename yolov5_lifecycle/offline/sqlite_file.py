"""Messages in a SQLite file of rosbag2, in the order in which they were written."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import apsw  # unlike sqlite3, limits the size of values in Python 3.10, too

from yolov5_lifecycle.offline.stored_topics import MAX_MESSAGE_BYTES, StorageError, StoredTopic

MAX_TOPICS = 10_000
_FUNCTIONS = {"count", "length"}
_TOPICS = f"SELECT id, name, type, serialization_format FROM topics LIMIT {MAX_TOPICS + 1}"
_COUNTS = f"""
    SELECT topic_id, count(*) FROM messages
    WHERE topic_id IN (SELECT id FROM topics LIMIT {MAX_TOPICS}) GROUP BY topic_id"""
_MESSAGES = """
    SELECT timestamp, length(data), CASE WHEN length(data) <= ? THEN data END FROM messages
    WHERE topic_id IN (SELECT id FROM topics WHERE name = ? AND type = ?) ORDER BY rowid"""


class SqliteFile:
    """An open file; owns its connection until `close`. Raises StorageError and APSW's errors, also later."""

    def __init__(self, path: Path) -> None:
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        # As a URI, in which the characters # ? % of a path mean themselves: https://sqlite.org/uri.html
        self._database = apsw.Connection(f"{path.absolute().as_uri()}?immutable=1", flags=flags)
        try:
            _restrict(self._database)
            counts = dict(self._database.execute(_COUNTS))
            rows = self._database.execute(_TOPICS).fetchall()
        except BaseException:
            self.close()
            raise
        if len(rows) > MAX_TOPICS:
            raise StorageError(f"more than {MAX_TOPICS} topics")
        self.topics = [
            StoredTopic(name, type_name, str(encoding), counts.get(number, 0))
            for number, name, type_name, encoding in rows
            if isinstance(name, str) and isinstance(type_name, str)
        ]

    def close(self) -> None:
        self._database.close()

    def messages(self, name: str, type_name: str) -> Iterator[tuple[int, bytes | None]]:
        """Time of recording in nanoseconds and content, None if larger than MAX_MESSAGE_BYTES."""
        rows = self._database.execute(_MESSAGES, (MAX_MESSAGE_BYTES, name, type_name))
        for timestamp_ns, size, data in rows:
            is_large = data is None and isinstance(size, int) and size > MAX_MESSAGE_BYTES
            if not isinstance(timestamp_ns, int) or not (is_large or isinstance(data, bytes)):
                raise StorageError("expected a time and bytes for each message")
            yield timestamp_ns, data


def _restrict(database: Any) -> None:
    """Only tables, and only what the queries need of SQL: views could run forever or return any size."""
    database.limit(apsw.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
    columns = "SELECT 1 FROM sqlite_master, pragma_table_xinfo(sqlite_master.name) WHERE hidden > 1"
    unusual = "SELECT 1 FROM sqlite_master WHERE type IN ('view', 'trigger') OR sql LIKE 'CREATE VIRTUAL%'"
    for query in (unusual, columns):
        if database.execute(query).fetchone():
            raise StorageError(
                "the database has views, triggers or computed columns; a recording has only tables"
            )
    database.authorizer = _authorized


def _authorized(action: int, _: str | None, name: str | None, __: str | None, view: str | None) -> int:
    is_foreign_function = action == apsw.SQLITE_FUNCTION and (name or "").lower() not in _FUNCTIONS
    if view is not None or is_foreign_function or action == apsw.SQLITE_RECURSIVE:
        return int(apsw.SQLITE_DENY)
    return int(apsw.SQLITE_OK)
