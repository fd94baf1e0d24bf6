// The page: reads the clouds in it, wires the controls, and draws when something has changed.

const TURNTABLE_SPEED = 30;  // degrees a second
const SLOW_FRAME = 60, FAST_FRAME = 25, STILL_AFTER = 250;  // milliseconds
const SMALLEST_SCALE = 0.25;
const byId = (id) => document.getElementById(id);

function explain(text) {
  byId("message").textContent = text;
  document.body.classList.add("failed");
}

function colorOf(hex) {
  return [1, 3, 5].map((start) => parseInt(hex.slice(start, start + 2), 16) / 255);
}

class Viewer {
  constructor(meta) {
    this.meta = meta;
    this.limits = [meta.camera.distance / 100, meta.camera.distance * 20];
    this.pose = poseFromHash(location.hash.slice(1), this.limits) || meta.camera;
    this.canvas = byId("canvas");
    this.renderer = new Renderer(this.canvas, {
      splatVert: byId("splat-vert").textContent.trim(),
      splatFrag: byId("splat-frag").textContent.trim(),
      screenVert: byId("screen-vert").textContent.trim(),
      screenFrag: byId("screen-frag").textContent.trim(),
    }, meta.settings);
    this.clouds = [];
    this.shown = 0;
    this.background = colorOf(meta.background);
    this.turning = this.moving = this.pending = this.sorted = false;
    this.scale = 1;
    this.lastFrame = this.lastChange = 0;
  }

  // Decode and upload cloud number `index`, once.
  async load(index) {
    if (this.clouds[index]) return;
    const facts = this.meta.clouds[index];
    const columns = await unpackedColumns(byId(`cloud-${index}`).textContent.trim(), facts.count);
    const scene = this.renderer.upload(columns, facts.degree);
    const order = new DepthOrder(columns, (sorted, visible) => {
      this.renderer.setOrder(scene, sorted, visible);
      if (this.cloud?.scene !== scene) return;  // another cloud is shown by now
      this.sorted = true;
      this.invalidate();
    });
    this.clouds[index] = { columns, scene, order, facts };
  }

  get cloud() {
    return this.clouds[this.shown];
  }

  get camera() {
    return cameraOf(this.pose, this.cloud.facts.toWorld);
  }

  sort() {
    const { near, far } = this.meta.settings;
    this.cloud.order.sort(this.camera, near, far);
  }

  draw(target, scale) {
    const { scene } = this.cloud;
    this.renderer.draw(scene, this.camera, this.pose, this.background, target, scale);
  }

  change(update) {
    this.pose = update(this.pose);
    this.lastChange = performance.now();
    if (this.cloud) this.sort();
    this.invalidate();
    clearTimeout(this.addressTimer);
    this.addressTimer = setTimeout(() => this.writeAddress(), 300);
  }

  writeAddress() {
    // whole, since "#..." is relative to the address of the notebook that embeds the page
    const here = location.href.split("#")[0];
    history.replaceState(null, "", `${here}#${poseToHash(this.pose)}`);
  }

  invalidate() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame((now) => this.frame(now));
  }

  frame(now) {
    this.pending = false;
    if (!this.cloud || !this.sorted) return;
    const elapsed = now - this.lastFrame;
    this.lastFrame = now;
    if (this.turning) this.turnOn(Math.min(elapsed, 200));
    const moving = this.turning || performance.now() - this.lastChange < STILL_AFTER;
    if (moving && this.moving) this.adapt(elapsed);
    this.moving = moving;
    const { targets } = this.renderer;
    this.draw(moving ? targets.moving : targets.still, moving ? this.scale : 1);
    document.body.classList.add("drawn");
    if (moving) this.invalidate();
  }

  turnOn(milliseconds) {
    this.pose = turned(this.pose, TURNTABLE_SPEED * milliseconds / 1000, 0);
    this.sort();
  }

  // Draw at fewer pixels while moving where the graphics card is too slow.
  adapt(elapsed) {
    if (elapsed > SLOW_FRAME) this.scale = Math.max(SMALLEST_SCALE, this.scale * 0.8);
    if (elapsed < FAST_FRAME) this.scale = Math.min(1, this.scale * 1.05);
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    this.canvas.width = Math.max(1, Math.round(this.canvas.clientWidth * ratio));
    this.canvas.height = Math.max(1, Math.round(this.canvas.clientHeight * ratio));
    this.invalidate();
  }

  async show(index) {
    await this.load(index);
    this.shown = index;
    this.sorted = false;
    this.sort();
    describe(this.meta, index);
  }

  // Draw one picture: bytes RGBA, rows from the bottom. For scripts; the window isn't changed.
  async picture(pose, width, height) {
    Object.assign(this, { pose, turning: false });
    Object.assign(this.canvas, { width, height });
    this.sort();
    while (!this.cloud.order.settled) await new Promise((done) => setTimeout(done, 1));
    Object.assign(this.canvas, { width, height });  // the window may have resized it
    this.draw(this.renderer.targets.still, 1);
    return this.renderer.pixels();
  }
}

