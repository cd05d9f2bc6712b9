// The avatar of a file that hnerf/asset/glb.py wrote: its mesh, joints and motions, and what the user adds to them.

import * as THREE from "three";
import { GLTFLoader } from "three/GLTFLoader.js";
import { jointShares, posedBox, useAllInfluences } from "viewer/influences.js";

const GROUND_SAMPLES = 6; // instants of a motion at which its lowest point is sought

export class Avatar {
  static async load(bytes) {
    const gltf = await new GLTFLoader().parseAsync(bytes, "");
    return new Avatar(gltf, await albedoOf(gltf.parser), await normalMapOf(gltf.parser));
  }

  constructor(gltf, albedo, normalMap) {
    this.root = gltf.scene;
    this.albedo = albedo;
    this.normalMap = normalMap;
    this.motions = gltf.animations;
    this.root.traverse((node) => node.isSkinnedMesh && (this.mesh = node)); // there is one
    this.mesh.frustumCulled = false; // its bounds are those of the rest pose
    useAllInfluences(this.mesh.geometry);
    this.joints = this.mesh.skeleton.bones;
    this.inverses = new Map(this.joints.map((joint, j) => [joint, this.mesh.skeleton.boneInverses[j]]));
    this.shares = jointShares(this.mesh);
    this.turns = new Map(this.joints.map((joint) => [joint, new THREE.Euler()]));
    this.shapes = shapesOf(this.mesh, this.motions);
    this.mixer = new THREE.AnimationMixer(this.root);
    this.motion = null;
    this.time = 0;
    this.animated = this.snapshot();
  }

  // Adds lower levels of detail: triangles of some of the vertices, as lists of indices.
  addLevels(lower) {
    const added = lower.map((indices) => new THREE.BufferAttribute(new Uint32Array(indices), 1));
    this.levels = [this.mesh.geometry.index, ...added];
  }

  showLevel(level) {
    const { geometry } = this.mesh;
    const { version } = geometry.index;
    geometry.setIndex(this.levels[level]);
    geometry.index.version = version + 1; // the wireframe's lines are drawn anew only for a later version
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
    for (const { index, added } of this.shapes) this.mesh.morphTargetInfluences[index] += added;
    this.root.updateMatrixWorld(true);
  }

  snapshot() {
    return {
      quaternions: this.joints.map((joint) => joint.quaternion.clone()),
      weights: this.mesh.morphTargetInfluences?.slice(),
    };
  }

  restore() {
    this.joints.forEach((joint, j) => joint.quaternion.copy(this.animated.quaternions[j]));
    this.animated.weights?.forEach((weight, k) => (this.mesh.morphTargetInfluences[k] = weight));
  }

  // Returns the bounds of the motion's first instant, the height of the ground (the median of its lowest points), and
  // which way the person faces.
  bounds() {
    const count = this.motion ? GROUND_SAMPLES : 1;
    const boxes = Array.from({ length: count }, (_, sample) => {
      this.pose((this.duration * sample) / count);
      return posedBox(this.mesh);
    });
    this.pose(0);
    const lowest = boxes.map((box) => box.min.y).sort((a, b) => a - b);
    return { ...this.present(), ground: lowest[Math.floor(count / 2)] };
  }

  // Returns the bounds of the present pose, and which way the person faces.
  present() {
    return { box: posedBox(this.mesh), forward: this.forward() };
  }

  // A glTF file's front is +z at rest; returns where the joints turn it, by their shares of the surface.
  forward() {
    const sum = new THREE.Vector3();
    for (const [joint, share] of this.shares) {
      const front = new THREE.Vector3(0, 0, 1).transformDirection(this.inverses.get(joint));
      sum.addScaledVector(front.transformDirection(joint.matrixWorld), share);
    }
    return sum.normalize();
  }

  get heaviest() {
    return [...this.shares].reduce((best, other) => (other[1] > best[1] ? other : best))[0];
  }

  // Returns the mean place of the joints.
  centre() {
    const sum = new THREE.Vector3();
    for (const joint of this.joints) sum.add(new THREE.Vector3().setFromMatrixPosition(joint.matrixWorld));
    return sum.divideScalar(this.joints.length);
  }
}

// Returns the texture without the recording's light, or null. It is a material that the mesh does not use by default.
async function albedoOf(parser) {
  const index = parser.json.materials.findIndex(({ name }) => name === "Albedo");
  return index < 0 ? null : (await parser.getDependency("material", index)).map;
}

// Returns the normal map, or null. The loader leaves it out of the mesh's own material, which is unlit.
async function normalMapOf(parser) {
  const { normalTexture } = parser.json.materials[0];
  return normalTexture ? parser.getDependency("texture", normalTexture.index) : null;
}

// Returns the blend shapes, and whether a motion uses them; those that none uses are expressions and physiques.
export function shapesOf(mesh, motions) {
  const names = Object.keys(mesh.morphTargetDictionary ?? {}); // in the order of the file
  const shapes = names.map((name, index) => ({ name, index, added: 0, moves: false }));
  for (const { name, values } of motions.flatMap((motion) => motion.tracks)) {
    if (!name.endsWith(".morphTargetInfluences")) continue;
    values.forEach((weight, i) => (shapes[i % shapes.length].moves ||= weight > 0));
  }
  return shapes;
}
