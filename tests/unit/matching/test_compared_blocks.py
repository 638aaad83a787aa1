"""What each block of a registration says: beside the pose and its covariance, and through every file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ladarreg_core as lr
from ladarreg_core.camera.uncertainty import pose_jacobian
from ladarreg_core.errors import FormatError, ShapeError
from ladarreg_core.export.json import registration_document, write_result
from ladarreg_core.formats.documents.registration_file import as_given, read_registration, read_result
from ladarreg_core.project.results import pose_entry, registration_of
from ladarreg_core.results.compared_blocks import ComparedBlocks
from testing.scenes.painted_room import registered_room

ARRAYS = ("uv", "offset_px", "information", "correlation", "agrees")


@pytest.fixture(scope="module")
def found() -> lr.Registration:
    return registered_room(seed=3)


def blocks_of(registration: lr.Registration) -> ComparedBlocks:
    assert registration.blocks is not None
    return registration.blocks


def assert_same(one: ComparedBlocks | None, other: ComparedBlocks) -> None:
    assert one is not None
    assert one.ids == other.ids
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), strict=True)


def test_blocks_belong_to_the_matches(found: lr.Registration) -> None:
    blocks, matches = blocks_of(found), found.matches
    place = {name: k for k, name in enumerate(blocks.ids)}
    assert len(place) == len(blocks) >= len(matches)
    of_match = np.array([place[name] for name in matches.pick_ids])
    np.testing.assert_array_equal(blocks.agrees[of_match], found.inliers)
    assert blocks.agrees.sum() == found.inliers.sum()
    predicted = found.camera.project(found.camera_from_scanner @ matches.points)
    np.testing.assert_allclose(blocks.uv[of_match], predicted, atol=0.01)
    # the match is damped along straight edges, the block's own offset is not: across them they are alike
    value, vector = np.linalg.eigh(blocks.information[of_match][found.inliers])
    across = vector[:, :, 1]
    own = (blocks.offset_px[of_match][found.inliers] * across).sum(axis=1)
    damped = (found.residuals_px[found.inliers] * across).sum(axis=1)
    assert np.corrcoef(own, damped)[0, 1] > 0.95
    assert (value > 0).all()


def test_their_information_gives_the_pose_and_its_covariance_but_for_common_errors(found: lr.Registration) -> None:
    blocks = blocks_of(found)
    place = {name: k for k, name in enumerate(blocks.ids)}
    of_match = np.array([place[name] for name in found.matches.pick_ids])
    _, J = pose_jacobian(found.camera_from_scanner, found.matches.points, found.camera)
    weighted = np.einsum("nip,nij->npj", J, blocks.information[of_match].astype(float))
    alone = np.linalg.inv(np.einsum("npj,njq->pq", weighted, J))
    step = alone @ np.einsum("npj,nj->p", weighted, blocks.offset_px[of_match])
    sigma = np.sqrt(np.diag(found.covariance))
    assert (np.abs(step) < sigma).all()
    share = np.sqrt(np.diag(alone)) / sigma
    assert ((share > 0.25) & (share < 1)).all()


def test_blocks_go_through_files_without_loss(found: lr.Registration, tmp_path: Path) -> None:
    blocks = blocks_of(found)
    assert_same(ComparedBlocks.from_fields(json.loads(json.dumps(blocks.as_fields()))), blocks)
    assert_same(lr.Registration.from_json(found.to_json()).blocks, blocks)
    assert_same(registration_of(pose_entry("auto", found)).blocks, blocks)
    path = tmp_path / "registration.json"
    document = registration_document(found)
    write_result(path, document)
    assert_same(read_result(path)[0].blocks, blocks)
    assert read_registration(path).blocks is None, "as its matches"
    assert "blocks" not in as_given(document), "of an edited file"


def test_files_without_blocks_are_read_as_before(found: lr.Registration, tmp_path: Path) -> None:
    without = replace(found, blocks=None)
    assert registration_of(pose_entry("auto", without)).blocks is None
    document = registration_document(without)
    assert "blocks" not in document
    write_result(tmp_path / "registration.json", document)
    assert read_result(tmp_path / "registration.json")[0].blocks is None
    older = json.loads(found.to_json())
    del older["blocks"]
    assert lr.Registration.from_json(json.dumps(older)).blocks is None


@pytest.mark.parametrize("damage", [{"uv": [1, 2, 3]}, {"information": "x"}, {"agrees": None, "offset_px": [None, 1]}])
def test_damaged_blocks_are_refused(found: lr.Registration, tmp_path: Path, damage: dict[str, Any]) -> None:
    document = registration_document(found)
    document["blocks"][0] |= damage
    with pytest.raises(ShapeError):
        ComparedBlocks.from_fields(document["blocks"])
    write_result(tmp_path / "registration.json", document)
    with pytest.raises(FormatError, match="blocks"):
        read_result(tmp_path / "registration.json")


def test_blocks_of_several_pictures_are_joined(found: lr.Registration) -> None:
    blocks = blocks_of(found)
    both = ComparedBlocks.joined([blocks.named("f0."), blocks.named("f1.")])
    assert len(both) == len(set(both.ids)) == 2 * len(blocks)
    np.testing.assert_array_equal(both.information[len(blocks) :], blocks.information)
