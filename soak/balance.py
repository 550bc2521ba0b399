"""Check of the frame balances of a process."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from support.detector_process import MAX_PENDING, is_balanced

from soak.finding import Finding, number_of


class BalanceWatch:
    """All frame balances reported by one process, in order."""

    def __init__(self) -> None:
        self.told = 0
        self.received = 0
        self.problems: list[str] = []
        """Balances that are wrong, and cameras whose counts have become smaller."""
        self._counts: dict[str, dict[str, int]] = {}

    def take(self, statuses: Mapping[str, Mapping[str, str]]) -> None:
        """Check the values in one message of diagnostics, by camera and of the node, whose name is ""."""
        self.told += 1
        state = statuses[""]["state"]
        self._counts = {
            camera: self._checked(camera, values, state)
            for camera, values in statuses.items()
            if "frames received" in values
        }

    def _checked(self, camera: str, values: Mapping[str, str], state: str) -> dict[str, int]:
        """The counts in `values`, which only grow."""
        before = self._counts.get(camera, {})
        counts = {name: int(value) for name, value in values.items() if name.startswith("frames ")}
        pending, received = counts.pop("frames pending"), counts["frames received"]
        for never_taken in ("frames lost", "frames overtaken"):  # only counted since activation
            counts.pop(never_taken, None)
        under_way = MAX_PENDING if state == "active" else 0
        if not is_balanced(values) or pending > under_way:
            self.problems.append(f"{camera} {state} {values}".lstrip())
        if any(count < before.get(name, 0) for name, count in counts.items()):
            self.problems.append(f"the counts of {camera!r} became smaller")
            before = {}
        self.received += received - before.get("frames received", 0)
        return counts


def exact_balance(watches: Sequence[BalanceWatch]) -> Finding:
    """Whether all balances of all processes follow the rules."""
    problems = [problem for watch in watches for problem in watch.problems]
    told, received = sum(watch.told for watch in watches), sum(watch.received for watch in watches)
    return Finding(
        claim="every frame is in exactly one count",
        done=f"{told} diagnostics of {len(watches)} processes, {received} frames",
        result=number_of("unbalanced", problems),
        limit=f"0; at most {MAX_PENDING} frames under way, none unless active",
        is_met=told > 0 and not problems,
    )
