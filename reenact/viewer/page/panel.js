// The side panel: a slider for every shape of the rig that is being edited.

export class Panel {
  /** `moved(shape, value, done)` is told of every slider; `taken(shape)` of a Delete; `curve(shape)` of a curve's button. */
  constructor(list, { moved, taken, curve }) {
    this.list = list;
    this.handlers = { moved, taken, curve };
    this.rows = [];
    this.shownAt = 0;
    this.visible = new Set();
    this.watcher = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) {
        if (isIntersecting) this.visible.add(target.row);
        else this.visible.delete(target.row);
      }
    }, { root: list, rootMargin: "60px" });
  }

  /** Fills the list with the shapes of a rig. */
  fill(names) {
    const { moved, taken, curve } = this.handlers;
    this.watcher.disconnect();
    this.visible.clear();
    this.list.replaceChildren();
    this.rows = names.map((name, shape) => {
      const element = make("div", { className: "shape" });
      const button = make("button", { type: "button", title: "Curve" });
      button.setAttribute("aria-label", `Curve of ${name}`);
      button.append(make("i"));
      button.addEventListener("click", () => curve(shape));
      const slider = make("input", { type: "range", min: 0, max: 1, step: 0.01, value: 0, id: `shape-${shape}` });
      const label = make("label", { htmlFor: slider.id, textContent: name, title: name });
      const output = make("output", { htmlFor: slider.id, textContent: "0.00" });
      slider.addEventListener("input", () => moved(shape, Number(slider.value), false));
      slider.addEventListener("change", () => moved(shape, Number(slider.value), true));
      slider.addEventListener("keydown", (event) => {
        if (event.key !== "Delete" && event.key !== "Backspace") return;
        event.preventDefault();
        taken(shape);
      });
      element.append(button, label, slider, output);
      const row = { shape, name, element, button, slider, output, value: null, nudged: false };
      element.row = row;
      this.watcher.observe(element);
      return row;
    });
    this.nothing = make("p", { className: "none", textContent: "No shape has this in its name", hidden: true });
    this.list.append(...this.rows.map((row) => row.element), this.nothing);
  }

  /** Only shapes with these words in their names, and of `moving` where that is given. */
  filter(text, moving) {
    const words = text.toLowerCase().split(/\s+/).filter(Boolean);
    let left = 0;
    for (const row of this.rows) {
      const name = row.name.toLowerCase();
      row.element.hidden = !words.every((word) => name.includes(word)) || (moving !== null && !moving[row.shape]);
      left += !row.element.hidden;
    }
    this.nothing.hidden = left > 0;
  }

  /** Puts the sliders where the weights are. While the clip plays, those in view and ten times a second. */
  show(weights, nudged, playing) {
    const now = performance.now();
    if (playing && now - this.shownAt < 100) return;
    this.shownAt = now;
    for (const row of playing ? this.visible : this.rows) {
      const value = weights[row.shape];
      if (row.value !== value) {
        row.value = value;
        if (value > Number(row.slider.max)) row.slider.max = Math.ceil(value * 10) / 10;
        if (value < Number(row.slider.min)) row.slider.min = Math.floor(value * 10) / 10;
        row.slider.value = value;
        row.output.textContent = value.toFixed(2);
      }
      const here = nudged?.has(row.shape) ?? false;
      if (row.nudged !== here) {
        row.nudged = here;
        row.element.classList.toggle("nudged", here);
      }
    }
  }

  /** Marks the shapes whose curves are drawn, in their colours. */
  mark(colors) {
    for (const row of this.rows) {
      const color = colors.get(row.shape);
      row.button.setAttribute("aria-pressed", String(color !== undefined));
      row.button.style.setProperty("--color", color ?? "transparent");
    }
  }
}

/** A new element with these properties. */
export function make(tag, properties = {}) {
  return Object.assign(document.createElement(tag), properties);
}
