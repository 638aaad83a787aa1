from functools import cache

import numpy as np
import pytest

from ladarreg_core.camera import Camera, EquirectangularCamera, FisheyeCamera
from ladarreg_core.errors import Cancelled
from ladarreg_core.frames import Rigid, look_along
from ladarreg_core.scan import Scan
from ladarreg_core.scanner.grids import AzimuthElevation
from ladarreg_core.surface.texture.photo_model import UV_ERROR_PX, ModelPhoto, photo_model
from ladarreg_core.surface.texture.registered_texture import Label, texture_scan
from ladarreg_core.surface.texture.textured_triangles import TexturedTriangles
from testing.scenes.painted_room import painted_room
from testing.scenes.panorama import panorama

LENSES = {
    "pinhole": Camera.from_focal(640, 400, 500.0),
    "5 terms": Camera(640, 400, 500.0, 505.0, 310.0, 203.0, (-0.22, 0.08, 0.001, -0.002, 0.0)),
    "8 terms": Camera(640, 400, 600.0, 600.0, 319.5, 199.5, (0.33, -2.4, 0.0, 0.0, 1.4, 0.21, -2.3, 1.3)),
    "fisheye": FisheyeCamera(700, 700, 240.0, 240.0, 349.5, 349.5, (0.02, -0.003, 0.0, 0.0)),
    "panorama": EquirectangularCamera(3000, 1500),
    "window": EquirectangularCamera(900, 700, (-50.0, 35.0, 40.0, -35.0)),
}
BACKWARDS = Rigid.from_centre(look_along([-1.0, 0.1, 0.05]), [0.2, 0.1, 0.1])


@cache
def room():
    return painted_room(1)


def noise(camera):
    return np.random.default_rng(3).integers(0, 256, (camera.height, camera.width, 3), dtype=np.uint8)


def photo_of(scan, camera, pose, pixels=None):
    from ladarreg_core.photo import Photo

    pixels = noise(camera) if pixels is None else pixels
    return ModelPhoto(pixels, camera, pose, texture_scan(scan, Photo(pixels, camera), pose).labels)


def texture_errors(model, photos, *, shift=0.0, flip=False):
    """Return the distance, px, of textures at points within triangles from the true projections of these points."""
    rng, errors = np.random.default_rng(0), []
    for part in model.parts:
        if part.photo is None:
            continue
        camera, pose = photos[part.photo].camera, photos[part.photo].camera_from_scanner
        uv = part.uv[part.faces].astype(np.float64)
        uv = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1) if flip else uv
        for weights in (rng.dirichlet([1, 1, 1], len(part.faces)) for _ in range(3)):
            points = (part.vertices[part.faces].astype(np.float64) * weights[..., None]).sum(axis=1)
            at = (uv * weights[..., None]).sum(axis=1)
            at = at * (part.tile.width, part.tile.height) - 0.5 + (part.tile.left, part.tile.top) + shift
            errors.append(np.linalg.norm(camera.difference(camera.project(pose @ points), at), axis=1))
    return np.concatenate(errors)


@pytest.mark.parametrize("lens", ["pinhole", "5 terms", "fisheye"])
def test_no_edge_that_errs_is_passed_over_by_the_bound_on_its_triangles(lens, monkeypatch):
    scan, camera = room().scan, LENSES[lens]
    photo = photo_of(scan, camera, Rigid.from_centre(look_along([1.0, 0.1, 0.05]), [0.1, 0.4, 0.1]))
    quick = photo_model(scan, [photo])
    monkeypatch.setattr(TexturedTriangles, "_may_err_in", lambda _, photo, faces, most_px: np.ones(len(faces), bool))
    monkeypatch.setattr(TexturedTriangles, "_may_err_on_grid", lambda _, faces: np.ones(len(faces), bool))
    exact = photo_model(scan, [photo])
    assert len(quick.parts) == len(exact.parts) > 1
    for one, other in zip(quick.parts, exact.parts, strict=True):
        np.testing.assert_array_equal(one.faces, other.faces)
        np.testing.assert_array_equal(one.uv, other.uv)


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
def test_the_texture_errs_by_less_than_a_third_of_a_pixel_anywhere(lens):
    """A control: half a pixel off, or upside down, is found."""
    scene = room()
    photos = [photo_of(scene.scan, LENSES[lens], scene.camera_from_scanner)]
    model = photo_model(scene.scan, photos)
    errors = texture_errors(model, photos)
    assert len(errors) > 20_000
    assert errors.max() <= UV_ERROR_PX == model.uv_error_px
    assert texture_errors(model, photos, shift=0.5).max() > UV_ERROR_PX
    assert np.median(texture_errors(model, photos, flip=True)) > 10


