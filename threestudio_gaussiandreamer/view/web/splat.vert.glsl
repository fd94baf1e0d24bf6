#version 300 es
// Project one Gaussian to a splat and place a corner of the parallelogram around it. The formulas
// and their names are those of splatting/projection.py and gaussians/sh.py.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform usampler2D order;     // numbers of the Gaussians, back to front
uniform int visible;          // how many of them are drawn
uniform int perInstance;
uniform sampler2D cloud;      // four texels a Gaussian: mean opacity, quat wxyz, scales, colour
uniform sampler2D harmonics;  // a texel for each coefficient above degree 0
uniform int cloudColumns;     // Gaussians in a row of each texture
uniform int harmonicColumns;
uniform int degree;
uniform mat3 rotation;        // world to camera: x right, y down, z forward
uniform vec3 translation;
uniform vec3 cameraPosition;
uniform vec2 size;            // pixels
uniform float focal;          // pixels
uniform float near;
uniform float far;
uniform float eps2d;
uniform float alphaMin;
uniform bool antialias;
uniform bool boundColors;

flat out vec2 mean2d;         // pixels, y down, centres at +0.5
flat out vec3 conic;          // a, k, c of a (dx - k dy)^2 + c dy^2
flat out vec4 colorOpacity;

const float FRUSTUM_MARGIN = 0.3;
const float SMALLEST_QUATERNION = 1e-12;

vec4 cloudTexel(int i, int field) {
  return texelFetch(cloud, ivec2(4 * (i % cloudColumns) + field, i / cloudColumns), 0);
}

vec3 coefficient(int i, int k) {
  int perGaussian = (degree + 1) * (degree + 1) - 1;
  int column = perGaussian * (i % harmonicColumns) + k - 1;
  return texelFetch(harmonics, ivec2(column, i / harmonicColumns), 0).rgb;
}

mat3 rotationOf(vec4 quat) {
  float largest = max(max(abs(quat.x), abs(quat.y)), max(abs(quat.z), abs(quat.w)));
  vec4 q = largest >= SMALLEST_QUATERNION ? normalize(quat / largest) : vec4(1, 0, 0, 0);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec3 degreeOne(int i, vec3 d) {
  return 0.48860251190 * (-d.y * coefficient(i, 1) + d.z * coefficient(i, 2) - d.x * coefficient(i, 3));
}

vec3 degreeTwo(int i, vec3 d) {
  return 1.09254843059 * (d.x * d.y * coefficient(i, 4) - d.y * d.z * coefficient(i, 5)
      - d.x * d.z * coefficient(i, 7) + 0.5 * (d.x * d.x - d.y * d.y) * coefficient(i, 8))
    + 0.31539156525 * (3.0 * d.z * d.z - 1.0) * coefficient(i, 6);
}

vec3 degreeThree(int i, vec3 d) {
  float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
  return 0.59004358993 * (-d.y * (3.0 * xx - yy) * coefficient(i, 9)
      - d.x * (xx - 3.0 * yy) * coefficient(i, 15))
    + 2.89061144264 * (d.x * d.y * d.z * coefficient(i, 10)
      + 0.5 * d.z * (xx - yy) * coefficient(i, 14))
    - 0.45704579946 * (5.0 * zz - 1.0) * (d.y * coefficient(i, 11) + d.x * coefficient(i, 13))
    + 0.37317633259 * d.z * (5.0 * zz - 3.0) * coefficient(i, 12);
}

vec3 colorSeen(int i, vec3 mean) {
  vec3 color = cloudTexel(i, 3).rgb, d = normalize(mean - cameraPosition);
  if (degree >= 1) color += degreeOne(i, d);
  if (degree >= 2) color += degreeTwo(i, d);
  if (degree >= 3) color += degreeThree(i, d);
  return boundColors ? clamp(color, 0.0, 1.0) : max(color, 0.0);
}

void hide() {
  gl_Position = vec4(2, 2, 2, 1);
}

void main() {
  int place = gl_InstanceID * perInstance + (gl_VertexID >> 2), width = textureSize(order, 0).x;
  if (place >= visible) { hide(); return; }
  int i = int(texelFetch(order, ivec2(place % width, place / width), 0).r);
  vec4 meanOpacity = cloudTexel(i, 0);
  vec3 t = rotation * meanOpacity.xyz + translation;
  if (!(t.z > near && t.z < far)) { hide(); return; }

  mat3 axes = rotation * rotationOf(cloudTexel(i, 1));
  vec3 scales = cloudTexel(i, 2).xyz;
  for (int j = 0; j < 3; j++) axes[j] *= scales[j];
  mat3 rows = transpose(axes);
  vec2 limit = (0.5 + 0.5 * FRUSTUM_MARGIN) * size / focal;
  vec2 slope = clamp(t.xy / t.z, -limit, limit);
  vec3 u0 = focal / t.z * (rows[0] - slope.x * rows[2]);
  vec3 u1 = focal / t.z * (rows[1] - slope.y * rows[2]);

  float yy = dot(u1, u1) + eps2d, xy = dot(u0, u1), beforeXX = dot(u0, u0);
  float area = length(cross(u0, u1 / sqrt(yy)));
  float dilation = eps2d * (1.0 + beforeXX / yy);
  float variance = area * area + dilation;
  float opacity = meanOpacity.w * (antialias ? area / sqrt(variance) : 1.0);
  if (!(opacity >= alphaMin && variance > 0.0)) { hide(); return; }

  mean2d = 0.5 * size + focal * t.xy / t.z;
  conic = vec3(1.0 / variance, xy / yy, 1.0 / yy);
  colorOpacity = vec4(colorSeen(i, meanOpacity.xyz), opacity);
  vec2 sign = vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0;
  // beyond this distance, in standard deviations, alpha is below alphaMin
  vec2 v = sign * sqrt(2.0 * log(opacity / alphaMin));
  float dy = v.y * sqrt(yy), dx = v.x * sqrt(variance) + conic.y * dy;
  vec2 ndc = 2.0 * (mean2d + vec2(dx, dy)) / size - 1.0;
  gl_Position = vec4(ndc.x, -ndc.y, 0, 1);
}
