// Weight curves: the clip's length across, weights 0 to 1 up; a click goes to that frame, a wheel looks closer.

const EDGE = { left: 34, right: 12, top: 10, bottom: 20 };

export class Curves {
  /** `go(frame)` is called where the user points; `looked()` when the part in view changes. */
  constructor(canvas, playhead, frames, fps, go, looked) {
    Object.assign(this, { canvas, playhead, frames, fps, go, looked });
    this.from = 0;
    this.to = Math.max(frames - 1, 1);
    this.lines = [];
    this.marks = [];
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      this.#point(event);
    });
    canvas.addEventListener("pointermove", (event) => {
      if (canvas.hasPointerCapture(event.pointerId)) this.#point(event);
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      if (Math.abs(event.deltaX) > Math.abs(event.deltaY)) this.#move(((this.to - this.from) * event.deltaX) / 800);
      else this.zoom(Math.exp(event.deltaY / 400), this.#frameAt(event));
    }, { passive: false });
  }

  get zoomed() {
    return this.to - this.from < this.frames - 1.5;
  }

  /** Shows `factor` times as many frames, with `frame` where it is. */
  zoom(factor, frame) {
    const whole = Math.max(this.frames - 1, 1);
    const length = Math.min(Math.max((this.to - this.from) * factor, Math.min(12, whole)), whole);
    const share = (frame - this.from) / (this.to - this.from);
    this.from = Math.min(Math.max(frame - share * length, 0), whole - length);
    this.to = this.from + length;
    this.looked();
  }

  fit() {
    this.from = 0;
    this.to = Math.max(this.frames - 1, 1);
    this.looked();
  }

  /** Turns the page when the frame leaves what is shown. */
  follow(frame) {
    if (frame >= this.from && frame <= this.to) return;
    this.#move(frame - this.from - 0.1 * (this.to - this.from));
  }

  #move(by) {
    const length = this.to - this.from;
    this.from = Math.min(Math.max(this.from + by, 0), Math.max(this.frames - 1, 1) - length);
    this.to = this.from + length;
    this.looked();
  }

  #frameAt(event) {
    const width = this.canvas.clientWidth - EDGE.left - EDGE.right;
    return this.from + ((event.offsetX - EDGE.left) / width) * (this.to - this.from);
  }

  #point(event) {
    this.go(Math.min(Math.max(Math.round(this.#frameAt(event)), 0), this.frames - 1));
  }

  /** Draws `lines` ({values, color, dash, width}, values per frame) and `marks` (frames). */
  draw(lines, marks, style) {
    const { canvas } = this;
    const ratio = Math.min(devicePixelRatio, 2);
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (width === 0) return;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext("2d");
    pen.scale(ratio, ratio);
    const inner = { width: width - EDGE.left - EDGE.right, height: height - EDGE.top - EDGE.bottom };
    const x = (frame) => EDGE.left + ((frame - this.from) / (this.to - this.from)) * inner.width;
    let low = 0, high = 1;
    for (const { values } of lines) for (const value of values) { if (value < low) low = value; if (value > high) high = value; }
    const y = (value) => EDGE.top + (1 - (value - low) / (high - low)) * inner.height;
    pen.font = style.font;
    pen.fillStyle = style.soft;
    pen.strokeStyle = style.line;
    pen.lineWidth = 1;
    pen.textBaseline = "middle";
    pen.textAlign = "right";
    for (const value of [0, 0.5, 1]) {
      const row = Math.round(y(value)) + 0.5;
      pen.beginPath();
      pen.moveTo(EDGE.left, row);
      pen.lineTo(width - EDGE.right, row);
      pen.stroke();
      pen.fillText(value === 0.5 ? ".5" : String(value), EDGE.left - 8, row);
    }
    pen.textAlign = "center";
    const step = tick((this.to - this.from) / this.fps, Math.max(2, Math.floor(inner.width / 90)));
    for (let time = Math.ceil(this.from / this.fps / step) * step; time * this.fps <= this.to + 1e-6; time += step) {
      const column = x(time * this.fps);
      pen.beginPath();
      pen.moveTo(Math.round(column) + 0.5, height - EDGE.bottom);
      pen.lineTo(Math.round(column) + 0.5, height - EDGE.bottom + 4);
      pen.stroke();
      const text = seconds(time, step);
      if (column + pen.measureText(text).width / 2 < width) pen.fillText(text, column, height - EDGE.bottom + 12);
    }
    pen.save();
    pen.beginPath();
    pen.rect(EDGE.left, 0, inner.width, height - EDGE.bottom + 2);
    pen.clip();
    pen.lineJoin = "round";
    for (const line of lines) this.#line(pen, line, x, y, inner.width);
    pen.fillStyle = style.accent;
    for (const frame of marks) {
      const column = x(frame);
      pen.beginPath();
      pen.moveTo(column, 0);
      pen.lineTo(column + 4.5, 4.5);
      pen.lineTo(column, 9);
      pen.lineTo(column - 4.5, 4.5);
      pen.fill();
    }
    pen.restore();
  }

  #line(pen, { values, color, dash = [], width = 1.6 }, x, y, pixels) {
    pen.strokeStyle = color;
    pen.setLineDash(dash);
    pen.lineWidth = width;
    pen.beginPath();
    const first = Math.max(0, Math.floor(this.from)), last = Math.min(values.length - 1, Math.ceil(this.to));
    const perPixel = (last - first) / pixels;
    if (perPixel <= 2) {
      for (let frame = first; frame <= last; frame++) pen.lineTo(x(frame), y(values[frame]));
    } else {
      // More frames than pixels: from the lowest to the highest of each column, so that no blink is lost.
      pen.globalAlpha = 0.7;
      for (let frame = first; frame <= last; frame += perPixel) {
        let least = Infinity, most = -Infinity;
        for (let n = Math.floor(frame); n < Math.min(frame + perPixel, last + 1); n++) {
          if (values[n] < least) least = values[n];
          if (values[n] > most) most = values[n];
        }
        pen.lineTo(x(frame), y(least));
        pen.lineTo(x(frame), y(most));
      }
    }
    pen.stroke();
    pen.globalAlpha = 1;
    pen.setLineDash([]);
  }

  /** Puts the line that marks the frame shown there. */
  mark(frame) {
    const width = this.canvas.clientWidth - EDGE.left - EDGE.right;
    const share = (frame - this.from) / (this.to - this.from);
    this.playhead.hidden = share < 0 || share > 1;
    this.playhead.style.transform = `translateX(${EDGE.left + share * width}px)`;
  }
}

function tick(length, count) {
  return [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1800].find((step) => length / step <= count) ?? 3600;
}

function seconds(time, step) {
  if (step < 1) return `${time.toFixed(1)} s`;
  if (time < 60) return `${Math.round(time)} s`;
  return `${Math.floor(time / 60)}:${String(Math.round(time % 60)).padStart(2, "0")}`;
}
