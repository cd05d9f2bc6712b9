// All joints that move a vertex. three.js skins with the first four; a glTF file may have more (JOINTS_1, WEIGHTS_1, …).

import * as THREE from "three";

export function useAllInfluences(geometry) {
  restoreFirstFour(geometry);
  for (const set of furtherSets(geometry)) extendShader(set);
}

// Returns each vertex' joints and weights, as a function of the vertex that yields [joint, weight].
export function influencesOf(geometry) {
  const pairs = [["skinIndex", "skinWeight"], ...furtherSets(geometry).map((set) => [`joints_${set}`, `weights_${set}`])];
  return function* (vertex) {
    for (const [joints, weights] of pairs) {
      for (let c = 0; c < 4; c++) {
        yield [geometry.attributes[joints].getComponent(vertex, c), geometry.attributes[weights].getComponent(vertex, c)];
      }
    }
  };
}

// Returns the box around a posed mesh in the world, with its blend shapes.
export function posedBox(mesh) {
  const box = new THREE.Box3();
  const point = new THREE.Vector3();
  const moved = new THREE.Vector3();
  const matrices = mesh.skeleton.bones.map((bone, b) =>
    bone.matrixWorld.clone().multiply(mesh.skeleton.boneInverses[b]).multiply(mesh.bindMatrix),
  );
  const influences = influencesOf(mesh.geometry);
  for (let vertex = 0; vertex < mesh.geometry.attributes.position.count; vertex++) {
    THREE.Mesh.prototype.getVertexPosition.call(mesh, vertex, point); // before the skin
    const sum = new THREE.Vector3();
    for (const [joint, weight] of influences(vertex)) {
      if (weight) sum.addScaledVector(moved.copy(point).applyMatrix4(matrices[joint]), weight);
    }
    box.expandByPoint(sum);
  }
  return box;
}

// Returns the sum of weights of every joint that moves a vertex.
export function jointShares({ geometry, skeleton }) {
  const sums = new Map();
  const influences = influencesOf(geometry);
  for (let vertex = 0; vertex < geometry.attributes.position.count; vertex++) {
    for (const [index, weight] of influences(vertex)) {
      sums.set(skeleton.bones[index], (sums.get(skeleton.bones[index]) ?? 0) + weight);
    }
  }
  return sums;
}

function furtherSets(geometry) {
  const names = Object.keys(geometry.attributes).map((name) => /^joints_(\d+)$/.exec(name));
  return names.filter(Boolean).map((found) => Number(found[1]));
}

// The loader scaled the first four weights of a vertex to a sum of one.
function restoreFirstFour(geometry) {
  const first = geometry.attributes.skinWeight;
  const sets = furtherSets(geometry);
  for (let vertex = 0; vertex < first.count; vertex++) {
    let share = 1;
    for (const set of sets) {
      for (let c = 0; c < 4; c++) share -= geometry.attributes[`weights_${set}`].getComponent(vertex, c);
    }
    for (let c = 0; c < 4; c++) first.setComponent(vertex, c, Math.max(0, share) * first.getComponent(vertex, c));
  }
}

function extendShader(set) {
  const axes = ["x", "y", "z", "w"];
  const bone = (axis) => `getBoneMatrix( joints_${set}.${axis} )`;
  const weight = (axis) => `weights_${set}.${axis}`;
  const points = axes.map((axis) => `skinned += ${bone(axis)} * skinVertex * ${weight(axis)};`).join("\n");
  const normals = axes.map((axis) => `skinMatrix += ${weight(axis)} * ${bone(axis)};`).join("\n");
  extend("skinning_pars_vertex", "uniform mat4 bindMatrix;", `attribute vec4 joints_${set};\nattribute vec4 weights_${set};\n`);
  extend("skinning_vertex", "transformed = ( bindMatrixInverse * skinned ).xyz;", `${points}\n`);
  extend("skinnormal_vertex", "skinMatrix = bindMatrixInverse * skinMatrix * bindMatrix;", `${normals}\n`);
}

function extend(chunk, before, text) {
  if (!THREE.ShaderChunk[chunk].includes(before)) throw new Error(`three.js has another ${chunk}`);
  THREE.ShaderChunk[chunk] = THREE.ShaderChunk[chunk].replace(before, text + before);
}
