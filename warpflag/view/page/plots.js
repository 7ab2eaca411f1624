// The observables over time, each in a plot of its own, with a cursor at the frame that is shown.
"use strict";

const WIDTH = 1000, HEIGHT = 100, LINE_COLOR = "#0072b2";

/** A number to three digits without the zeros at its end. */
function short(value) {
  return value === null || value === undefined ? "–" : String(Number(value.toPrecision(3)));
}

/** Words with symbols as letters in italics with their index. */
function symbols(text) {
  const escaped = text.replace(/[&<>]/g, (letter) => ({ "&": "&amp;", "<": "&lt;", ">": "&gt;" })[letter]);
  return escaped.replace(/\b(\w)_(\w)\b/g, "<i>$1</i><sub>$2</sub>").replace(/ v(?= \(|$)/, " <i>v</i>");
}

class Plots {
  /** Adds a plot per curve to `parent`; `onPicked(frame)` is told where it is clicked or dragged. */
  constructor(parent, shown, onPicked) {
    this.times = shown.times;
    this.plots = shown.curves.map((curve) => this.add(parent, curve, shown.flagellumColors, onPicked));
    if (this.plots.length) {
      const axis = document.createElement("div");
      axis.className = "axis";
      axis.innerHTML = `<span>${short(this.times[0])}</span><span>${short(this.times.at(-1))} ms</span>`;
      this.plots.at(-1).figure.append(axis);
    }
  }

  place(frame) {
    const span = this.times.at(-1) - this.times[0];
    return span > 0 ? (this.times[frame] - this.times[0]) / span : 0;
  }

  add(parent, curve, colors, onPicked) {
    const values = curve.lines.flat().filter((value) => value !== null);
    const low = Math.min(0, ...extremes(values)), high = Math.max(low + 1e-12, 0, ...extremes(values));
    const paths = curve.lines.map((line, k) => {
      const color = curve.lines.length > 1 ? colors[k % colors.length] : LINE_COLOR;
      return `<path stroke="${color}" d="${this.path(line, low, high)}"></path>`;
    });
    const figure = document.createElement("div");
    figure.className = "curve";
    figure.innerHTML = `<h2><span>${symbols(curve.label)}</span><output></output></h2>
      <div class="ticks"><span>${short(high)}</span><span>${short(low)}</span></div>
      <div class="plot"><svg viewBox="0 0 ${WIDTH} ${HEIGHT}" preserveAspectRatio="none" aria-hidden="true">${paths.join("")}</svg>
      <div class="cursor"></div></div>`;
    parent.append(figure);
    const plot = figure.querySelector(".plot");
    const pick = (event) => {
      if (event.type === "pointermove" && !event.buttons) return;
      const box = plot.getBoundingClientRect();
      onPicked(this.nearest((event.clientX - box.left) / box.width));
    };
    plot.addEventListener("pointerdown", (event) => { plot.setPointerCapture(event.pointerId); pick(event); });
    plot.addEventListener("pointermove", pick);
    return { figure, curve, cursor: figure.querySelector(".cursor"), value: figure.querySelector("output") };
  }

  /** A line in units of the plot, broken where a frame has no value. */
  path(line, low, high) {
    let text = "", pen = "M";
    line.forEach((value, frame) => {
      if (value === null) { pen = "M"; return; }
      const y = HEIGHT - 4 - (HEIGHT - 8) * (value - low) / (high - low);
      text += `${pen}${(WIDTH * this.place(frame)).toFixed(1)} ${y.toFixed(1)}`;
      pen = "L";
    });
    return text;
  }

  nearest(share) {
    let best = 0;
    for (let f = 1; f < this.times.length; f++) {
      if (Math.abs(this.place(f) - share) < Math.abs(this.place(best) - share)) best = f;
    }
    return best;
  }

  show(frame) {
    for (const { curve, cursor, value } of this.plots) {
      cursor.style.left = `${100 * this.place(frame)}%`;
      value.textContent = curve.lines.slice(0, 4).map((line) => short(line[frame])).join(", ") + (curve.lines.length > 4 ? ", …" : "");
    }
  }
}

function extremes(values) {
  return values.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)], [Infinity, -Infinity]);
}
