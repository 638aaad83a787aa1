import pytest

from ladarreg_core.quality.assessment import assess
from ladarreg_core.surface.texture.registered_texture import texture_scan
from testing.scenes.small_registration import POSE, sample_photo, sample_registration, sample_scan


@pytest.fixture(scope="session")
def scan():
    return sample_scan()


@pytest.fixture(scope="session")
def photo():
    return sample_photo()


@pytest.fixture
def registration():
    return sample_registration()


@pytest.fixture(scope="session")
def texture(scan, photo):
    return texture_scan(scan, photo, POSE)


@pytest.fixture(scope="session")
def assessment(scan):
    return assess(scan, sample_registration())