@pytest.mark.slow
def test_triangles_across_the_seam_of_a_panorama_take_pixels_from_both_of_its_sides():
    scene = panorama((1, 2, 3))
    photos = [photo_of(scene.scan, LENSES["panorama"], BACKWARDS)]
    model = photo_model(scene.scan, photos)
    assert texture_errors(model, photos).max() <= UV_ERROR_PX
    pixels = photos[0].pixels
    wrapping = [part for part in model.parts if part.photo == 0 and part.tile.left + part.tile.width > 3000]
    assert len(wrapping) >= 1
    for part in wrapping:
        drawn = part.tile.pixels()
        for column in (0, 3000 - part.tile.left - 1, 3000 - part.tile.left, part.tile.width - 1):
            expected = pixels[part.tile.top : part.tile.top + part.tile.height, (part.tile.left + column) % 3000]
            np.testing.assert_array_equal(drawn[:, column], expected)


def merged(model):
    """Return the model's vertices (N, 3) without duplicates, and its faces."""
    vertices = np.concatenate([part.vertices for part in model.parts])
    starts = np.cumsum([0, *(len(part.vertices) for part in model.parts)])
    faces = np.concatenate([part.faces + start for part, start in zip(model.parts, starts[:-1], strict=True)])
    unique, index = np.unique(vertices, axis=0, return_inverse=True)
    return unique, index.ravel()[faces]


def bumpy_wall():
    geometry = AzimuthElevation(120, 160, 0.008, 0.008)
    bump = 0.2 * np.exp(-(np.square(np.indices((120, 160)) - [[[60]], [[80]]]).sum(axis=0)) / 300)
    return Scan(geometry, 3.0 / geometry.rays[..., 0] - bump, np.ones((120, 160)))


def test_there_are_no_cracks_between_photographs_laser_and_tiles():
    scan = bumpy_wall()
    poses = [Rigid.from_centre(look_along([1.0, y, 0.0]), [0.0, 2 * y, 0.0]) for y in (0.25, -0.25)]
    photos = [photo_of(scan, LENSES["5 terms"].resized(1600, 1000), pose) for pose in poses]
    photos[0] = ModelPhoto(photos[0].pixels, photos[0].camera.resized(1600, 1000), poses[0], photos[0].labels)
    model = photo_model(scan, photos, largest_tile_px=400)
    owners = {part.photo for part in model.parts}
    assert owners == {0, 1, None}
    assert max(max(part.tile.width, part.tile.height) for part in model.parts) <= 400
    vertices, faces = merged(model)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    assert count.max() == 2
    outline = vertices[unique[count == 1]].reshape(-1, 3)
    azimuth, elevation = (
        np.arcsin(outline[:, 1] / np.linalg.norm(outline, axis=1)),
        np.arctan2(outline[:, 2], outline[:, 0]),
    )
    beyond = np.minimum(79.5 * 0.008 - np.abs(azimuth), 59.5 * 0.008 - np.abs(elevation))
    assert beyond.max() < 1e-5  # only the outline of the scan is a border
    normals = np.concatenate([part.normals for part in model.parts])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5)
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    assert ((np.cross(b - a, c - a) * a).sum(axis=1) < 0).all()  # all face the scanner


def test_the_photograph_ends_where_its_frame_does():
    """Not at the last whole cell: the scan is much coarser than the photograph."""
    geometry = AzimuthElevation(40, 60, 0.02, 0.02)
    scan = Scan(geometry, 3.0 / geometry.rays[..., 0], np.ones((40, 60)))
    camera = Camera.from_focal(900, 600, 1500.0)
    photos = [photo_of(scan, camera, Rigid.from_centre(look_along([1.0, 0.0, 0.0]), [0.0, 0.2, 0.0]))]
    part = next(part for part in photo_model(scan, photos).parts if part.photo == 0)
    corners = part.pixels[part.faces]
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2
    assert area > 0.99 * 899 * 599
    assert (part.tile.width, part.tile.height) == camera.size


