// Draws Gaussians with WebGL2: quads, many to an instance, blended back to front into a picture of floats,
// since 8 bits lose too much under many faint layers, then composited to the canvas. While the
// picture moves it is one of half floats, which graphics cards blend faster.

const TEXTURE_WIDTH = 4096;
const UPLOAD_ROWS = 64;
const PER_INSTANCE = 128;  // quads; an instance of one quad costs as much as one of many
const SPLAT_UNIFORMS = [
  "order", "visible", "perInstance", "cloud", "harmonics", "cloudColumns", "harmonicColumns", "degree", "rotation", "translation",
  "cameraPosition", "size", "focal", "near", "far", "eps2d", "alphaMin", "alphaMax", "antialias",
  "boundColors",
];

function compiled(gl, type, source) {
  const shader = gl.createShader(type);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) {
    throw new Error(gl.getShaderInfoLog(shader));
  }
  return shader;
}

function linked(gl, vertex, fragment, uniforms) {
  const program = gl.createProgram();
  gl.attachShader(program, compiled(gl, gl.VERTEX_SHADER, vertex));
  gl.attachShader(program, compiled(gl, gl.FRAGMENT_SHADER, fragment));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(gl.getProgramInfoLog(program));
  }
  const places = uniforms.map((name) => [name, gl.getUniformLocation(program, name)]);
  return { program, at: Object.fromEntries(places) };
}

// Vertex numbers of the two triangles of each of `count` quads; a quad has four vertices.
function quadCorners(count) {
  const corners = [0, 1, 2, 2, 1, 3];
  return Uint16Array.from({ length: 6 * count }, (_, i) => 4 * Math.floor(i / 6) + corners[i % 6]);
}

