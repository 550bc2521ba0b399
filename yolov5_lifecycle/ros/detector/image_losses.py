"""Counters of images that were sent but never taken."""

from __future__ import annotations


class ImageLosses:
    """Counts images that publishers sent and this node never took.

    `lost`: reported by the middleware (the event `message_lost`), which counts per publisher; correct for
    any number of publishers.

    `overtaken`: sent and not lost, but replaced by a newer image before it was taken, or sent while the node
    resubscribed. Computed as the gaps in the publisher's sequence numbers minus `lost`. rclpy does not expose
    which publisher sent a message, so gaps count only between messages that arrived while the same single
    publisher was matched. Only `settle` updates `overtaken`.
    """

    def __init__(self) -> None:
        self.lost = 0
        self.overtaken = 0
        self._before_run = 0
        self._publisher: bytes | None = None
        self._is_counting = False
        self._begun_ns = 0
        self._last_number: int | None = None
        self._gaps = 0
        self._lost_before = 0

    def subscribe(self) -> None:
        """Handle a (re)subscription; images that the same publisher sent in between count as missed."""
        if self._publisher is None:
            self._restart(None, 0)
            self._is_counting = True

    def take(self, number: int | None, received_ns: int) -> None:
        """Record a taken message: sequence number, None if the middleware has none, and arrival time."""
        if number is None or not self._is_counting or received_ns < self._begun_ns:
            return
        if self._last_number is None:
            self._lost_before = self.lost
        elif number > self._last_number:
            self._gaps += number - self._last_number - 1
        self._last_number = number

    def lose(self, count: int) -> None:
        """Add `count` messages that the middleware lost, from any publisher."""
        self.lost += count

    def match(self, publisher: bytes | None, *, ever_matched: int, has_joined: bool, now_ns: int) -> None:
        """Handle a change of the matched publishers.

        `publisher`: gid of the only publisher, None unless there is exactly one. `ever_matched`: total number
        of publishers matched so far. `has_joined`: whether a publisher was added since the last call.
        """
        if ever_matched == 1 and publisher is not None and self._publisher in (None, publisher):
            self._publisher = publisher
            return
        if not has_joined:
            self.settle()
        # Else a message of the new publisher may already have been taken: drop the unsettled gaps.
        self._restart(publisher, now_ns)

    def stop(self) -> None:
        """Handle an unsubscription; images sent from now on do not count."""
        self.settle()
        self._restart(None, 0)

    def settle(self) -> None:
        """Add the gaps seen so far to `overtaken`.

        The middleware may report a loss after its gap was added: then `overtaken` falls by as many as `lost`
        has grown, so that no image is counted twice.
        """
        run = max(0, self._gaps - (self.lost - self._lost_before)) if self._gaps else 0
        self.overtaken = self._before_run + run

    def _restart(self, publisher: bytes | None, now_ns: int) -> None:
        self._before_run = self.overtaken
        self._publisher = publisher
        self._is_counting = publisher is not None
        self._begun_ns = now_ns
        self._last_number = None
        self._gaps = 0
        self._lost_before = self.lost
