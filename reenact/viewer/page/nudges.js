// Nudges: what the user corrected, spread over the frames around it, with undo. reenact/nudges.py does the same to
// whole clips and says what is kept.

export class Nudges {
  /** `items`: {rig, frame, radius, method, shapes: Map of shape to value, weights, sourceWeights}. */
  constructor(items = []) {
    this.items = items;
    this.past = [];
    this.future = [];
    this.byShape = null;
  }

  at(rig, frame) {
    return this.items.find((item) => item.rig === rig && item.frame === frame);
  }

  of(rig) {
    return this.items.filter((item) => item.rig === rig).sort((a, b) => a.frame - b.frame);
  }

  /** Remembers how things stand, before a change that undo should take back. */
  begin() {
    this.past.push(copied(this.items));
    this.future = [];
  }

  set(rig, frame, shape, value, radius, method) {
    let item = this.at(rig, frame);
    if (!item) this.items.push((item = { rig, frame, radius, method, shapes: new Map() }));
    item.shapes.set(shape, value);
    item.method = method;
    this.byShape = null;
  }

  setRadius(item, radius) {
    item.radius = radius;
    this.byShape = null;
  }

  /** Takes one shape out of a frame's nudge, or the whole nudge. */
  remove(rig, frame, shape = null) {
    const item = this.at(rig, frame);
    if (!item) return;
    if (shape === null) item.shapes.clear();
    else item.shapes.delete(shape);
    if (item.shapes.size === 0) this.items = this.items.filter((other) => other !== item);
    this.byShape = null;
  }

  undo() {
    return this.#step(this.past, this.future);
  }

  redo() {
    return this.#step(this.future, this.past);
  }

  #step(from, to) {
    if (from.length === 0) return false;
    to.push(this.items);
    this.items = from.pop();
    this.byShape = null;
    return true;
  }

  /** Nudges of one shape in the order of their frames, each with how far it reaches to either side. */
  points(rig, shape) {
    if (this.byShape === null) this.byShape = this.#indexed();
    return this.byShape.get(`${rig} ${shape}`);
  }

  shapes(rig) {
    if (this.byShape === null) this.byShape = this.#indexed();
    return this.byShape.get(`${rig}`) ?? [];
  }

  #indexed() {
    const index = new Map();
    for (const item of this.items) {
      for (const [shape, value] of item.shapes) {
        const key = `${item.rig} ${shape}`;
        if (!index.has(key)) {
          index.set(key, []);
          index.set(`${item.rig}`, [...(index.get(`${item.rig}`) ?? []), shape]);
        }
        index.get(key).push({ frame: item.frame, value, radius: item.radius });
      }
    }
    for (const [key, points] of index) {
      if (!key.includes(" ")) continue;
      points.sort((a, b) => a.frame - b.frame);
      points.forEach((point, n) => {
        point.before = Math.min(point.radius, n > 0 ? point.frame - points[n - 1].frame : Infinity);
        point.after = Math.min(point.radius, n + 1 < points.length ? points[n + 1].frame - point.frame : Infinity);
      });
    }
    return index;
  }

  /** The value of a shape at a frame; `base(frame)` is what the method made of it. */
  value(rig, shape, frame, base) {
    const here = base(frame);
    let total = here;
    for (const point of this.points(rig, shape) ?? []) {
      const share = Math.abs(frame - point.frame) / (frame < point.frame ? point.before : point.after);
      if (share < 1) total += ((point.value - base(point.frame)) * (1 + Math.cos(Math.PI * share))) / 2;
    }
    return Math.min(Math.max(total, Math.min(here, 0)), Math.max(here, 1));
  }

  /** First and last frame that the nudges of a rig reach; null without any. */
  span(rig, last) {
    const items = this.of(rig);
    if (items.length === 0) return null;
    return [
      Math.max(0, Math.min(...items.map((item) => item.frame - item.radius))),
      Math.min(last, Math.max(...items.map((item) => item.frame + item.radius))),
    ];
  }
}

function copied(items) {
  return items.map((item) => ({ ...item, shapes: new Map(item.shapes) }));
}
