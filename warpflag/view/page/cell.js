// The cell in 3-D: body, motors and flagella of one frame at a time, seen by a camera that can be turned and can follow.
"use strict";

const SIDES = 8;  // of a tube
const FIELD_OF_VIEW = 30;  // degrees, up and down
const CAP = [[0, 1], [0.7, 0.7]];  // radius and length of a round end's rings, in radii of the tube

/** Numbers of a typed array that was sent as base64. */
function unpacked(text, Kind) {
  return new Kind(Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer);
}

function vector(values, at = 0) {
  return new THREE.Vector3(values[3 * at], values[3 * at + 1], values[3 * at + 2]);
}

class CellView {
  /** Draws what `shown` holds into a canvas; `onDrawn(pixelsPerMicrometre)` is told of every picture. */
  constructor(canvas, shown, onDrawn) {
    this.canvas = canvas;
    this.shown = shown;
    this.onDrawn = onDrawn;
    this.frame = 0;
    this.following = shown.follow;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.1, 1000);
    this.nodes = unpacked(shown.positions.values, Uint16Array);
    this.centres = unpacked(shown.body.positions, Float32Array);
    this.orientations = unpacked(shown.body.orientations, Float32Array);
    this.angles = unpacked(shown.motors.angles, Float32Array);
    this.path = unpacked(shown.path, Float32Array);
    this.nodeCount = shown.firstNode[shown.firstNode.length - 1];
    this.pieces = this.nodeCount > 2000 ? 1 : 3;  // rings per segment
    this.addLights();
    this.addBody();
    this.tubes = shown.firstNode.slice(1).map((end, k) => this.addTube(shown.firstNode[k], end));
    const axes = shown.view.axes;
    [this.right, this.up, this.back] = axes.map((row) => vector(row));
    this.camera.up.copy(this.up);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.ask());
    this.controls.addEventListener("start", () => { this.untouched = false; });
    this.setColor(shown.colorBy);
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.reset();
    this.resize();
  }

  addLights() {
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0xb9c4d0, 1.6));
    const light = new THREE.DirectionalLight(0xffffff, 2.2);
    light.position.set(-0.6, 0.8, 1);  // over the camera's left shoulder
    this.camera.add(light);
    this.scene.add(this.camera);
  }

  addBody() {
    const { length, width, color } = this.shown.body;
    this.body = new THREE.Group();
    const capsule = new THREE.CapsuleGeometry(width / 2, length - width, 16, 40).rotateX(Math.PI / 2);
    this.body.add(new THREE.Mesh(capsule, new THREE.MeshStandardMaterial({ color, roughness: 0.6 })));
    const motors = this.shown.motors;
    this.motors = motors.anchors.map((anchor, k) => {
      const motor = new THREE.Group();
      const axes = motors.tripods[k].map((row) => vector(row));
      motor.matrix.makeBasis(...axes).setPosition(vector(anchor));
      motor.matrixAutoUpdate = false;
      const turned = new THREE.Group();
      motors.lengths.forEach((spoke, axis) => turned.add(this.spoke(spoke, axis, motors)));
      motor.add(turned);
      this.body.add(motor);
      return turned;
    });
    this.scene.add(this.body);
  }

  /** A rod from the motor along one of its axes. */
  spoke(length, axis, { width, colors }) {
    const rod = new THREE.CylinderGeometry(width / 2, width / 2, length, 12).translate(0, length / 2, 0);
    if (axis === 0) rod.rotateZ(-Math.PI / 2);
    if (axis === 2) rod.rotateX(Math.PI / 2);
    return new THREE.Mesh(rod, new THREE.MeshStandardMaterial({ color: colors[axis], roughness: 0.4 }));
  }

  /** The tube of the flagellum with nodes `first` to `end` - 1: rings of vertices, filled in frame by frame. */
  addTube(first, end) {
    const rings = (end - first - 1) * this.pieces + 1 + 2 * CAP.length;
    const geometry = new THREE.BufferGeometry();
    for (const name of ["position", "normal", "color"]) {
      geometry.setAttribute(name, new THREE.BufferAttribute(new Float32Array(3 * SIDES * rings), 3));
    }
    const triangles = [];
    for (let ring = 0; ring + 1 < rings; ring++) {
      for (let side = 0; side < SIDES; side++) {
        const a = ring * SIDES + side, b = ring * SIDES + ((side + 1) % SIDES);
        triangles.push(a, b, a + SIDES, b, b + SIDES, a + SIDES);
      }
    }
    geometry.setIndex(triangles);
    const material = new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.4 });
    const mesh = new THREE.Mesh(geometry, material);
    mesh.frustumCulled = false;
    this.scene.add(mesh);
    return { first, end, rings, geometry };
  }

  /** Node positions of the present frame in the lab, relative to where the body started [um]. */
  nodesOfFrame() {
    const { low, step } = this.shown.positions, out = new Float32Array(3 * this.nodeCount);
    const from = 3 * this.nodeCount * this.frame;
    for (let i = 0; i < out.length; i++) {
      const axis = i % 3;
      out[i] = low[axis] + step[axis] * this.nodes[from + i] + this.centres[3 * this.frame + axis];
    }
    return out;
  }

  show(frame) {
    const before = vector(this.path, this.frame);
    this.frame = frame;
    if (this.following) this.shift(vector(this.path, frame).sub(before));
    this.body.position.copy(vector(this.centres, frame));
    const q = this.orientations.subarray(4 * frame, 4 * frame + 4);
    this.body.quaternion.set(q[0], q[1], q[2], q[3]).normalize();
    this.motors.forEach((motor, k) => { motor.rotation.z = this.angles[frame * this.motors.length + k]; });
    const nodes = this.nodesOfFrame();
    for (const tube of this.tubes) {
      this.fillTube(tube, nodes);
      this.colorTube(tube);
    }
    this.ask();
  }

  /** Rings about a Catmull-Rom curve through the nodes, turned along it without twist, with round ends. */
  fillTube({ first, end, rings, geometry }, nodes) {
    const radius = this.shown.displayRadius, count = end - first, pieces = this.pieces;
    const points = [], p = Array.from({ length: count }, (_, i) => vector(nodes, first + i));
    const beyond = (a, b) => a.clone().multiplyScalar(2).sub(b);
    for (let i = 0; i + 1 < count; i++) {
      const p0 = i > 0 ? p[i - 1] : beyond(p[0], p[1]), p3 = i + 2 < count ? p[i + 2] : beyond(p[count - 1], p[count - 2]);
      for (let piece = 0; piece < pieces; piece++) points.push(catmullRom(p0, p[i], p[i + 1], p3, piece / pieces));
    }
    points.push(p[count - 1]);
    const tangents = points.map((_, i) =>
      points[Math.min(i + 1, points.length - 1)].clone().sub(points[Math.max(i - 1, 0)]).normalize());
    const position = geometry.attributes.position.array, normal = geometry.attributes.normal.array;
    let side = new THREE.Vector3(1, 0, 0);
    if (Math.abs(tangents[0].x) > 0.8) side.set(0, 1, 0);
    let ring = 0;
    const put = (point, tangent, across, share, lean) => {
      const other = tangent.clone().cross(across);
      for (let k = 0; k < SIDES; k++) {
        const angle = (2 * Math.PI * k) / SIDES, c = Math.cos(angle), s = Math.sin(angle);
        for (let axis = 0; axis < 3; axis++) {
          const outward = c * across.getComponent(axis) + s * other.getComponent(axis);
          const at = 3 * (ring * SIDES + k) + axis, along = lean * tangent.getComponent(axis);
          position[at] = point.getComponent(axis) + radius * (share * outward + along);
          normal[at] = share * outward + along;
        }
      }
      ring += 1;
    };
    points.forEach((point, i) => {
      side = side.clone().addScaledVector(tangents[i], -side.dot(tangents[i])).normalize();
      if (i === 0) for (const [share, lean] of CAP) put(point, tangents[i], side, share, -lean);
      put(point, tangents[i], side, 1, 0);
      if (i === points.length - 1) for (const [share, lean] of CAP.toReversed()) put(point, tangents[i], side, share, lean);
    });
    if (ring !== rings) throw new Error(`a tube of ${rings} rings was given ${ring}`);
    geometry.attributes.position.needsUpdate = geometry.attributes.normal.needsUpdate = true;
  }

  /** Colours of a tube's vertices, between two nodes mixed. */
  colorTube({ first, end, rings, geometry }) {
    const colors = geometry.attributes.color.array, last = end - first - 1;
    const at = (node) => this.nodeColor(first + node);
    for (let ring = 0; ring < rings; ring++) {
      const place = Math.min(Math.max((ring - CAP.length) / this.pieces, 0), last);
      const node = Math.min(Math.floor(place), last - 1);
      const color = at(node).clone().lerp(at(node + 1), place - node);
      for (let k = 0; k < SIDES; k++) color.toArray(colors, 3 * (ring * SIDES + k));
    }
    geometry.attributes.color.needsUpdate = true;
  }

  nodeColor(node) {
    if (this.shares) return this.table[this.shares[this.frame * this.nodeCount + node]];
    const flagellum = this.shown.firstNode.findIndex((first) => first > node) - 1;
    return this.table[flagellum % this.table.length];
  }

  setColor(name) {
    const coloring = this.shown.colorings[name];
    this.shares = coloring ? unpacked(coloring.shares, Uint8Array) : null;
    const scale = [...this.shown.map, this.shown.undefinedColor];
    const colors = coloring ? coloring.colors || scale : this.shown.flagellumColors;
    this.table = colors.map((color) => new THREE.Color(color));
    this.tubes.forEach((tube) => this.colorTube(tube));
    this.ask();
  }

  follow(on) {
    this.following = on;
    if (on) this.shift(vector(this.path, this.frame).add(vector(this.shown.view.middle)).sub(this.controls.target));
  }

  shift(by) {
    this.camera.position.add(by);
    this.controls.target.add(by);
    this.controls.update();
    this.ask();
  }

  /** The view of the beginning: the cell of all frames in it, or its whole way when the camera stands still. */
  reset() {
    this.untouched = true;
    const { half, middle } = this.shown.view, reach = vector(half), aim = vector(middle);
    if (this.following) {
      aim.add(vector(this.path, this.frame));
    } else {
      const way = [this.right, this.up, this.back].map((axis, i) => {
        const along = [];
        for (let f = 0; 3 * f < this.path.length; f++) along.push(vector(this.path, f).dot(axis));
        const low = Math.min(...along), high = Math.max(...along);
        aim.addScaledVector(axis, (low + high) / 2);
        return (high - low) / 2;
      });
      reach.add(vector(way));
    }
    const slope = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
    const distance = 1.06 * Math.max(reach.y / slope, reach.x / (slope * this.camera.aspect)) + reach.z;
    this.controls.target.copy(aim);
    this.camera.position.copy(aim).addScaledVector(this.back, distance);
    this.camera.near = distance / 100;
    this.camera.far = distance * 100;
    this.camera.updateProjectionMatrix();
    this.controls.update();
    this.ask();
  }

  /** Turns the camera about its aim by angles [rad], and goes nearer by a factor below 1. */
  turn(around, above, factor = 1) {
    this.untouched = false;
    const offset = this.camera.position.clone().sub(this.controls.target).multiplyScalar(factor);
    offset.applyAxisAngle(this.up, around);
    const right = this.up.clone().cross(offset).normalize();
    const lifted = offset.clone().applyAxisAngle(right, -above);
    const tilt = lifted.angleTo(this.up);
    this.camera.position.copy(this.controls.target).add(tilt > 0.05 && tilt < Math.PI - 0.05 ? lifted : offset);
    this.controls.update();
    this.ask();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(window.devicePixelRatio);
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (this.untouched) this.reset();  // what was in view stays in view
    this.ask();
  }

  /** Draws once before the screen is next shown, however often it is called. */
  ask() {
    if (this.asked) return;
    this.asked = true;
    requestAnimationFrame(() => {
      this.asked = false;
      this.renderer.render(this.scene, this.camera);
      const distance = this.camera.position.distanceTo(this.controls.target);
      const height = 2 * distance * Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
      this.onDrawn(this.canvas.parentElement.clientHeight / height);
    });
  }
}

function catmullRom(p0, p1, p2, p3, t) {
  const point = new THREE.Vector3();
  point.addScaledVector(p0, 0.5 * (-t + 2 * t * t - t * t * t));
  point.addScaledVector(p1, 0.5 * (2 - 5 * t * t + 3 * t * t * t));
  point.addScaledVector(p2, 0.5 * (t + 4 * t * t - 3 * t * t * t));
  point.addScaledVector(p3, 0.5 * (t * t * t - t * t));
  return point;
}
