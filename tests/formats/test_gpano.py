"""Panoramas by their XMP, and pictures that look like one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ladarreg_core.camera import EquirectangularCamera
from ladarreg_core.errors import CameraError, OptionError
from ladarreg_core.formats import describe, read_photo
from ladarreg_core.formats.photos.gpano import looks_like_panorama, panorama_of_xmp
from ladarreg_core.formats.photos.image_file import read_image
from ladarreg_core.foundations.arrays import ByteArray

FIELDS = {
    "ProjectionType": "equirectangular",
    "FullPanoWidthPixels": "8000",
    "FullPanoHeightPixels": "4000",
    "CroppedAreaImageWidthPixels": "4000",
    "CroppedAreaImageHeightPixels": "1000",
    "CroppedAreaLeftPixels": "1000",
    "CroppedAreaTopPixels": "1500",
}
WINDOW = (-135.0, 22.5, 45.0, -22.5)  # 45 degrees are 1000 of 8000 and of 4000 pixels


def as_attributes(fields: dict[str, str], prefix: str = "GPano") -> bytes:
    """Return a packet as written by phones: one attribute a field."""
    inside = " ".join(f'{prefix}:{name}="{value}"' for name, value in fields.items())
    return (
        '<?xpacket begin="" id="W5M0MpCehiHzreSzNTczkc9d"?><x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF '
        'xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about="" '
        f'xmlns:{prefix}="http://ns.google.com/photos/1.0/panorama/" {inside}/></rdf:RDF></x:xmpmeta>'
        '<?xpacket end="w"?>'
    ).encode()


def as_elements(fields: dict[str, str]) -> bytes:
    """Return a packet as written by stitching programs: one element a field."""
    inside = "\n".join(f"<GPano:{name}>{value}</GPano:{name}>" for name, value in fields.items())
    return (
        '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
        "<rdf:Description rdf:about='' xmlns:GPano='http://ns.google.com/photos/1.0/panorama/'>\n"
        f"{inside}\n</rdf:Description></rdf:RDF></x:xmpmeta>"
    ).encode()


@pytest.mark.parametrize("packet", [as_attributes(FIELDS), as_elements(FIELDS), as_attributes(FIELDS, "pano")])
def test_the_window_is_the_cropped_area(packet: bytes) -> None:
    assert panorama_of_xmp(packet, 4000, 1000) == EquirectangularCamera(4000, 1000, WINDOW)
    assert panorama_of_xmp(packet, 1000, 250) == EquirectangularCamera(1000, 250, WINDOW), "scaled since"


def test_directions_of_a_window_are_those_of_the_whole_panorama() -> None:
    part = panorama_of_xmp(as_attributes(FIELDS), 4000, 1000)
    assert part is not None
    uv = np.array([[0.0, 0.0], [123.25, 456.5], [3999, 999]])
    whole = EquirectangularCamera(8000, 4000)
    assert part.unproject(uv) == pytest.approx(whole.unproject(uv + np.array([1000, 1500])), abs=1e-12)
    assert part.unproject(uv) != pytest.approx(whole.unproject(uv + np.array([1000.5, 1500])), abs=1e-6), (
        "half a pixel off"
    )


def test_a_cropped_area_across_the_seam_of_the_panorama() -> None:
    camera = panorama_of_xmp(as_attributes({**FIELDS, "CroppedAreaLeftPixels": "6000"}), 4000, 1000)
    assert camera is not None
    assert camera.window == (90.0, 22.5, 270.0, -22.5)
    behind = camera.project(np.array([0.0, 0.0, -1.0]))  # longitude 180 is its middle
    assert behind == pytest.approx([1999.5, 499.5], abs=1e-6)


def test_a_whole_sphere_has_no_window() -> None:
    whole = {**FIELDS, "CroppedAreaImageWidthPixels": "8000", "CroppedAreaImageHeightPixels": "4000"}
    whole |= {"CroppedAreaLeftPixels": "0", "CroppedAreaTopPixels": "0"}
    without_crop = {name: value for name, value in whole.items() if not name.startswith("Cropped")}
    only_type = {"ProjectionType": "equirectangular"}
    for fields in (whole, without_crop, only_type):
        assert panorama_of_xmp(as_attributes(fields), 4096, 2048) == EquirectangularCamera(4096, 2048)


def test_what_is_no_panorama_has_no_camera() -> None:
    other = b'<x:xmpmeta xmlns:x="adobe:ns:meta/" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"></x:xmpmeta>'
    for packet in (b"", other, as_attributes(FIELDS).replace(b"photos/1.0/panorama", b"photos/1.0/camera")):
        assert panorama_of_xmp(packet, 4000, 1000) is None


@pytest.mark.parametrize(
    ("changed", "size", "said"),
    [
        ({"ProjectionType": "cylindrical"}, (4000, 1000), "projection 'cylindrical'"),
        ({}, (2000, 1000), "it was cropped since"),
        ({"FullPanoHeightPixels": "3000"}, (4000, 1000), "not twice as wide"),
        ({"CroppedAreaTopPixels": "3500"}, (4000, 1000), "does not fit"),
        ({"CroppedAreaImageWidthPixels": "9000"}, (4000, 1000), "does not fit"),
        ({"CroppedAreaLeftPixels": "left"}, (4000, 1000), "impossible"),
        ({"CroppedAreaLeftPixels": "1e300"}, (4000, 1000), "impossible"),
        ({"FullPanoWidthPixels": "0"}, (4000, 1000), "impossible"),
    ],
)
def test_contradictions_are_refused(changed: dict[str, str], size: tuple[int, int], said: str) -> None:
    with pytest.raises(CameraError, match=said):
        panorama_of_xmp(as_attributes({**FIELDS, **changed}), *size)


def test_a_panorama_of_unknown_extent_is_refused() -> None:
    with pytest.raises(CameraError, match="which part of the sphere"):
        panorama_of_xmp(as_attributes({"ProjectionType": "equirectangular"}), 4000, 1000)


@pytest.mark.parametrize("extension", ["jpg", "png", "webp"])
def test_the_packet_is_found_in_the_picture(tmp_path: Path, extension: str) -> None:
    file = tmp_path / f"panorama.{extension}"
    options: dict[str, object] = {"xmp": as_attributes(FIELDS)}
    if extension == "png":
        from PIL.PngImagePlugin import PngInfo

        info = PngInfo()
        info.add_itxt("XML:com.adobe.xmp", as_attributes(FIELDS).decode())
        options = {"pnginfo": info}
    Image.new("RGB", (400, 100)).save(file, **options)  # type: ignore[arg-type]
    assert panorama_of_xmp(read_image(file).xmp, 400, 100) == EquirectangularCamera(400, 100, WINDOW)


def test_mutated_packets_are_read_or_refused() -> None:
    rng = np.random.default_rng(3)
    whole = as_attributes(FIELDS)
    for _ in range(300):
        packet = np.frombuffer(whole, np.uint8).copy()
        packet[rng.integers(0, len(packet), 4)] = rng.integers(0, 256, 4)
        try:
            panorama_of_xmp(packet[: rng.integers(1, len(packet))].tobytes(), 4000, 1000)
        except CameraError:
            continue


def _sphere(height: int) -> ByteArray:
    """Return a picture of a pattern on the sphere."""
    camera = EquirectangularCamera(2 * height, height)
    rows, columns = np.mgrid[:height, : 2 * height]
    rays = camera.unproject(np.stack([columns, rows], axis=-1))
    wave = np.sin(9 * rays[..., 0]) + np.cos(7 * rays[..., 2]) + np.sin(5 * rays[..., 1] + 3 * rays[..., 0])
    return np.clip(128 + 40 * wave, 0, 255).astype(np.uint8)


def test_only_whole_panoramas_look_like_one() -> None:
    sphere = _sphere(256)
    assert looks_like_panorama(sphere)
    assert looks_like_panorama(np.repeat(sphere[..., None], 3, axis=-1))
    assert not looks_like_panorama(sphere[:200]), "not twice as wide as high"
    assert not looks_like_panorama(sphere[64:192, 100:356]), "a part, of the same shape"
    assert not looks_like_panorama(np.roll(sphere, 128, axis=0)), "the top row shows more than one direction"


def _saved(path: Path, pixels: ByteArray, xmp: bytes = b"") -> Path:
    Image.fromarray(pixels).convert("RGB").save(path, quality=95, **({"xmp": xmp} if xmp else {}))
    return path


def test_a_panorama_is_read_from_the_photograph_alone(tmp_path: Path) -> None:
    file = _saved(tmp_path / "a.jpg", np.zeros((100, 400), np.uint8), as_attributes(FIELDS))
    photo = read_photo(file)
    assert photo.camera == EquirectangularCamera(400, 100, WINDOW)
    assert photo.calibrated
    assert not photo.assumed
    assert any("XMP" in note for note in photo.notes)
    described = describe(file)
    assert (described.camera["model"], described.camera["source"]) == ("equirectangular", "XMP")
    assert read_photo(file, focal_px=300).camera.model == "pinhole", "as given"
    with pytest.raises(CameraError, match="no focal length"):
        read_photo(file, camera_model="pinhole")


def test_a_picture_that_looks_like_a_panorama_is_only_proposed_as_one(tmp_path: Path) -> None:
    file = _saved(tmp_path / "a.jpg", _sphere(128))
    with pytest.raises(CameraError, match="give `camera_model='equirectangular'`"):
        read_photo(file)
    assert any("looks like" in note for note in describe(file).notes)
    assert read_photo(file, camera_model="equirectangular").camera == EquirectangularCamera(256, 128)
    assert not any("looks like" in note for note in read_photo(file, camera_model="pinhole", focal_px=200).notes)


def test_camera_models_that_contradict_are_refused(tmp_path: Path) -> None:
    file = _saved(tmp_path / "a.jpg", np.zeros((100, 300), np.uint8))
    with pytest.raises(CameraError, match="twice as wide as high"):
        read_photo(file, camera_model="equirectangular")
    for options in ({"focal_px": 100}, {"camera": EquirectangularCamera(300, 150)}):
        with pytest.raises(OptionError, match="give"):
            read_photo(file, camera_model="equirectangular", **options)
    with pytest.raises(OptionError, match="must be pinhole or equirectangular"):
        read_photo(file, camera_model="fisheye")  # type: ignore[arg-type]
