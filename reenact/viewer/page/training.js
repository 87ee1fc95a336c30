// A training that goes on while the page is open: how far it is, its losses, its newest picture; and word of newer networks.

import { json } from "./api.js";
import { make } from "./panel.js";

const EVERY = { training: 2000, stopped: 5000 }; // milliseconds between two looks; a finished run is looked at once
const EDGE = { left: 44, right: 12, top: 6, bottom: 20 };
const count = (number) => Math.round(number).toLocaleString("en");

export class Training {
  /** `parts` are elements by name. `newer(step)` is told of another checkpoint, and says whether its networks are shown. */
  constructor({ folder, checkpoint, chosen }, parts, style, newer) {
    Object.assign(this, { folder, chosen, parts, style, newer }); // chosen: newer networks than these are not wanted
    this.shown = checkpoint; // whose networks move the faces
    this.progress = null;
    this.unfolded = false; // once, when there is something to see
    this.newest = true; // the picture follows the training until the user chooses one
    parts.whole.hidden = false;
    parts.step.addEventListener("input", () => {
      this.newest = parts.step.value === parts.step.max;
      this.#picture();
    });
    parts.enlarge.addEventListener("click", () => parts.dialog.showModal());
    new ResizeObserver(() => this.draw()).observe(parts.losses);
    this.#look();
  }

  async #look() {
    let wait = EVERY.stopped;
    try {
      this.progress = await json("progress.json");
      const { state, checkpoint } = this.progress;
      wait = EVERY[state];
      this.#tell();
      const wanted = checkpoint !== null && checkpoint !== this.shown && !this.chosen;
      if (wanted && (await this.newer(checkpoint))) this.shown = checkpoint;
      if (state === "finished" && checkpoint !== this.shown && !this.chosen) wait = EVERY.stopped;
      this.#tell();
    } catch (error) {
      this.parts.text.textContent = `How far the training is cannot be read: ${error.message}`;
    }
    if (wait !== undefined) setTimeout(() => this.#look(), wait);
  }

  #tell() {
    const { parts, progress } = this;
    parts.text.textContent = words(progress, this.folder, this.shown);
    parts.bar.value = progress.done / progress.total;
    const { previews } = progress;
    if (progress.state === "training" && progress.done > 0 && !this.unfolded) this.unfolded = parts.whole.open = true;
    parts.figure.hidden = previews.length === 0;
    parts.step.max = Math.max(previews.length - 1, 0);
    if (this.newest) parts.step.value = parts.step.max;
    parts.step.disabled = previews.length < 2;
    this.#picture();
    this.draw();
  }

  #picture() {
    const { parts, progress: { previews } } = this;
    const step = previews[Number(parts.step.value)];
    if (step === undefined || parts.figure.dataset.step === String(step)) return;
    parts.figure.dataset.step = step;
    parts.at.textContent = `step ${count(step)}`;
    parts.step.setAttribute("aria-valuetext", parts.at.textContent);
    for (const picture of [parts.small, parts.large]) {
      picture.src = `preview/${step}`;
      picture.alt = `Expressions at step ${count(step)}: source, drawn on the target, and the target as it was read`;
    }
  }

  /** Losses over steps, logarithmic: their sum in the colour of the text, each kind in its own. */
  draw() {
    const { parts: { losses: canvas, names }, progress } = this;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!progress || width === 0) return;
    const style = this.style(), ratio = Math.min(devicePixelRatio, 2);
    const lines = Object.entries(progress.losses).map(([name, points], n) => ({
      name, points: points.filter(([, value]) => value > 0),
      color: name === "loss" ? style.ink : style.curves[(n - 1) % style.curves.length], thick: name === "loss",
    })).filter(({ points }) => points.length > 0);
    names.replaceChildren(...lines.map(({ name, points, color, thick }) => {
      const entry = make("li"), line = make("i", { className: thick ? "" : "thin" });
      line.style.setProperty("--color", color);
      entry.append(line, `${name === "loss" ? "sum" : name} ${points.at(-1)[1].toPrecision(2)}`);
      return entry;
    }));
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    pen.font = style.font;
    pen.fillStyle = style.soft;
    pen.strokeStyle = style.line;
    pen.textBaseline = "middle";
    const values = lines.flatMap(({ points }) => points.map(([, value]) => value));
    if (values.length === 0) return pen.fillText("The first losses come with step 20", EDGE.left, height / 2);
    const low = Math.log10(Math.min(...values)), high = Math.max(Math.log10(Math.max(...values)), low + 0.3);
    const x = (step) => EDGE.left + (step / progress.total) * (width - EDGE.left - EDGE.right);
    const y = (value) => EDGE.top + ((high - Math.log10(value)) / (high - low)) * (height - EDGE.top - EDGE.bottom);
    pen.textAlign = "right";
    for (let power = Math.floor(low); power <= high; power++) {
      for (const digit of height > 80 * (high - low) ? [1, 2, 5] : [1]) {
        const value = digit * 10 ** power, row = Math.round(y(value)) + 0.5;
        if (row < EDGE.top || row > height - EDGE.bottom) continue;
        pen.beginPath();
        pen.moveTo(EDGE.left, row);
        pen.lineTo(width - EDGE.right, row);
        pen.stroke();
        pen.fillText(String(Number(value.toPrecision(1))), EDGE.left - 6, row);
      }
    }
    pen.textAlign = "left";
    pen.fillText("step 0", EDGE.left, height - 8);
    pen.textAlign = "right";
    pen.fillText(count(progress.total), width - EDGE.right, height - 8);
    pen.lineJoin = "round";
    for (const { points, color, thick } of lines.toReversed()) { // the sum on top
      pen.strokeStyle = color;
      pen.lineWidth = thick ? 2 : 1.2;
      pen.beginPath();
      for (const [step, value] of points) pen.lineTo(x(step), y(value));
      if (points.length === 1) pen.lineTo(x(points[0][0]) + 2, y(points[0][1]));
      pen.stroke();
    }
  }
}

function words({ state, stage, step, steps, done, total, steps_per_second, seconds_left, next_checkpoint }, folder, shown) {
  const faces = shown === null ? "" : `faces by step ${count(shown)}`;
  if (state === "finished") return joined(`Trained, ${count(total)} steps`, faces);
  if (state === "stopped") {
    return joined(`Training stopped at step ${count(done)} of ${count(total)}`, faces, `reenact train --run ${folder} --resume goes on`);
  }
  if (done === 0) return joined("Training", "preparing the first pictures");
  return joined(
    `Training ${stage}`,
    `step ${count(step)} of ${count(steps)}`,
    `${steps_per_second?.toPrecision(2) ?? "?"} steps/s`,
    seconds_left === null ? "" : `${duration(seconds_left)} left`,
    faces || `first faces at step ${count(next_checkpoint)}`,
  );
}

const joined = (...parts) => parts.filter(Boolean).join(" · ");

function duration(seconds) {
  if (seconds < 90) return `${Math.ceil(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}
