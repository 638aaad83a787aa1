"""The page that shows an export in Potree, which the user puts beside it."""

from __future__ import annotations

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Point cloud and photographs</title>
<!-- Potree 1.8 (BSD-2-Clause, potree.org) is not part of this folder: put a release of it here as the folder `potree`,
  so that potree/build/potree/potree.js exists, and publish this folder by a web server that answers requests for parts
  of a file. -->
<link rel="stylesheet" href="potree/build/potree/potree.css">
<link rel="stylesheet" href="potree/libs/jquery-ui/jquery-ui.min.css">
<link rel="stylesheet" href="potree/libs/openlayers3/ol.css">
<link rel="stylesheet" href="potree/libs/spectrum/spectrum.css">
<link rel="stylesheet" href="potree/libs/jstree/themes/mixed/style.css">
<style>
#missing { position: absolute; inset: 0; z-index: 9; padding: 12vh 10vw; background: #1b222c; color: #eef2f6;
  font: 17px/1.5 system-ui, sans-serif; white-space: pre-line; }
</style>
</head>
<body>
<script src="potree/libs/jquery/jquery-3.1.1.min.js"></script>
<script src="potree/libs/spectrum/spectrum.js"></script>
<script src="potree/libs/jquery-ui/jquery-ui.min.js"></script>
<script src="potree/libs/other/BinaryHeap.js"></script>
<script src="potree/libs/tween/tween.min.js"></script>
<script src="potree/libs/d3/d3.js"></script>
<script src="potree/libs/proj4/proj4.js"></script>
<script src="potree/libs/openlayers3/ol.js"></script>
<script src="potree/libs/i18next/i18next.js"></script>
<script src="potree/libs/jstree/jstree.js"></script>
<script src="potree/build/potree/potree.js"></script>
<script src="potree/libs/plasio/js/laslaz.js"></script>
<div class="potree_container" style="position: absolute; inset: 0">
  <div id="potree_render_area"></div>
  <div id="potree_sidebar_container"></div>
</div>
<div id="missing" hidden></div>
<script>
function refuse(text) {
  const place = document.getElementById("missing");
  place.textContent = text;
  place.hidden = false;
}

async function answersParts() {
  const answer = await fetch("pointcloud/octree.bin", { headers: { Range: "bytes=0-0" } });
  await answer.body.cancel();
  return answer.status === 206;
}

async function show() {
  if (location.protocol === "file:") {
    return refuse("Potree cannot read files from a disk: publish this folder by a web server, and open its address.");
  }
  if (typeof Potree === "undefined") {
    return refuse("Potree is missing.\\nPut a release of Potree 1.8 (potree.org) into this folder as `potree`, so that "
      + "potree/build/potree/potree.js exists, and load the page again.");
  }
  if (!await answersParts()) {
    return refuse("This web server sends whole files where parts are asked for, as Python's http.server does.\\n"
      + "Publish the folder by another one: nginx, Apache or Node's http-server.");
  }
  const about = await (await fetch("photographs.json")).json();
  window.viewer = new Potree.Viewer(document.getElementById("potree_render_area"));
  viewer.setEDLEnabled(false);
  viewer.setFOV(60);
  viewer.setPointBudget(3_000_000);
  const text = document.createElement("span");
  text.textContent = [about.frame_is, ...about.poses].join("; ");
  viewer.setDescription(text.innerHTML);
  viewer.loadGUI(() => {
    viewer.setLanguage("en");
    $("#menu_scene").next().show();
    viewer.toggleSidebar();
  });
  Potree.loadPointCloud("pointcloud/metadata.json", "ladarreg", ({ pointcloud }) => {
    pointcloud.material.size = 1;
    pointcloud.material.pointSizeType = Potree.PointSizeType.ADAPTIVE;
    pointcloud.material.activeAttributeName = "rgba";
    viewer.scene.addPointCloud(pointcloud);
    viewer.fitToScreen();
  });
  for (const folder of about.cameras) {
    Potree.OrientedImageLoader.load(`${folder}/camera.xml`, `${folder}/photographs.txt`, viewer).then((images) => {
      images.name = folder;
      viewer.scene.addOrientedImages(images);
    });
  }
  if (about.panoramas !== null) {
    Potree.Images360Loader.load(about.panoramas, viewer).then((images) => viewer.scene.add360Images(images));
  }
}

show().catch((error) => refuse(`The cloud cannot be shown: ${error.message}`));
</script>
</body>
</html>
"""
"""`index.html`: nothing in it comes from the data, which it reads from `photographs.json`."""
