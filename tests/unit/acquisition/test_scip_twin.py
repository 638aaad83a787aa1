"""The simulated line scanner: commands that the driver does not send, by the bytes of the specification."""

from __future__ import annotations

import numpy as np
import pytest

from ladarreg_core.acquisition.devices.scip_protocol import (
    checksum,
    decoded,
)
from ladarreg_core.acquisition.simulated.scip_twin import URG_04LX, ScipTwin
from testing.devices.wall import wall


class TestTwin:
    """Commands that the driver does not send, by the bytes of the specification."""

    @staticmethod
    def answers(twin: ScipTwin, sent: bytes, *, at_s: float, for_s: float = 0.3) -> list[bytes]:
        twin.feed(sent, at_s)
        came = b"".join(twin.due(at_s + t) for t in np.arange(0, for_s, 0.004))
        return came.split(b"\n\n")[:-1]

    def test_distances_of_two_characters(self) -> None:
        twin = ScipTwin(wall, model=URG_04LX)
        assert len(self.answers(twin, b"BM\n", at_s=0.5)) == 1
        (reply,) = self.answers(twin, b"GS0380038801\n", at_s=1.0)
        echo, status, _, data = reply.split(b"\n")
        assert (echo, status) == (b"GS0380038801", b"00P")
        assert checksum(data[:-1]) == data[-1]
        assert decoded(data[:-1], 2).tolist() == pytest.approx([2000] * 9, abs=2)
        acknowledged, first, last = self.answers(twin, b"MS0384038401002\n", at_s=2.0, for_s=0.5)
        assert acknowledged.endswith(b"\n00P")
        assert [each[:17] for each in (first, last)] == [b"MS0384038401001\n9", b"MS0384038401000\n9"]
        assert not twin.laser_on
        assert self.answers(twin, b"GE0384038401\n", at_s=3.0)[0].split(b"\n")[1][:2] == b"0E"

    def test_a_reset_sets_its_clock_to_zero(self) -> None:
        twin = ScipTwin(wall, seed=5)
        assert twin.clock_ms(10.0) > 20
        assert self.answers(twin, b"TM1\n", at_s=9.0)[0].split(b"\n")[1] == b"04" + bytes([checksum(b"04")])
        twin.feed(b"TM0\n", 9.5)
        twin.feed(b"BM\nRS\n", 10.0)
        assert not twin.laser_on
        assert twin.clock_ms(10.005) <= 10
        assert self.answers(twin, b"TM1\n", at_s=11.0)[-1].split(b"\n")[1][:2] == b"04"

    def test_a_request_without_a_number_does_not_end(self) -> None:
        twin = ScipTwin(wall)
        replies = self.answers(twin, b"MD0540054001000\n", at_s=1.0, for_s=3.0)
        assert len(replies) > 100
        assert twin.asked_without_end
        twin.feed(b"QT\n", 4.1)
        assert not twin.laser_on
