// The scene around the avatar, and the cameras that look at it: a free one, and those of the recording.

import * as THREE from "three";
import { OrbitControls } from "three/OrbitControls.js";

const FIELD_OF_VIEW_DEG = 30;
const NEAR_M = 0.05;
const FAR_M = 1000; // as in USD; a long lens may be hundreds of metres away
const KEY_TURN_RAD = 0.1;
const KEY_ZOOM = 1.1;
const MARGIN = 1.12; // height of the image over that of the person
const SIDEWAYS_RAD = 0.35;
const RAISED = 0.12;
const CELL_M = 0.5;
const GRID_CELLS = 12; // from the middle to the edge, towards which lines fade

export class Stage {
  constructor(canvas, photograph) {
    this.canvas = canvas;
    this.photograph = photograph;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.scene = new THREE.Scene();
    this.free = new THREE.PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, NEAR_M, FAR_M);
    this.through = new THREE.PerspectiveCamera(); // placed and projected by `lookThrough`
    this.through.matrixAutoUpdate = false;
    this.recorded = null;
    this.orbit = new OrbitControls(this.free, canvas);
    this.key = new THREE.DirectionalLight(0xffffff, 1.9);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8b8880, 1.3), this.key);
    this.grid = new THREE.Group();
    this.scene.add(this.grid);
    this.followed = null;
  }

  get camera() {
    return this.recorded ? this.through : this.free;
  }

  // Draws the ground in the page's colour, one line for each side of a cell.
  drawGround() {
    const { r, g, b } = new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue("--grid").trim());
    const points = [];
    const colours = [];
    const add = (x, z) => {
      points.push(x * CELL_M, 0, z * CELL_M);
      colours.push(r, g, b, Math.max(0, 1 - Math.hypot(x, z) / GRID_CELLS));
    };
    for (let i = -GRID_CELLS; i <= GRID_CELLS; i++) {
      for (let j = -GRID_CELLS; j < GRID_CELLS; j++) {
        for (const end of [j, j + 1]) add(i, end);
        for (const end of [j, j + 1]) add(end, i);
      }
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.Float32BufferAttribute(points, 3));
    geometry.setAttribute("color", new THREE.Float32BufferAttribute(colours, 4));
    for (const old of this.grid.children) [old.geometry, old.material].forEach((part) => part.dispose());
    this.grid.clear();
    this.grid.add(new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ vertexColors: true, transparent: true })));
  }

  // Puts the free camera before the person, a little to the side, so that the box fills the picture; while the canvas
  // is hidden, as soon as it is shown.
  frame(bounds) {
    this.framedLater = this.canvas.clientWidth * this.canvas.clientHeight ? null : bounds;
    if (this.framedLater) return;
    const { box, ground, forward } = bounds;
    const size = box.getSize(new THREE.Vector3());
    const tangent = Math.tan(THREE.MathUtils.degToRad(FIELD_OF_VIEW_DEG / 2));
    const width = Math.hypot(size.x, size.z);
    const distance = width / 2 + (MARGIN * Math.max(size.y, width / Math.max(0.3, this.free.aspect))) / (2 * tangent);
    box.getCenter(this.orbit.target);
    const direction = forward.clone().setY(0).normalize().applyAxisAngle(this.free.up, SIDEWAYS_RAD).setY(RAISED);
    this.free.position.copy(this.orbit.target).add(direction.setLength(distance));
    this.orbit.update();
    this.grid.position.set(this.orbit.target.x, ground, this.orbit.target.z);
  }

  // Looks through a camera of the recording; null is the free one, which goes on from where the other one was.
  lookThrough(recorded) {
    if (!recorded && this.recorded) this.goOnFrom(this.through);
    this.recorded = recorded;
    this.orbit.enabled = !recorded;
    if (recorded) {
      this.through.matrix.set(...recorded.pose);
      this.through.updateMatrixWorld(true);
    }
    this.resize();
  }

  goOnFrom(camera) {
    const place = new THREE.Vector3().setFromMatrixPosition(camera.matrixWorld);
    const ahead = new THREE.Vector3(0, 0, -1).transformDirection(camera.matrixWorld);
    const distance = Math.max(0.5, this.orbit.target.clone().sub(place).dot(ahead));
    this.free.position.copy(place);
    this.orbit.target.copy(place).addScaledVector(ahead, distance);
    this.orbit.update();
  }

  // Moves the free camera along with a point, by as much as that moved since the last call.
  follow(point) {
    if (this.followed && !this.recorded) {
      const moved = point.clone().sub(this.followed);
      this.free.position.add(moved);
      this.orbit.target.add(moved);
    }
    this.followed = point;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!(width * height)) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.free.aspect = width / height;
    this.free.updateProjectionMatrix();
    if (this.recorded) this.project(this.recorded, width, height);
    if (this.framedLater) this.frame(this.framedLater);
  }

  // Projects so that the photograph, as large as fits into the middle of the canvas, matches pixel by pixel. Pixel
  // centres are at integers, so that its left edge is at -0.5.
  project({ fx, fy, cx, cy, width, height }, canvasWidth, canvasHeight) {
    const scale = Math.min(canvasWidth / width, canvasHeight / height);
    const left = (canvasWidth - width * scale) / 2;
    const top = (canvasHeight - height * scale) / 2;
    const x = left + (cx + 0.5) * scale;
    const y = top + (cy + 0.5) * scale;
    const [perX, perY] = [NEAR_M / (fx * scale), NEAR_M / (fy * scale)];
    this.through.projectionMatrix.makePerspective(
      -x * perX, (canvasWidth - x) * perX, y * perY, -(canvasHeight - y) * perY, NEAR_M, FAR_M,
    );
    this.through.projectionMatrixInverse.copy(this.through.projectionMatrix).invert();
    const box = { left, top, width: width * scale, height: height * scale };
    for (const [side, px] of Object.entries(box)) this.photograph.style[side] = `${px}px`;
  }

  // Turns and zooms by keys; returns whether the key was one of those.
  keyed(key) {
    const turns = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const zooms = { "+": 1 / KEY_ZOOM, "=": 1 / KEY_ZOOM, "-": KEY_ZOOM };
    if (this.recorded || !(key in turns || key in zooms)) return false;
    const offset = this.free.position.clone().sub(this.orbit.target);
    const around = new THREE.Spherical().setFromVector3(offset);
    if (key in zooms) around.radius *= zooms[key];
    else {
      around.theta += turns[key][0] * KEY_TURN_RAD;
      around.phi += turns[key][1] * KEY_TURN_RAD;
    }
    this.free.position.setFromSpherical(around.makeSafe()).add(this.orbit.target);
    this.orbit.update();
    return true;
  }

  render() {
    const { camera } = this;
    this.key.position.setFromMatrixPosition(camera.matrixWorld).add(new THREE.Vector3(-1.5, 2.5, 0));
    this.key.target.position.copy(this.orbit.target);
    this.key.target.updateMatrixWorld();
    this.renderer.render(this.scene, camera);
  }
}
