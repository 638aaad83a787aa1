// A cloud in potree-core, and photographs placed by three.js from what Potree 1.8 reads of them
// (src/modules/OrientedImages/OrientedImages.js, src/modules/Images360/Images360.js).

import * as THREE from "three";
import { PointShape, PointSizeType, Potree } from "potree-core";

const EXPORT = "/export";
const TURN = Math.PI / 180;

const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.setSize(innerWidth, innerHeight);
document.body.append(renderer.domElement);
const scene = new THREE.Scene();
const camera = new THREE.PerspectiveCamera(60, innerWidth / innerHeight, 0.05, 2000);
const potree = new Potree();
potree.pointBudget = 5_000_000;

const cloud = await potree.loadPointCloud("metadata.json", `${EXPORT}/pointcloud/`);
cloud.material.shape = PointShape.SQUARE;
cloud.material.pointSizeType = PointSizeType.FIXED;
cloud.material.size = 6;
cloud.material.outputColorEncoding = cloud.material.inputColorEncoding;  // as the file has them
scene.add(cloud);

async function oriented(folder, order) {
  const xml = new DOMParser().parseFromString(await text(`${folder}/camera.xml`), "application/xml");
  const [width, height, f] = ["width", "height", "f"].map((name) => Number(xml.querySelector(name).textContent));
  const fov = 2 * Math.atan(height / 2 / f) / TURN;
  const lines = (await text(`${folder}/photographs.txt`)).split(/\r?\n/).slice(1);
  return Promise.all(lines.filter((line) => line.split(/\s+/).length >= 6).map(async (line) => {
    const [file, ...numbers] = line.split(/\s+/);
    const [x, y, z, ...angles] = numbers.map(Number);
    const map = await new THREE.TextureLoader().loadAsync(`${EXPORT}/${folder}/${file}`);
    map.colorSpace = THREE.SRGBColorSpace;
    const mesh = new THREE.Mesh(new THREE.PlaneGeometry(1, 1), new THREE.MeshBasicMaterial({ map }));
    mesh.position.set(x, y, z);
    mesh.rotation.set(...angles.map((angle) => angle * TURN), order);
    mesh.scale.set(width / height, 1, 1);
    mesh.updateMatrixWorld();
    mesh.position.add(mesh.getWorldDirection(new THREE.Vector3()).multiplyScalar(-0.5 / Math.tan(fov * TURN / 2)));
    scene.add(mesh);
    return { mesh, fov, place: new THREE.Vector3(x, y, z), turn: mesh.quaternion.clone() };
  }));
}

async function panoramas(folder) {
  const lines = (await text(`${folder}/coordinates.txt`)).split(/\r?\n/).slice(1);
  return Promise.all(lines.filter((line) => line.trim()).map(async (line) => {
    const [file, , ...numbers] = line.split("\t");
    const [x, y, z, course, pitch, roll] = numbers.map(Number);
    const map = await new THREE.TextureLoader().loadAsync(`${EXPORT}/${folder}/${file.replaceAll('"', "")}`);
    map.colorSpace = THREE.SRGBColorSpace;
    map.wrapS = THREE.RepeatWrapping;
    map.repeat.x = -1;
    const material = new THREE.MeshBasicMaterial({ map, side: THREE.BackSide });
    const mesh = new THREE.Mesh(new THREE.SphereGeometry(1, 128, 128), material);
    mesh.scale.set(1000, 1000, 1000);
    mesh.rotation.set((roll + 90) * TURN, -pitch * TURN, (90 - course) * TURN, "ZYX");
    mesh.position.set(x, y, z);
    scene.add(mesh);
    return { mesh, place: mesh.position.clone() };
  }));
}

async function text(name) {
  return (await fetch(`${EXPORT}/${name}`)).text();
}

const about = JSON.parse(await text("photographs.json"));
const shown = (await Promise.all(about.cameras.map((folder) => oriented(folder, "XYZ")))).flat();
const wrong = (await Promise.all(about.cameras.map((folder) => oriented(folder, "ZYX")))).flat();
const spheres = about.panoramas === null ? [] : await panoramas(about.panoramas);
const pictures = { shown, wrong, spheres };

function look(place, turn, fov) {
  camera.position.copy(place);
  camera.quaternion.copy(turn);
  camera.fov = fov;
  camera.updateProjectionMatrix();
  camera.updateMatrixWorld();
}

/** Looks through a photograph, and shows the cloud alone, or one of the pictures alone. */
window.show = (kind, number) => {
  const from = shown[number];
  look(from.place, from.turn, from.fov);
  for (const [name, list] of Object.entries(pictures)) {
    list.forEach((one, k) => { one.mesh.visible = name === kind && (kind === "spheres" || k === number); });
  }
  cloud.visible = kind === "cloud";
};

/** Returns where points of the world are in a photograph, by three.js's projection: shares of width and height. */
window.project = (number, points) => {
  const from = shown[number];
  look(from.place, from.turn, from.fov);
  const { width, height } = from.mesh.material.map.image;
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  const found = points.map((point) => {
    const { x, y } = new THREE.Vector3(...point).project(camera);
    return [(x + 1) / 2, (1 - y) / 2];
  });
  camera.aspect = innerWidth / innerHeight;
  camera.updateProjectionMatrix();
  return found;
};

window.overview = (place, target) => {
  for (const one of [...wrong, ...spheres]) {
    one.mesh.visible = false;
  }
  for (const one of shown) {
    one.mesh.visible = true;
  }
  cloud.visible = true;
  camera.up.set(0, 0, 1);
  camera.position.set(...place);
  camera.lookAt(...target);
  camera.fov = 60;
  camera.updateProjectionMatrix();
};

let waiting = 1;

function draw() {
  waiting = potree.updatePointClouds([cloud], camera, renderer).nodeLoadPromises.length;
  renderer.render(scene, camera);
  requestAnimationFrame(draw);
}

window.show("cloud", 0);
draw();
window.points = () => ({ visible: cloud.numVisiblePoints, waiting });
document.documentElement.dataset.ready = "yes";
