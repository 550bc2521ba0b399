"""Check of the track ids in everything that a process publishes."""

from __future__ import annotations

from collections.abc import Collection, Sequence


class TrackIds:
    """All ids that one process has published for its cameras; none may be used for two tracks."""

    def __init__(self) -> None:
        self.problems: list[str] = []
        self._cameras: dict[str, str] = {}
        self._first_stamps_ns: dict[str, int] = {}
        self._restarts_ns: dict[str, tuple[int, int]] = {}

    def __len__(self) -> int:
        return len(self._cameras)

    def take(self, camera: str, stamp_ns: int, ids: Sequence[str]) -> None:
        """Check the ids in the detections of one image of `camera`; "" means no id."""
        ids = [track_id for track_id in ids if track_id]
        if len(set(ids)) < len(ids):
            self.problems.append(f"an id twice in one image of {camera}: {ids}")
        begun_ns, done_ns = self._restarts_ns.get(camera, (0, 0))
        for track_id in ids:
            other = self._cameras.setdefault(track_id, camera)
            first_ns = self._first_stamps_ns.setdefault(track_id, stamp_ns)
            if other != camera:
                self.problems.append(f"track {track_id} of {other} used for {camera}")
            elif stamp_ns > done_ns and first_ns < begun_ns:
                self.problems.append(f"track {track_id} of {camera} from before its tracker restarted")

    def restart(self, cameras: Collection[str], begun_ns: int, done_ns: int) -> None:
        """The trackers of `cameras` were replaced at some time between these two."""
        self._restarts_ns |= dict.fromkeys(cameras, (begun_ns, done_ns))
