// Connects the page's controls with the avatar, its looks and the stage.

import * as THREE from "three";
import { Avatar } from "viewer/avatar.js";
import { options, radios, slider } from "viewer/controls.js";
import { Looks } from "viewer/looks.js";
import { Photographs } from "viewer/photographs.js";
import { Stage } from "viewer/stage.js";

const REST = "Rest pose";
const MARGIN_FRAMES = 0.01; // after the time slider's last frame, which rounding to floats may put past the end
const find = (id) => document.getElementById(id);

export async function main(bytes, recording, levels) {
  const avatar = await Avatar.load(bytes);
  avatar.addLevels(levels);
  const stage = new Stage(find("canvas"), find("photograph"));
  const viewer = {
    avatar,
    stage,
    recording,
    looks: new Looks(avatar.mesh, avatar.albedo, avatar.normalMap),
    photographs: new Photographs(find("photograph"), find("caption"), recording.fps),
    skeleton: new THREE.SkeletonHelper(avatar.root),
    axes: new THREE.AxesHelper(0.15),
    playing: !matchMedia("(prefers-reduced-motion: reduce)").matches,
  };
  viewer.axes.material.depthTest = false;
  stage.scene.add(avatar.root, viewer.skeleton);
  connectMotion(viewer);
  connectLooks(viewer);
  connectLevels(viewer);
  viewer.choose.camera = connectCameras(viewer);
  connectJoints(viewer);
  connectShapes(viewer);
  connectTheme(viewer);
  connectKeys(viewer);
  connectSize(viewer);
  viewer.setMotion(0);
  stage.frame(viewer.bounds);
  find("message").hidden = true;
  window.viewer = viewer; // for the console
  run(viewer);
}

// Draws whenever something changed; plays in real time.
function run(viewer) {
  const { avatar, stage } = viewer;
  let last;
  viewer.changed = true;
  stage.orbit.addEventListener("change", () => (viewer.changed = true));
  const draw = (now) => {
    const elapsed = ((now - last) / 1000) * Number(find("speed").value);
    last = now;
    if (viewer.playing && avatar.duration) viewer.setTime((avatar.time + elapsed) % avatar.duration);
    if (viewer.changed) {
      viewer.changed = false;
      if (find("follow").checked) stage.follow(avatar.centre());
      else stage.followed = null;
      stage.render();
    }
    requestAnimationFrame(draw);
  };
  requestAnimationFrame((first) => draw((last = first))); // animation time stamps lag behind performance.now()
}

function connectMotion(viewer) {
  const { avatar, stage, recording } = viewer;
  const motions = [...avatar.motions, null];
  viewer.choose = {};
  viewer.setTime = (time) => {
    avatar.pose(time);
    viewer.photographs.show(time, avatar.showsRecording);
    showTime(viewer);
    viewer.changed = true;
  };
  viewer.setMotion = (index) => {
    avatar.setMotion(motions[index]);
    viewer.bounds = avatar.bounds();
    stage.followed = null;
    find("motion").value = index;
    const [, second] = avatar.showsRecording ? [] : (motions[index]?.tracks[0].times ?? []);
    viewer.frameTime = second || 1 / recording.fps;
    const max = avatar.duration + MARGIN_FRAMES * viewer.frameTime;
    Object.assign(find("time"), { max, step: viewer.frameTime, disabled: !avatar.duration });
    viewer.setTime(0);
  };
  viewer.play = (playing) => {
    viewer.playing = playing;
    find("play").textContent = playing ? "Pause" : "Play";
  };
  viewer.step = (frames) => {
    viewer.play(false);
    const frame = Math.round(avatar.time / viewer.frameTime) + frames;
    viewer.setTime(Math.min(Math.max(0, frame * viewer.frameTime), avatar.duration));
  };
  options(find("motion"), motions.map((motion) => motion?.name ?? REST));
  find("motion").addEventListener("change", (event) => {
    viewer.setMotion(Number(event.target.value));
    stage.frame(viewer.bounds);
  });
  find("time").addEventListener("input", (event) => {
    viewer.play(false);
    viewer.setTime(Math.min(Number(event.target.value), avatar.duration));
  });
  find("play").addEventListener("click", () => viewer.play(!viewer.playing));
  viewer.play(viewer.playing);
}

function showTime({ avatar, recording }) {
  const frame = avatar.showsRecording ? `frame ${recording.first_frame + Math.round(avatar.time * recording.fps)} · ` : "";
  const text = avatar.motion ? `${frame}${avatar.time.toFixed(2)} s` : "at rest";
  find("time").value = avatar.time;
  find("time").setAttribute("aria-valuetext", text);
  find("clock").textContent = text;
}

function connectLooks(viewer) {
  const { looks, stage } = viewer;
  viewer.choose.look = radios(find("looks"), looks.names, (index) => {
    looks.show(looks.names[index]);
    viewer.changed = true;
  });
  const shown = { skeleton: [viewer.skeleton, viewer.axes], grid: [stage.grid] };
  for (const [id, objects] of Object.entries(shown)) {
    const show = () => {
      for (const object of objects) object.visible = find(id).checked;
      viewer.changed = true;
    };
    find(id).addEventListener("change", show);
    show();
  }
}