// ---- what surrounds the picture -----------------------------------------------------------------

function describe(meta, index) {
  const { count, label, quality } = meta.clouds[index];
  const words = [`${count.toLocaleString("en")} Gaussians`, quality];
  if (meta.clouds.length > 1) words.unshift(label);
  byId("facts").textContent = words.filter(Boolean).join(" · ");
  byId("cloud-choice").value = String(index);
}

function fillChoice(meta) {
  const choice = byId("cloud-choice");
  meta.clouds.forEach(({ label }, index) => choice.add(new Option(label, String(index))));
  choice.hidden = meta.clouds.length < 2;
}

function wireButtons(viewer) {
  const { meta } = viewer;
  const on = (id, name, action) => byId(id).addEventListener(name, action);
  on("turntable", "click", () => {
    viewer.turning = !viewer.turning;
    byId("turntable").setAttribute("aria-pressed", String(viewer.turning));
    viewer.change((pose) => pose);
  });
  on("reset", "click", () => viewer.change(() => meta.camera));
  on("background", "input", (event) => {
    viewer.background = colorOf(event.target.value);
    viewer.invalidate();
  });
  on("cloud-choice", "change", (event) => viewer.show(Number(event.target.value)));
  on("full-screen", "click", () => document.fullscreenElement
    ? document.exitFullscreen() : document.documentElement.requestFullscreen());
  byId("full-screen").hidden = !document.fullscreenEnabled;
  on("save-ply", "click", () => {
    saveFile(`${meta.name}.ply`, plyParts(meta.plyHeader, viewer.clouds[0].columns));
  });
}

function wireWindow(viewer) {
  new ResizeObserver(() => viewer.resize()).observe(viewer.canvas);
  window.addEventListener("hashchange", () => {
    const pose = poseFromHash(location.hash.slice(1), viewer.limits);
    if (pose) viewer.change(() => pose);
  });
  viewer.canvas.addEventListener("webglcontextlost", () => {
    explain("The browser has stopped drawing in 3D here. Reload the page to go on.");
  });
  new Controls(viewer.canvas, viewer.limits, (update) => viewer.change(update));
}

async function start() {
  const meta = JSON.parse(byId("meta").textContent);
  byId("prompt").textContent = meta.title;
  byId("background").value = meta.background;
  fillChoice(meta);
  describe(meta, 0);
  // needs no drawing
  byId("save-spz").addEventListener("click", () => {
    saveFile(`${meta.name}.spz`, [base64Bytes(byId("spz").textContent.trim())]);
  });
  document.querySelector("footer").hidden = false;
  if (!byId("canvas").getContext("webgl2", { alpha: false, antialias: false, depth: false })) {
    explain("This browser doesn't offer WebGL2, which turning the object needs. "
      + "This is a picture of it.");
    return null;
  }
  const viewer = new Viewer(meta);
  wireButtons(viewer);
  wireWindow(viewer);
  viewer.resize();
  await viewer.show(0);
  return viewer;
}

window.viewer = start().catch((error) => {
  explain(`The viewer can't be started: ${error.message}`);
  return null;
});
