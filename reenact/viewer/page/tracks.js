// Tracks: weights of one rig by one method over the whole clip, and the corrections on top of them.

import { floats, post } from "./api.js";

/** The weights that a method gives a rig, as they arrive from the server. */
export class Track {
  constructor(rig, method, frames, shapes) {
    Object.assign(this, { rig, method, frames, shapes });
    this.weights = new Float32Array(frames * shapes);
    this.ready = 0; // frames that have arrived
    this.failed = null; // why not
  }

  get whole() {
    return this.ready === this.frames;
  }

  async load(arrived) {
    try {
      const path = `track/${this.rig}/${encodeURIComponent(this.method)}`;
      await floats(path, this.weights, (count) => {
        this.ready = Math.floor(count / this.shapes);
        arrived();
      });
    } catch (error) {
      this.failed = error.message;
    }
    arrived();
  }

  row(frame) {
    return this.weights.subarray(frame * this.shapes, (frame + 1) * this.shapes);
  }

  /** What is shown at a frame: the method's weights and the nudges, written to `out`. */
  shown(frame, nudges, out) {
    out.set(this.row(frame));
    for (const shape of nudges.shapes(this.rig)) out[shape] = this.value(frame, shape, nudges);
    return out;
  }

  value(frame, shape, nudges) {
    return nudges.value(this.rig, shape, frame, (each) => this.weights[each * this.shapes + shape]);
  }

  /** One shape over time, with or without the nudges. */
  column(shape, nudges = null) {
    const { weights, shapes, frames, rig } = this;
    const values = new Float32Array(frames);
    for (let frame = 0; frame < frames; frame++) values[frame] = weights[frame * shapes + shape];
    for (const point of nudges?.points(rig, shape) ?? []) {
      const first = Math.max(0, point.frame - point.before), last = Math.min(frames - 1, point.frame + point.after);
      for (let frame = first; frame <= last; frame++) values[frame] = this.value(frame, shape, nudges);
    }
    return values;
  }

  /** All frames with the nudges on them. */
  all(nudges) {
    const weights = this.weights.slice();
    const span = nudges.span(this.rig, this.frames - 1);
    if (span === null) return weights;
    for (let frame = span[0]; frame <= span[1]; frame++) {
      this.shown(frame, nudges, weights.subarray(frame * this.shapes, (frame + 1) * this.shapes));
    }
    return weights;
  }
}

const SHORT = 1500; // frames; a clip up to this long is retargeted as a whole, as some methods look at all of it
const MARGIN = 30; // frames around a change that a longer one is retargeted with

/** Keeps the targets with a source that is being corrected: the changed frames go to the server, and come back moved. */
export class Follower {
  constructor(source, nudges, changed, failed) {
    Object.assign(this, { source, nudges, changed, failed });
    this.waiting = new Map();
    this.busy = false;
  }

  /** Retargets frames `from` to `to`; `quick` takes them as they are, without what lies around them. */
  follow(track, from, to, quick = false) {
    if (track.method === "file" || track === this.source) return;
    const known = this.waiting.get(track);
    const wider = known && !(known.quick && quick);
    this.waiting.set(track, wider
      ? { from: Math.min(from, known.from), to: Math.max(to, known.to), quick: quick && known.quick }
      : { from, to, quick });
    if (!this.busy) this.#run();
  }

  async #run() {
    this.busy = true;
    while (this.waiting.size > 0) {
      const [track, { from, to, quick }] = this.waiting.entries().next().value;
      this.waiting.delete(track);
      try {
        await this.#retarget(track, from, to, quick);
        this.changed();
      } catch (error) {
        this.failed(error.message);
      }
    }
    this.busy = false;
  }

  async #retarget(track, from, to, quick) {
    const { source, nudges } = this;
    const last = source.frames - 1;
    let first = from, end = to;
    if (!quick) [first, end] = source.frames <= SHORT ? [0, last] : [Math.max(0, from - MARGIN), Math.min(last, to + MARGIN)];
    const rows = new Float32Array((end - first + 1) * source.shapes);
    for (let frame = first; frame <= end; frame++) {
      source.shown(frame, nudges, rows.subarray((frame - first) * source.shapes, (frame - first + 1) * source.shapes));
    }
    const answer = await post(`retarget/${track.rig}/${encodeURIComponent(track.method)}`, rows);
    const moved = new Float32Array(await answer.arrayBuffer());
    const whole = !quick && source.frames <= SHORT;
    const [start, stop] = whole ? [0, last] : [from, to];
    track.weights.set(moved.subarray((start - first) * track.shapes, (stop - first + 1) * track.shapes), start * track.shapes);
  }
}
