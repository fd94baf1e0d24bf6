// Cameras that turn around a target; the conventions of cameras.py: the world's z is up, azimuth 0
// is +x, angles are in degrees.

const radians = (degrees) => degrees * Math.PI / 180;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0],
];

function transposed(rows) {
  return [0, 1, 2].map((j) => rows.map((row) => row[j]));
}

function applied(rows, vector) {
  return rows.map((row) => dot(row, vector));
}

// Right, down and forward of the camera in the world, and its position.
function orbitFrame(pose) {
  const elevation = radians(pose.elevation), azimuth = radians(pose.azimuth);
  const back = [
    Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth),
    Math.sin(elevation),
  ];
  const forward = back.map((x) => -x);
  const right = [-Math.sin(azimuth), Math.cos(azimuth), 0];
  const position = pose.target.map((x, i) => x + pose.distance * back[i]);
  return { rows: [right, cross(forward, right), forward], position };
}

// The camera in the axes of a cloud whose rotation to the world's axes is `toWorld`.
function cameraOf(pose, toWorld) {
  const { rows, position } = orbitFrame(pose);
  const toCloud = transposed(toWorld);
  const rotation = rows.map((row) => applied(toCloud, row));
  const here = applied(toCloud, position);
  return { rotation, position: here, translation: rotation.map((row) => -dot(row, here)) };
}

// Focal length in pixels. The field of view is that of the shorter side, so that an object that
// fits a wide window also fits a phone.
function focalLength(pose, width, height) {
  return 0.5 * Math.min(width, height) / Math.tan(radians(pose.fovy) / 2);
}

function turned(pose, azimuth, elevation) {
  return {
    ...pose,
    azimuth: (((pose.azimuth + azimuth) % 360) + 360) % 360,
    elevation: Math.max(-89.9, Math.min(89.9, pose.elevation + elevation)),
  };
}

function zoomed(pose, factor, limits) {
  const distance = Math.max(limits[0], Math.min(limits[1], pose.distance * factor));
  return { ...pose, distance };
}

// Move the target by a number of pixels of the picture.
function panned(pose, dx, dy, pixels) {
  const { rows: [right, down] } = orbitFrame(pose);
  const step = 2 * pose.distance * Math.tan(radians(pose.fovy) / 2) / pixels;
  return { ...pose, target: pose.target.map((x, i) => x - step * (dx * right[i] + dy * down[i])) };
}

// ---- the pose in the page's address -------------------------------------------------------------

function poseToHash(pose) {
  const numbers = [pose.azimuth, pose.elevation, pose.distance, ...pose.target, pose.fovy];
  return numbers.map((x) => String(Number(x.toPrecision(6)))).join(",");
}

// The pose in an address, or null if there is none or it isn't valid.
function poseFromHash(text, limits) {
  const numbers = text.split(",").map(Number);
  if (text === "" || numbers.length !== 7 || !numbers.every(Number.isFinite)) return null;
  const [azimuth, elevation, distance, x, y, z, fovy] = numbers;
  if (!(fovy > 1 && fovy < 170)) return null;
  const pose = { azimuth: 0, elevation: 0, distance, target: [x, y, z], fovy };
  return zoomed(turned(pose, azimuth, elevation), 1, limits);
}
