import cv2
import numpy as np
from PIL import Image

from ladarreg_core.export.images import LABEL_COLOURS, write_labels_png, write_registered_png
from ladarreg_core.surface.texture import Label, RegisteredTexture


def test_the_registered_picture_is_upright_and_lossless(tmp_path, texture):
    write_registered_png(tmp_path / "registered.png", texture)
    with Image.open(tmp_path / "registered.png") as image:
        assert image.mode == "RGB"
        np.testing.assert_array_equal(np.asarray(image), texture.image)


def test_the_labels_are_codes_that_a_person_can_read(tmp_path):
    labels = np.random.default_rng(0).choice(list(Label), size=(9, 14)).astype(np.uint8)
    texture = RegisteredTexture(np.zeros((9, 14, 3), np.uint8), labels)
    write_labels_png(tmp_path / "labels.png", texture)
    with Image.open(tmp_path / "labels.png") as image:
        assert image.mode == "P"
        np.testing.assert_array_equal(np.asarray(image), labels)
        colours = np.asarray(image.convert("RGB"))
    for label in Label:
        assert (colours[labels == label] == LABEL_COLOURS[label]).all()
    # A reader that turns palettes into colours shows those.
    np.testing.assert_array_equal(cv2.imread(str(tmp_path / "labels.png"), cv2.IMREAD_COLOR)[..., ::-1], colours)
    distance = np.linalg.norm(
        [np.subtract(LABEL_COLOURS[a], LABEL_COLOURS[b]) for a in Label for b in Label if a < b], axis=1
    )
    assert distance.min() > 60
