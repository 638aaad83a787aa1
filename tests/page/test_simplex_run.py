"""A run of the simplex is kept and replayed at any speed; its photograph is thrown onto the surface as OpenCV would."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from ladarreg_core.frames import rotation_from_rotvec

if TYPE_CHECKING:
    from playwright.sync_api import Page

REPLAY = """async () => {
  const { SimplexRun } = await import('/js/state/simplex_run.js');
  let now = 0;
  const run = new SimplexRun(() => now);
  const shown = () => run.current?.iteration ?? null;
  const frame = (iteration) => ({ photo: "p1", iteration });
  const said = {};
  for (let k = 0; k <= 100; k += 2) run.add(frame(k));
  said.live = shown();
  run.leave();
  said.left = shown();
  run.play();
  said.begun = shown();
  for (const at of [500, 1000]) { now = at; run.tick(); }
  said.after_a_second = shown();
  run.pace(10);
  now = 2000; run.tick();
  said.slower = shown();
  run.hold();
  now = 9000; run.tick();
  said.held = shown();
  run.play();
  now = 60000; run.tick();
  said.end = [shown(), run.playing];
  run.seek(3);
  said.sought = shown();
  run.add(frame(1));
  said.another = [shown(), run.frames.length];
  for (let k = 2; k < 5000; k += 1) run.add(frame(k));
  said.kept = [run.frames.length <= 602, run.frames.at(-1).iteration, run.frames[0].iteration];
  return said;
}"""
THROWN = """async ([positions, faces, camera, pose]) => {
  const { thrownOnto } = await import('/js/panels/model/photo_slide.js');
  const found = thrownOnto({ positions: new Float32Array(positions), faces: new Uint32Array(faces) }, camera, pose);
  return [[...found.uv], [...found.faces]];
}"""


def test_a_run_is_replayed_at_any_speed(page: Page, modules: str) -> None:
    page.goto(f"{modules}/blank.html")
    assert page.evaluate(REPLAY) == {
        "live": 100, "left": None, "begun": 0, "after_a_second": 60, "slower": 70, "held": 70, "end": [100, False],
        "sought": 6, "another": [1, 1], "kept": [True, 4999, 1],
    }  # fmt: skip


def test_the_photograph_is_thrown_as_its_camera_sees(page: Page, modules: str) -> None:
    rng = np.random.default_rng(3)
    width, height = 640, 480
    camera = {"width": width, "height": height, "fx": 500.0, "fy": 510.0, "cx": 322.0, "cy": 236.0}
    distortion = [-0.2, 0.06, 1e-3, -2e-3, 0.01]
    pose = np.column_stack([rotation_from_rotvec((0.1, -0.2, 0.3)), (0.2, -0.1, 0.3)])
    seen = np.column_stack([rng.uniform(-1.2, 1.2, (300, 2)), np.ones(300)]) * rng.uniform(1, 6, (300, 1))
    seen[:20, 2] *= -1  # behind the camera
    points = (seen - pose[:, 3]) @ pose[:, :3]
    matrix = np.array([[500.0, 0, 322], [0, 510, 236], [0, 0, 1]])
    expected = cv2.projectPoints(seen, np.zeros(3), np.zeros(3), matrix, np.array(distortion))[0][:, 0]
    faces = np.arange(300).reshape(-1, 3)
    page.goto(f"{modules}/blank.html")
    uv, kept = page.evaluate(
        THROWN, [points.ravel().tolist(), faces.ravel().tolist(), {**camera, "distortion": distortion}, pose.tolist()]
    )
    inside = (
        (seen[:, 2] > 0) & (expected >= -0.5).all(axis=1) & (expected <= np.array([width, height]) - 0.5).all(axis=1)
    )
    np.testing.assert_array_equal(np.reshape(kept, (-1, 3)), faces[inside[faces].all(axis=1)])
    assert 3 < len(kept) < 300
    places = np.reshape(uv, (-1, 2))[inside] * (width, height) - 0.5
    np.testing.assert_allclose(places, expected[inside], atol=2e-3)
