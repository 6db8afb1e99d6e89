"""Progress of a long loop in a job's log: how much is done, how fast, and the time left."""

import sys
import threading
import time
from collections.abc import Iterable, Iterator
from typing import TypeVar

EVERY_S = 5.0  # at most one line in so many seconds, and one at the end

Item = TypeVar("Item")


class Pace:
    """Lines such as `mask: 12/400 frames, 3.1 frames/s, 2.1 min left` on stderr.

    Steps may come from several threads.
    """

    def __init__(self, what: str, *, total: int, unit: str) -> None:
        """Start the clock of `total` steps; a line begins with `what` and counts in `unit`."""
        self._what, self._total, self._unit = what, total, unit
        self._done = 0
        self._started_s = self._told_s = time.monotonic()
        self._lock = threading.Lock()

    def step(self) -> None:
        """One more is done."""
        with self._lock:
            self._done += 1
            now_s = time.monotonic()
            if now_s - self._told_s < EVERY_S and self._done < self._total:
                return
            self._told_s = now_s
            rate = self._done / max(now_s - self._started_s, 1e-9)
            left_s = max(self._total - self._done, 0) / rate
            sys.stderr.write(
                f"{self._what}: {self._done}/{self._total} {self._unit}, "
                f"{rate:.{1 if rate >= 1 else 3}f} {self._unit}/s, {duration(left_s)} left\n"
            )
            sys.stderr.flush()


def paced(items: Iterable[Item], *, what: str, total: int, unit: str) -> Iterator[Item]:
    """The items, with a step of a `Pace` behind each."""
    pace = Pace(what, total=total, unit=unit)
    for item in items:
        yield item
        pace.step()


def duration(seconds: float) -> str:
    """Seconds for people."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5940 else f"{seconds / 3600:.1f} h"
