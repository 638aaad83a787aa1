"""How fast somebody may try tokens."""

from __future__ import annotations

import ipaddress
import time
from collections import OrderedDict, deque
from collections.abc import Callable

_MOST_ADDRESSES = 4096
_PACE_S = 3.0
_LONGEST_WAIT_S = 30.0


class Attempts:
    """Counts wrong tokens by address, forgets them after a while, and spaces further tries of an address out.

    Args:
        most: wrong tokens that an address may show within `window_s` before it has to wait.
        window_s: how long a wrong token counts, s.
        clock: monotonic time, s.
    """

    def __init__(self, *, most: int = 10, window_s: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        self._most, self._window_s, self._clock = most, window_s, clock
        self._wrong: OrderedDict[str, deque[float]] = OrderedDict()
        self._next: dict[str, float] = {}

    def turn_s(self, address: str, kind: str = "") -> float | None:
        """Give an address its turn to have a token compared.

        Args:
            address: of the browser.
            kind: of the way the token came by; each is counted by itself.

        Returns:
            How long to wait before, s: 0 while few were wrong; None where so many wait that this one is turned away.
        """
        household = _household(address, kind)
        now = self._clock()
        if len(self._recent(household)) < self._most:
            return 0.0
        turn = max(now, self._next.get(household, now))
        if turn - now > _LONGEST_WAIT_S:
            return None
        self._next[household] = turn + _PACE_S
        return turn - now

    def wrong(self, address: str, kind: str = "") -> None:
        """Note that an address showed a wrong token."""
        household = _household(address, kind)
        times = self._recent(household)
        times.append(self._clock())
        self._wrong[household] = times
        self._wrong.move_to_end(household)
        while len(self._wrong) > _MOST_ADDRESSES:
            self._next.pop(self._wrong.popitem(last=False)[0], None)

    def _recent(self, household: str) -> deque[float]:
        times = self._wrong.get(household, deque(maxlen=self._most))
        while times and times[0] <= self._clock() - self._window_s:
            times.popleft()
        return times


def _household(address: str, kind: str) -> str:
    """Return what one person may have many of, the network of an IPv6 address, with the kind of try."""
    try:
        parsed = ipaddress.ip_address(address.partition("%")[0])
    except ValueError:
        return f"{kind} {address}"
    if parsed.version == 6:
        mapped = parsed.ipv4_mapped
        return f"{kind} {mapped or ipaddress.ip_network((parsed, 64), strict=False)}"
    return f"{kind} {address}"
