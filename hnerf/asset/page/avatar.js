// The avatar of a glTF file: its meshes, joints and motions, and what the user adds to them.

import * as THREE from "three";
import { GLTFLoader } from "three/GLTFLoader.js";
import { jointShares, posedBox, useAllInfluences } from "viewer/influences.js";

const GROUND_SAMPLES = 6; // instants of a motion at which its lowest point is sought

export class Avatar {
  static async load(bytes) {
    return new Avatar(await new GLTFLoader().parseAsync(bytes, ""));
  }

  constructor(gltf) {
    this.root = gltf.scene;
    this.motions = gltf.animations;
    this.meshes = [];
    this.root.traverse((node) => node.isMesh && this.meshes.push(node));
    for (const mesh of this.meshes) mesh.frustumCulled = false; // its bounds are those of the rest pose
    const skinned = this.meshes.filter((mesh) => mesh.isSkinnedMesh);
    useAllInfluences(skinned);
    this.joints = [...new Set(skinned.flatMap((mesh) => mesh.skeleton.bones))];
    this.inverses = new Map(skinned.flatMap(({ skeleton }) => skeleton.bones.map((b, i) => [b, skeleton.boneInverses[i]])));
    this.shares = jointShares(skinned);
    this.turns = new Map(this.joints.map((joint) => [joint, new THREE.Euler()]));
    this.shapes = shapesOf(this.meshes, this.motions);
    this.mixer = new THREE.AnimationMixer(this.root);
    this.motion = null;
    this.time = 0;
    this.animated = this.snapshot();
  }

  // Plays a motion; null is the rest pose.
  setMotion(motion) {
    this.restore();
    this.mixer.stopAllAction(); // back to rest
    this.animated = this.snapshot();
    this.motion = motion;
    if (motion) this.mixer.clipAction(motion).play();
    this.pose(0);
  }

  get duration() {
    return this.motion ? this.motion.duration : 0;
  }

  // Whether the motion is the recorded one, the file's first; others have no frames of the recording.
  get showsRecording() {
    return this.motion === this.motions[0];
  }

  // Shows an instant of the motion, with the user's turns of joints and weights of shapes on top of it.
  pose(time) {
    this.restore(); // the mixer writes only what changes, so it must find what it wrote
    this.time = time;
    if (this.motion) {
      this.mixer.clipAction(this.motion).time = time;
      this.mixer.update(0);
    }
    this.animated = this.snapshot();
    for (const [joint, turn] of this.turns) joint.quaternion.multiply(new THREE.Quaternion().setFromEuler(turn));
    for (const shape of this.shapes) {
      for (const { mesh, index } of shape.targets) mesh.morphTargetInfluences[index] += shape.added;
    }
    this.root.updateMatrixWorld(true);
  }

  snapshot() {
    return {
      quaternions: this.joints.map((joint) => joint.quaternion.clone()),
      weights: this.meshes.map((mesh) => mesh.morphTargetInfluences?.slice()),
    };
  }

  restore() {
    this.joints.forEach((joint, j) => joint.quaternion.copy(this.animated.quaternions[j]));
    this.meshes.forEach((mesh, m) => {
      this.animated.weights[m]?.forEach((weight, k) => (mesh.morphTargetInfluences[k] = weight));
    });
  }

  // Returns the bounds of the motion's first instant, the height of the ground (the median of its lowest points), and
  // which way the person faces.
  bounds() {
    const count = this.motion ? GROUND_SAMPLES : 1;
    const boxes = Array.from({ length: count }, (_, sample) => {
      this.pose((this.duration * sample) / count);
      return this.box();
    });
    this.pose(0);
    const lowest = boxes.map((box) => box.min.y).sort((a, b) => a - b);
    return { box: boxes[0], ground: lowest[Math.floor(count / 2)], forward: this.forward() };
  }

  box() {
    const box = new THREE.Box3();
    for (const mesh of this.meshes) box.union(mesh.isSkinnedMesh ? posedBox(mesh) : new THREE.Box3().setFromObject(mesh));
    return box;
  }

  // A glTF file's front is +z at rest; returns where the joints turn it, by their shares of the surface.
  forward() {
    const sum = new THREE.Vector3();
    for (const [joint, share] of this.shares) {
      const front = new THREE.Vector3(0, 0, 1).transformDirection(this.inverses.get(joint));
      sum.addScaledVector(front.transformDirection(joint.matrixWorld), share);
    }
    return sum.length() ? sum.normalize() : new THREE.Vector3(0, 0, 1);
  }

  get heaviest() {
    return this.joints.reduce((best, other) => ((this.shares.get(other) ?? 0) > (this.shares.get(best) ?? 0) ? other : best));
  }

  // Returns the mean place of the joints.
  centre() {
    const sum = new THREE.Vector3();
    for (const joint of this.joints) sum.add(new THREE.Vector3().setFromMatrixPosition(joint.matrixWorld));
    return sum.divideScalar(Math.max(1, this.joints.length));
  }
}

// Returns the blend shapes: one for each name, which several meshes may share, with the largest weight that a motion
// gives it, and whether any motion uses it; those that none uses are expressions and physiques.
function shapesOf(meshes, motions) {
  const shapes = new Map();
  for (const mesh of meshes) {
    for (const [key, index] of Object.entries(mesh.morphTargetDictionary ?? {})) {
      const name = /^\d+$/.test(key) ? `Shape ${Number(key) + 1}` : key;
      if (!shapes.has(name)) shapes.set(name, { name, targets: [], added: 0, largest: 1, moves: false });
      const shape = shapes.get(name);
      shape.targets.push({ mesh, index });
      const weight = largestWeight(mesh, index, motions);
      shape.largest = Math.max(shape.largest, weight);
      shape.moves ||= weight > 0;
    }
  }
  return [...shapes.values()];
}

function largestWeight(mesh, index, motions) {
  const count = mesh.morphTargetInfluences.length;
  const tracks = motions.flatMap((motion) => motion.tracks);
  const own = tracks.filter((track) => track.name === `${mesh.name}.morphTargetInfluences`);
  return Math.max(0, ...own.flatMap(({ values }) => [...values].filter((_, i) => i % count === index).map(Math.abs)));
}
