"""Small scans, and the builders of their files."""

from __future__ import annotations

from typing import Any

import pytest

from ladarreg_core.scan import Scan
from testing.files.small_scans import (
    depth_image,
    e57_fields,
    e57_file,
    lzf_compress,
    make_scan,
    pcd_bytes,
    spinning_cloud,
)


@pytest.fixture(scope="session")
def wall() -> Scan:
    return make_scan()


@pytest.fixture(scope="session")
def make() -> Any:
    """The builders above, for tests that cannot import this file by name."""

    class Builders:
        scan = staticmethod(make_scan)
        pcd = staticmethod(pcd_bytes)
        lzf = staticmethod(lzf_compress)
        e57 = staticmethod(e57_file)
        e57_fields = staticmethod(e57_fields)
        spinning = staticmethod(spinning_cloud)
        depth_image = staticmethod(depth_image)

    return Builders
