#version 300 es
// Composite the blended picture over the background.
precision highp float;
precision highp sampler2D;

uniform sampler2D picture;
uniform vec3 background;
in vec2 place;
out vec4 color;

void main() {
  vec4 blended = texture(picture, place);
  color = vec4(blended.rgb + (1.0 - blended.a) * background, 1);
}
