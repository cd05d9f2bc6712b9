// How the surface is shown: textured, clay, wireframe, coloured by the skin weights of a joint, or its albedo in the
// page's light.

import * as THREE from "three";
import { influencesOf } from "viewer/influences.js";

const CLAY = 0xb9b2a8;
const WIRE = 0x2f6fb5;
const RAMP = [0x26324a, 0x2a6f97, 0x52b788, 0xf9c74f, 0xe63946].map((c) => new THREE.Color(c)); // weights 0 to 1

export class Looks {
  // albedo, normalMap: textures, or null.
  constructor(mesh, albedo, normalMap) {
    this.mesh = mesh;
    this.materials = materialsOf(mesh.material.map, albedo, normalMap);
    this.names = Object.keys(this.materials);
    this.wires = wiresOf(mesh);
    this.show("Textured");
  }

  show(look) {
    this.mesh.material = this.materials[look];
    this.wires.visible = look === "Wireframe";
  }

  colourByWeights(joint) {
    const { geometry, skeleton } = this.mesh;
    const colours = new Float32Array(3 * geometry.attributes.position.count);
    const bone = skeleton.bones.indexOf(joint);
    const influences = influencesOf(geometry);
    for (let vertex = 0; vertex < colours.length / 3; vertex++) {
      let weight = 0;
      for (const [index, share] of influences(vertex)) if (index === bone) weight += share;
      ramp(weight).toArray(colours, 3 * vertex);
    }
    geometry.setAttribute("color", new THREE.BufferAttribute(colours, 3));
  }
}

function ramp(weight) {
  const place = Math.min(Math.max(weight, 0), 1) * (RAMP.length - 1);
  const step = Math.min(Math.floor(place), RAMP.length - 2);
  return RAMP[step].clone().lerp(RAMP[step + 1], place - step);
}

function materialsOf(map, albedo, normalMap) {
  const pushedBack = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
  const clay = { color: CLAY, normalMap, roughness: 0.9 };
  return {
    Textured: new THREE.MeshBasicMaterial({ map }), // light is in the texture
    Clay: new THREE.MeshStandardMaterial(clay),
    Wireframe: new THREE.MeshStandardMaterial({ ...clay, color: 0xe9e6e1, ...pushedBack }),
    Weights: new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 1 }),
    ...(albedo && { Albedo: new THREE.MeshLambertMaterial({ map: albedo, normalMap }) }),
  };
}

function wiresOf(mesh) {
  const material = new THREE.MeshBasicMaterial({ color: WIRE, wireframe: true, transparent: true, opacity: 0.5 });
  const wires = new THREE.SkinnedMesh(mesh.geometry, material);
  wires.bind(mesh.skeleton, mesh.bindMatrix);
  wires.morphTargetInfluences = mesh.morphTargetInfluences; // the same array
  wires.frustumCulled = false;
  mesh.add(wires);
  return wires;
}
