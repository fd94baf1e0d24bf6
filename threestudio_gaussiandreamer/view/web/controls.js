// Mouse, touch and keyboard: each gesture changes the pose through `change(pose => pose)`.

const DEGREES_PER_PIXEL = 0.35;
const ZOOM_PER_NOTCH = 1.1;
const KEYS = {
  ArrowLeft: (pose) => turned(pose, -5, 0),
  ArrowRight: (pose) => turned(pose, 5, 0),
  ArrowUp: (pose) => turned(pose, 0, 5),
  ArrowDown: (pose) => turned(pose, 0, -5),
};

function middle(points) {
  return [0, 1].map((i) => points.reduce((sum, point) => sum + point[i], 0) / points.length);
}

function spread(points) {
  return Math.hypot(points[0][0] - points[1][0], points[0][1] - points[1][1]);
}

class Controls {
  constructor(canvas, limits, change) {
    this.canvas = canvas;
    this.limits = limits;
    this.change = change;
    this.pointers = new Map();
    canvas.addEventListener("pointerdown", (event) => this.press(event));
    canvas.addEventListener("pointermove", (event) => this.move(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, (event) => this.pointers.delete(event.pointerId));
    }
    canvas.addEventListener("wheel", (event) => this.wheel(event), { passive: false });
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("keydown", (event) => this.key(event));
  }

  press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
  }

  move(event) {
    if (!this.pointers.has(event.pointerId)) return;
    const before = [...this.pointers.values()];
    this.pointers.set(event.pointerId, [event.clientX, event.clientY]);
    const after = [...this.pointers.values()];
    const [from, to] = [middle(before), middle(after)], dx = to[0] - from[0], dy = to[1] - from[1];
    const pans = after.length > 1 || event.shiftKey || (event.buttons & 6) !== 0;
    const pixels = Math.min(this.canvas.clientWidth, this.canvas.clientHeight);
    this.change((pose) => pans
      ? panned(pose, dx, dy, pixels)
      : turned(pose, -DEGREES_PER_PIXEL * dx, DEGREES_PER_PIXEL * dy));
    if (after.length === 2 && spread(after) > 0) {
      this.zoom(spread(before) / spread(after));
    }
  }

  wheel(event) {
    event.preventDefault();
    const notches = event.deltaY / (event.deltaMode === 0 ? 100 : 3);
    this.zoom(ZOOM_PER_NOTCH ** Math.max(-5, Math.min(5, notches)));
  }

  key(event) {
    const turn = KEYS[event.key];
    if (turn) this.change(turn);
    else if (event.key === "+" || event.key === "=") this.zoom(1 / ZOOM_PER_NOTCH);
    else if (event.key === "-") this.zoom(ZOOM_PER_NOTCH);
    else return;
    event.preventDefault();
  }

  zoom(factor) {
    this.change((pose) => zoomed(pose, factor, this.limits));
  }
}