class Renderer {
  // `sources` are the four shaders; `settings` are those that the cloud was trained with.
  constructor(canvas, sources, settings) {
    this.canvas = canvas;
    this.settings = settings;
    this.gl = canvas.getContext("webgl2", { alpha: false, antialias: false, depth: false });
    if (!this.gl) throw new Error("no WebGL2");
    const gl = this.gl;
    this.splats = linked(gl, sources.splatVert, sources.splatFrag, SPLAT_UNIFORMS);
    this.screen = linked(gl, sources.screenVert, sources.screenFrag, ["picture", "background"]);
    const floats = gl.getExtension("EXT_color_buffer_float");
    const halves = floats || gl.getExtension("EXT_color_buffer_half_float");
    const moving = this.target(halves ? gl.RGBA16F : gl.RGBA8, gl.LINEAR);
    const still = floats && gl.getExtension("EXT_float_blend")
      ? this.target(gl.RGBA32F, gl.NEAREST) : moving;
    this.targets = { moving, still };
    this.blank = gl.createVertexArray();
    this.quads = gl.createVertexArray();
    gl.bindVertexArray(this.quads);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, quadCorners(PER_INSTANCE), gl.STATIC_DRAW);
  }

  // Upload a cloud; returns what `draw` takes.
  upload(columns, degree) {
    const { gl } = this, count = columns[0].length, each = (degree + 1) ** 2 - 1;
    const width = Math.min(TEXTURE_WIDTH, gl.getParameter(gl.MAX_TEXTURE_SIZE));
    const scene = { visible: 0, degree, order: this.orderTexture(count) };
    scene.cloudColumns = Math.floor(width / 4);
    scene.cloud = this.texture(gl.RGBA32F, 4, scene.cloudColumns, count,
      (first, last) => cloudTexels(columns, degree, first, last));
    scene.harmonicColumns = each ? Math.floor(width / each) : 1;
    scene.harmonics = each
      ? this.texture(gl.RGBA16F, each, scene.harmonicColumns, count,
        (first, last) => harmonicTexels(columns, degree, first, last))
      : scene.cloud;
    return scene;
  }

  // A texture with `each` texels for every Gaussian and `columns` Gaussians a row, filled in parts.
  texture(format, each, columns, count, texels) {
    const gl = this.gl, rows = Math.ceil(count / columns);
    if (rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) {
      throw new Error(`the graphics card's textures are too small for ${count} Gaussians`);
    }
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, format, each * columns, rows);
    this.unfiltered(texture);
    for (let row = 0; row < rows; row += UPLOAD_ROWS) {
      const height = Math.min(UPLOAD_ROWS, rows - row), first = row * columns;
      const part = new Float32Array(4 * each * columns * height);
      part.set(texels(first, Math.min(first + columns * height, count)));
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, each * columns, height, gl.RGBA, gl.FLOAT, part);
    }
    return texture;
  }

  // Turn off the interpolation of the bound texture, which formats of floats and integers lack.
  unfiltered(texture) {
    const gl = this.gl;
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    return texture;
  }

  orderTexture(count) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.R32UI, ORDER_WIDTH, Math.ceil(count / ORDER_WIDTH));
    return this.unfiltered(texture);
  }

  // `sorted` holds whole rows of the texture.
  setOrder(scene, sorted, visible) {
    const gl = this.gl, rows = Math.ceil(visible / ORDER_WIDTH);
    gl.bindTexture(gl.TEXTURE_2D, scene.order);
    if (rows) {
      gl.texSubImage2D(
        gl.TEXTURE_2D, 0, 0, 0, ORDER_WIDTH, rows, gl.RED_INTEGER, gl.UNSIGNED_INT, sorted);
    }
    scene.visible = visible;
  }

  // Draw to the canvas. With `scale` below 1, for `targets.moving` only, the Gaussians are drawn at
  // fewer pixels.
  draw(scene, camera, pose, background, target, scale) {
    const gl = this.gl, { width, height } = this.canvas;
    const size = [width, height].map((x) => Math.max(1, Math.round(x * scale)));
    this.resize(target, size);
    gl.viewport(0, 0, ...size);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    this.useSplats(scene, camera, size, focalLength(pose, ...size), scale);
    gl.bindVertexArray(this.quads);
    const instances = Math.ceil(scene.visible / PER_INSTANCE);
    gl.drawElementsInstanced(gl.TRIANGLES, 6 * PER_INSTANCE, gl.UNSIGNED_SHORT, 0, instances);
    gl.disable(gl.BLEND);
    this.composite(target, background);
  }

  useSplats(scene, camera, size, focal, scale) {
    const gl = this.gl, { program, at } = this.splats, settings = this.settings;
    gl.useProgram(program);
    ["cloud", "harmonics", "order"].forEach((name, unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, scene[name]);
      gl.uniform1i(at[name], unit);
    });
    gl.uniform1i(at.visible, scene.visible);
    gl.uniform1i(at.perInstance, PER_INSTANCE);
    gl.uniform1i(at.cloudColumns, scene.cloudColumns);
    gl.uniform1i(at.harmonicColumns, scene.harmonicColumns);
    gl.uniform1i(at.degree, scene.degree);
    gl.uniformMatrix3fv(at.rotation, true, camera.rotation.flat());
    gl.uniform3fv(at.translation, camera.translation);
    gl.uniform3fv(at.cameraPosition, camera.position);
    gl.uniform2fv(at.size, size);
    gl.uniform1f(at.focal, focal);
    gl.uniform1f(at.near, settings.near);
    gl.uniform1f(at.far, settings.far);
    gl.uniform1f(at.eps2d, settings.eps2d * scale * scale);
    gl.uniform1f(at.alphaMin, settings.alphaMin);
    gl.uniform1f(at.alphaMax, settings.alphaMax);
    gl.uniform1i(at.antialias, settings.antialias);
    gl.uniform1i(at.boundColors, settings.boundColors);
  }

  composite(target, background) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.useProgram(this.screen.program);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    gl.uniform1i(this.screen.at.picture, 0);
    gl.uniform3fv(this.screen.at.background, background);
    gl.bindVertexArray(this.blank);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // A picture to blend into; it gets its texture when its size is known.
  target(format, filter) {
    const framebuffer = this.gl.createFramebuffer();
    return { format, filter, texture: null, framebuffer, size: [0, 0] };
  }

  // Bind a target, with a texture of this size.
  resize(target, size) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.framebuffer);
    if (size.every((x, i) => x === target.size[i])) return;
    gl.deleteTexture(target.texture);
    Object.assign(target, { texture: gl.createTexture(), size });
    gl.bindTexture(gl.TEXTURE_2D, target.texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, target.format, ...size);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, target.filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, target.filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    gl.framebufferTexture2D(
      gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, target.texture, 0);
  }

  // The canvas as bytes RGBA, rows from the bottom; to be called in the task that has drawn it.
  pixels() {
    const gl = this.gl, { width, height } = this.canvas;
    const bytes = new Uint8Array(4 * width * height);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return bytes;
  }
}