function connectLevels(viewer) {
  const { levels } = viewer.avatar;
  options(find("level"), levels.map((index, k) => `lod${k}, ${index.count / 3} triangles`));
  find("level").hidden = levels.length === 1;
  find("level").addEventListener("change", (event) => {
    viewer.avatar.showLevel(Number(event.target.value));
    viewer.changed = true;
  });
}

function connectCameras(viewer) {
  const { stage, photographs, recording, avatar } = viewer;
  const cameras = [null, ...recording.cameras];
  find("recording").hidden = cameras.length === 1;
  const goTo = (photograph) => {
    viewer.play(false);
    viewer.setTime(Math.min(photograph.time_s, avatar.duration));
  };
  const besides = (direction) => photographs.camera && goTo(photographs.beside(avatar.time, direction));
  viewer.besides = besides;
  find("previous").addEventListener("click", () => besides(-1));
  find("next").addEventListener("click", () => besides(1));
  find("opacity").addEventListener("input", (event) => (find("canvas").style.opacity = event.target.value));
  return radios(find("cameras"), ["Free", ...recording.cameras.map(({ name }) => name)], (index) => {
    stage.lookThrough(cameras[index]);
    photographs.setCamera(cameras[index]);
    find("compare").hidden = !cameras[index];
    find("canvas").style.opacity = cameras[index] ? find("opacity").value : 1;
    const ticks = cameras[index]?.photographs ?? [];
    find("ticks").replaceChildren(...ticks.map(({ time_s }) => new Option("", time_s)));
    viewer.camera = index;
    if (cameras[index]) goTo(photographs.nearest(avatar.time));
    viewer.changed = true;
  });
}

function connectJoints(viewer) {
  const { avatar, looks, axes } = viewer;
  const degrees = (value) => `${Math.round(value)}°`;
  const turned = () => avatar.turns.get(avatar.joints[find("joint").value]);
  const again = () => viewer.setTime(avatar.time);
  const sliders = ["x", "y", "z"].map((axis) =>
    slider(find("turns"), axis, [-120, 120, 1], degrees, (value) => {
      turned()[axis] = THREE.MathUtils.degToRad(value);
      again();
    }),
  );
  const choose = () => {
    const joint = avatar.joints[find("joint").value];
    ["x", "y", "z"].forEach((axis, i) => sliders[i](THREE.MathUtils.radToDeg(turned()[axis])));
    looks.colourByWeights(joint);
    joint.add(axes);
    again();
  };
  options(find("joint"), avatar.joints.map((joint) => joint.userData.name ?? joint.name)); // the loader drops dots
  find("joint").addEventListener("change", choose);
  find("straighten").addEventListener("click", () => {
    for (const turn of avatar.turns.values()) turn.set(0, 0, 0);
    choose();
  });
  find("joint").value = avatar.joints.indexOf(avatar.heaviest);
  choose();
}

function connectShapes(viewer) {
  const { avatar } = viewer;
  const again = () => viewer.setTime(avatar.time);
  const sliders = avatar.shapes.map((shape) => {
    const range = [shape.moves ? -1 : 0, 1, 0.01]; // a motion's own weights are from 0 to 1
    return slider(find("weights"), shape.name, range, (value) => value.toFixed(2), (value) => {
      shape.added = value;
      again();
    });
  });
  find("shapes").hidden = !sliders.length;
  find("unshape").addEventListener("click", () => {
    for (const shape of avatar.shapes) shape.added = 0;
    for (const set of sliders) set(0);
    again();
  });
}

function connectTheme(viewer) {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const show = (theme) => {
    document.documentElement.dataset.theme = theme;
    viewer.stage.drawGround();
    viewer.changed = true;
  };
  const ofSystem = () => show(dark.matches ? "dark" : "light");
  dark.addEventListener("change", ofSystem);
  find("theme").addEventListener("click", () => {
    show(document.documentElement.dataset.theme === "dark" ? "light" : "dark");
  });
  ofSystem();
}

function connectKeys(viewer) {
  const { avatar, stage } = viewer;
  const keys = {
    " ": () => viewer.play(!viewer.playing),
    ",": () => viewer.step(-1),
    ".": () => viewer.step(1),
    "[": () => viewer.besides(-1),
    "]": () => viewer.besides(1),
    c: () => viewer.choose.camera(((viewer.camera ?? 0) + 1) % (viewer.recording.cameras.length + 1)),
    r: () => {
      viewer.choose.camera(0);
      stage.frame({ ...viewer.bounds, ...avatar.present() });
    },
  };
  viewer.looks.names.forEach((_, index) => (keys[index + 1] = () => viewer.choose.look(index)));
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const { tagName, type } = event.target;
    if (tagName === "SELECT") return; // letters choose an option there
    if (event.key === " " && (["BUTTON", "SUMMARY"].includes(tagName) || type === "checkbox")) return; // presses it
    const turned = event.target === stage.canvas && stage.keyed(event.key);
    const key = event.key.toLowerCase(); // with Caps Lock, letters are capital
    if (!turned && !(key in keys)) return;
    if (!turned) keys[key]();
    viewer.changed = true;
    event.preventDefault();
  });
}

function connectSize(viewer) {
  new ResizeObserver(() => {
    viewer.stage.resize();
    viewer.changed = true;
  }).observe(viewer.stage.canvas);
  viewer.stage.resize();
}
