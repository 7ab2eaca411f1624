// What the page's controls do: they choose a frame, and the cell and the plots show it.
"use strict";

const shown = JSON.parse(document.getElementById("content").textContent);
const part = (id) => document.getElementById(id);
const last = shown.times.length - 1;
const FRAMES_PER_SECOND = 50;  // of the record, at speed 1
let frame = 0, playing = false, reached = 0, before = 0, cell = null;

const plots = new Plots(part("curves"), shown, show);
try {
  cell = new CellView(part("view"), shown, drawScale);
} catch (error) {
  part("no-view").hidden = false;
  console.warn(String(error));
}

function show(next) {
  frame = Math.min(Math.max(next, 0), last);
  reached = frame;
  const time = `${shown.times[frame].toFixed(2)} ms`;
  part("slider").value = frame;
  part("slider").setAttribute("aria-valuetext", time);
  part("time").textContent = time;
  plots.show(frame);
  if (cell) cell.show(frame);
}

function play(on) {
  playing = on && last > 0;
  part("play").textContent = playing ? "Pause" : "Play";
  part("play").setAttribute("aria-pressed", playing);
  if (!playing) return;
  if (frame === last) show(0);
  before = performance.now();
  requestAnimationFrame(advance);
}

function advance(now) {
  if (!playing) return;
  const speed = (FRAMES_PER_SECOND / shown.frameStride) * Number(part("speed").value);
  reached += speed * Math.min(Math.max(now - before, 0), 250) / 1000;
  before = now;
  const next = Math.floor(reached);
  if (next > last) {
    show(0);
  } else if (next !== frame) {
    const share = reached - next;
    show(next);
    reached += share;
  }
  requestAnimationFrame(advance);
}

/** A bar of 1, 2 or 5 um or powers of ten of them, about an eighth of the picture wide. */
function drawScale(pixels) {
  const wanted = part("view").parentElement.clientWidth / 8 / pixels;
  const power = 10 ** Math.floor(Math.log10(wanted));
  const length = [1, 2, 5, 10].map((base) => base * power).reduce((a, b) =>
    Math.abs(Math.log(b / wanted)) < Math.abs(Math.log(a / wanted)) ? b : a);
  part("scale-bar").style.width = `${length * pixels}px`;
  part("scale-label").textContent = `${short(length)} µm`;
}

function chooseColor(name) {
  const coloring = shown.colorings[name];
  part("color-label").textContent = coloring && !coloring.names ? coloring.label : "";
  const scaled = coloring && !coloring.names;
  part("color-bar").hidden = !scaled;
  part("color-bar").style.display = scaled ? "" : "none";
  if (coloring && coloring.names) {
    coloring.names.forEach((name, i) => {
      const row = document.createElement("span"), patch = document.createElement("i");
      patch.style.background = coloring.colors[i];
      row.className = "form";
      row.append(patch, name);
      part("color-label").append(row);
    });
  }
  if (scaled) {
    part("color-map").style.background = `linear-gradient(to right, ${shown.map.filter((_, i) => i % 16 === 0).join(",")})`;
    part("color-highest").textContent = short(Number(coloring.highest.toPrecision(2)));
  }
  if (cell) cell.setColor(name);
}

function describe() {
  part("name").textContent = shown.name;
  const flagella = shown.firstNode.length - 1;
  const interval = last > 0 ? (shown.times[last] - shown.times[0]) / last / shown.frameStride : 0;
  const slowed = interval > 0 ? `, at speed 1x slowed ${short(Number((1000 / FRAMES_PER_SECOND / interval).toPrecision(3)))} times` : "";
  const stride = shown.frameStride > 1 ? `; one frame of ${shown.frameStride}` : "";
  part("about").textContent = `${flagella} ${flagella > 1 ? "flagella" : "flagellum"}, ${short(shown.times[last])} ms${slowed}${stride}`;
  part("scene").textContent = shown.scene;
  const thicker = shown.displayRadius / shown.radius;
  part("thickness").textContent = thicker > 1.05 ? `flagella drawn ${short(Number(thicker.toPrecision(2)))}x thicker` : "";
  part("slider").max = last;
  for (const name of ["flagellum", ...Object.keys(shown.colorings)]) {
    part("color").add(new Option(name.replace("_", " "), name, false, name === shown.colorBy));
  }
  part("follow").checked = shown.follow;
}

part("play").addEventListener("click", () => play(!playing));
part("slider").addEventListener("input", () => { play(false); show(Number(part("slider").value)); });
part("color").addEventListener("change", () => chooseColor(part("color").value));
part("follow").addEventListener("change", () => cell && cell.follow(part("follow").checked));
part("reset").addEventListener("click", () => cell && cell.reset());

part("view").addEventListener("keydown", (event) => {
  const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1], "+": [0, 0, 0.9], "-": [0, 0, 1 / 0.9] };
  if (!(event.key in turns) || !cell) return;
  cell.turn(...turns[event.key]);
  event.preventDefault();
  event.stopPropagation();
});
document.addEventListener("keydown", (event) => {
  const own = event.target.closest("input, select, button, summary");
  if (event.ctrlKey || event.metaKey || event.altKey || (own && !(own.type === "range" && event.key === " "))) return;
  const keys = {
    " ": () => play(!playing),
    ArrowLeft: () => { play(false); show(frame - 1); },
    ArrowRight: () => { play(false); show(frame + 1); },
    Home: () => show(0),
    End: () => show(last),
    f: () => part("follow").click(),
    r: () => part("reset").click(),
  };
  const action = keys[event.key.length > 1 ? event.key : event.key.toLowerCase()];
  if (!action) return;
  event.preventDefault();
  action();
});

describe();
chooseColor(shown.colorBy);
show(0);
