"""Settings of the tracker."""

from __future__ import annotations

from dataclasses import dataclass

MAX_TIMEOUT_S = 60.0


@dataclass(frozen=True, kw_only=True)
class TrackerSettings:
    """What a user may choose; any of it may change between two frames without losing tracks.

    Raises ValueError on construction when a value is out of range.
    """

    track_high_threshold: float = 0.25
    """Minimum score, in [0, 1], of a detection that may begin a track and that is associated first."""
    track_low_threshold: float = 0.1
    """Minimum score, in [0, track_high_threshold], of a detection that may continue a track."""
    track_match_threshold: float = 0.2
    """Minimum IoU, in (0, 1], of a detection and the predicted box of its track, each with its margin."""
    track_timeout: float = 1.5
    """Seconds, in (0, MAX_TIMEOUT_S], for which a track is kept without a detection."""
    track_across_classes: bool = False
    """Whether a track may continue with a detection of another class."""

    def __post_init__(self) -> None:
        high, low = self.track_high_threshold, self.track_low_threshold
        if not 0 <= high <= 1:
            raise ValueError(f"track_high_threshold must be in [0, 1], found {high}.")
        if not 0 <= low <= high:
            raise ValueError(
                f"track_low_threshold must be from 0 to track_high_threshold ({high}), found {low}."
            )
        if not 0 < self.track_match_threshold <= 1:
            raise ValueError(f"track_match_threshold must be in (0, 1], found {self.track_match_threshold}.")
        if not 0 < self.track_timeout <= MAX_TIMEOUT_S:
            raise ValueError(
                f"track_timeout must be above 0 and at most {MAX_TIMEOUT_S:g} seconds, "
                f"found {self.track_timeout}."
            )