def test_the_best_photograph_colors_and_crop_leaves_the_rest_out():
    scene = room()
    scan, pose = scene.scan, scene.camera_from_scanner
    photos = [photo_of(scan, scene.photo.camera, pose, scene.photo.pixels), photo_of(scan, LENSES["fisheye"], pose)]
    seen = [np.isin(one.labels, (Label.SEEN, Label.GRAZING, Label.UNCERTAIN)) for one in photos]
    half = np.arange(scan.shape[1]) < 200
    best = np.where(seen[1] & half, 1, np.where(seen[0], 0, -1))
    cropped = photo_model(scan, photos, best, crop=True)
    assert {part.photo for part in cropped.parts} == {0, 1}
    assert texture_errors(cropped, photos).max() <= UV_ERROR_PX
    whole = photo_model(scan, photos, best)
    colored = sum(len(part.faces) for part in whole.parts if part.photo is not None)
    assert whole.faces > cropped.faces
    assert abs(colored - cropped.faces) < 0.02 * colored  # small islands of colour are specks once they are alone
    again = photo_model(scan, photos, best, crop=True)
    for one, other in zip(cropped.parts, again.parts, strict=True):
        np.testing.assert_array_equal(one.faces, other.faces)
        np.testing.assert_array_equal(one.uv, other.uv)


def test_specks_are_left_out_unless_the_model_is_whole():
    scene = room()
    ranges = np.array(scene.scan.ranges)
    ranges[100:103, 100:103] = 0.7  # floats in front of everything
    scan = Scan(scene.scan.geometry, ranges, scene.scan.intensity)
    photos = [photo_of(scan, scene.photo.camera, scene.camera_from_scanner)]
    for full in (False, True):
        points = np.concatenate([part.vertices for part in photo_model(scan, photos, full=full).parts])
        assert (np.linalg.norm(points, axis=1) < 0.8).any() == full


def test_fewer_triangles_cost_a_larger_error_which_is_stated():
    scan = bumpy_wall()
    pose = Rigid.from_centre(look_along([1.0, 0.6, 0.0]), [1.0, 0.0, 0.1])
    photos = [photo_of(scan, LENSES["5 terms"].resized(4000, 2500), pose)]
    free = photo_model(scan, photos)
    most = int(0.9 * free.faces)
    model = photo_model(scan, photos, most_faces=most)
    assert model.faces <= most
    assert model.uv_error_px > free.uv_error_px
    assert texture_errors(model, photos).max() <= model.uv_error_px


def test_a_part_can_be_divided_by_region():
    scene = room()
    photos = [photo_of(scene.scan, scene.photo.camera, scene.camera_from_scanner, scene.photo.pixels)]
    part = photo_model(scene.scan, photos).parts[0]
    left = part.vertices[part.faces, 1].mean(axis=1) > 0
    halves = part.subset(left), part.subset(~left)
    assert sum(len(half.faces) for half in halves) == len(part.faces)
    for half, chosen in zip(halves, (left, ~left), strict=True):
        np.testing.assert_array_equal(half.vertices[half.faces], part.vertices[part.faces[chosen]])
        assert half.tile.width * half.tile.height < part.tile.width * part.tile.height
        corners = np.rint(half.uv * (half.tile.width, half.tile.height) - 0.5).astype(int)
        rows, columns = corners[:, 1] + half.tile.top, corners[:, 0] + half.tile.left
        np.testing.assert_array_equal(
            half.tile.pixels()[corners[:, 1], corners[:, 0]], scene.photo.pixels[rows, columns]
        )
        assert max(half.tile.pixels(100).shape) == 100


def test_points_without_a_surface_become_facets():
    rng = np.random.default_rng(1)
    geometry = AzimuthElevation(60, 60, 0.01, 0.01)
    ranges = np.where(rng.random((60, 60)) < 0.1, rng.uniform(1, 9, (60, 60)), np.nan)
    scan = Scan(geometry, ranges, np.ones((60, 60)))
    photos = [
        photo_of(scan, Camera.from_focal(300, 200, 400.0), Rigid.from_centre(look_along([1.0, 0, 0]), [0, 0.1, 0]))
    ]
    model = photo_model(scan, photos)
    assert model.faces >= np.count_nonzero(scan.valid)
    assert {part.photo for part in model.parts} == {0, None}


def test_it_can_be_cancelled_at_every_report():
    scene = room()
    photos = [photo_of(scene.scan, scene.photo.camera, scene.camera_from_scanner)]
    said = []
    photo_model(scene.scan, photos, report=said.append)
    assert [one.done for one in said] == list(range(len(said)))
    assert said[-1].done < said[-1].total

    def stop(progress):
        if progress.done == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        photo_model(scene.scan, photos, report=stop)
