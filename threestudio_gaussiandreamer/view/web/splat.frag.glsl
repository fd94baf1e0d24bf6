#version 300 es
// Blend one Gaussian into a pixel; the formula of `blend` in splatting/reference.py.
precision highp float;

uniform vec2 size;
uniform float alphaMin;
uniform float alphaMax;

flat in vec2 mean2d;
flat in vec3 conic;
flat in vec4 colorOpacity;
out vec4 premultiplied;

void main() {
  vec2 d = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y) - mean2d;
  float sheared = d.x - conic.y * d.y;
  float q = conic.x * sheared * sheared + conic.z * d.y * d.y;
  float alpha = min(alphaMax, colorOpacity.a * exp(-0.5 * q));
  if (alpha < alphaMin) discard;
  premultiplied = vec4(colorOpacity.rgb * alpha, alpha);
}
