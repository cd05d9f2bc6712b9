// The recording behind the avatar: which photograph is nearest to an instant, and where the next one is.

const SAME_INSTANT = 0.5; // frames between the avatar and the photograph

export class Photographs {
  constructor(image, caption, fps) {
    this.image = image;
    this.caption = caption;
    this.fps = fps;
    this.camera = null;
  }

  // Shows the photographs of a camera; null shows none.
  setCamera(camera) {
    this.camera = camera;
    this.image.hidden = !camera;
    this.shown = null;
  }

  nearest(time) {
    const off = (photograph) => Math.abs(photograph.time_s - time);
    return this.camera.photographs.reduce((best, other) => (off(other) < off(best) ? other : best));
  }

  // Returns the photograph before (-1) or after (1) an instant, round the end.
  beside(time, direction) {
    const sorted = direction > 0 ? this.camera.photographs : this.camera.photographs.toReversed();
    return sorted.find((photograph) => direction * (photograph.time_s - time) * this.fps > 0.1) ?? sorted[0];
  }

  // Shows the photograph nearest to an instant, pale if it is of another instant or if the motion is not the recorded
  // one.
  show(time, isRecorded) {
    if (!this.camera) return;
    const photograph = this.nearest(time);
    const same = isRecorded && Math.abs(photograph.time_s - time) * this.fps < SAME_INSTANT;
    if (this.shown !== photograph) this.image.src = photograph.jpeg;
    this.shown = photograph;
    this.image.classList.toggle("pale", !same);
    const text = `Photograph of frame ${photograph.frame}${same ? "" : ", not the avatar's current time"}`;
    if (this.caption.textContent !== text) this.caption.textContent = text;
  }
}
