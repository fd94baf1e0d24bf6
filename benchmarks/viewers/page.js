// Draws job.json's scene from each of its cameras and posts the pixels to browser.py: what the pages
// spark.html and three.html have in common. What is posted to /picture/<number> are RGBA rows from
// the bottom up.
//
// job.json: {size, cameras: [{c2w: 16 numbers, row-major, fovy: degrees}], and what the page needs}.

const post = (path, body) => fetch(path, {method: "POST", body});
const fail = (error) => post("/failed", String(error?.stack ?? error?.reason ?? error));
addEventListener("error", (event) => fail(event.error ?? event.message));
addEventListener("unhandledrejection", (event) => fail(event.reason));

// build(THREE, renderer, scene, job) fills the scene; it may return a function draw(camera)
export const drawPictures = (options, build) => drawAll(options, build).catch(fail);

async function drawAll(options, build) {
  const THREE = await import("three");
  const job = await (await fetch("/job.json")).json();
  const renderer = new THREE.WebGLRenderer({...options, preserveDrawingBuffer: true});
  renderer.setPixelRatio(1);
  renderer.setSize(job.size, job.size);
  renderer.setClearColor(0xffffff, 1);
  document.body.append(renderer.domElement);

  const scene = new THREE.Scene();
  const once = (camera) => renderer.render(scene, camera);
  const draw = (await build(THREE, renderer, scene, job)) ?? once;
  const gl = renderer.getContext();
  const pixels = new Uint8Array(job.size * job.size * 4);
  for (const [number, {c2w, fovy}] of job.cameras.entries()) {
    const camera = new THREE.PerspectiveCamera(fovy, 1, 0.01, 100);
    new THREE.Matrix4().set(...c2w).decompose(camera.position, camera.quaternion, camera.scale);
    camera.updateMatrixWorld(true);
    await draw(camera);
    gl.readPixels(0, 0, job.size, job.size, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    await post(`/picture/${number}`, pixels);
  }
}
