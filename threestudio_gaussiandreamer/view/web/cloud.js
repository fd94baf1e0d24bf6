// The Gaussians in the page: columns of float32 as in a PLY file, without its normals. They are
// stored column by column, each as four planes of bytes, packed by zlib, as base64.

const BASE64_STEP = 1 << 20;  // characters decoded at a time; a multiple of four
const SH_C0 = 0.28209479177387814;

function base64Bytes(text) {
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const padding = text.endsWith("==") ? 2 : text.endsWith("=") ? 1 : 0;
  const bytes = new Uint8Array(text.length / 4 * 3 - padding);
  for (let start = 0; start < text.length; start += BASE64_STEP) {
    const part = atob(text.slice(start, start + BASE64_STEP));
    for (let i = 0; i < part.length; i++) bytes[start / 4 * 3 + i] = part.charCodeAt(i);
  }
  return bytes;
}

async function inflated(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function unshuffled(bytes, count) {
  const columns = [];
  for (let start = 0; start < bytes.length; start += 4 * count) {
    const column = new Uint8Array(4 * count);
    for (let plane = 0; plane < 4; plane++) {
      const first = start + plane * count;
      for (let i = 0; i < count; i++) column[4 * i + plane] = bytes[first + i];
    }
    columns.push(new Float32Array(column.buffer));
  }
  return columns;
}

async function unpackedColumns(text, count) {
  return unshuffled(await inflated(base64Bytes(text)), count);
}

// Column numbers of the attributes of a cloud whose harmonics have this degree.
function columnNumbers(degree) {
  const rest = 3 * ((degree + 1) ** 2 - 1);
  return { mean: 0, sh0: 3, shRest: 6, opacity: 6 + rest, scale: 7 + rest, quat: 10 + rest };
}

// Four texels for each of the Gaussians from `first` to `last`, as splat.vert.glsl reads them.
function cloudTexels(columns, degree, first, last) {
  const at = columnNumbers(degree), texels = new Float32Array(16 * (last - first));
  for (let i = first; i < last; i++) {
    const t = 16 * (i - first);
    for (let j = 0; j < 3; j++) {
      texels[t + j] = columns[at.mean + j][i];
      texels[t + 8 + j] = Math.exp(columns[at.scale + j][i]);
      texels[t + 12 + j] = 0.5 + SH_C0 * columns[at.sh0 + j][i];
    }
    texels[t + 3] = 1 / (1 + Math.exp(-columns[at.opacity][i]));
    for (let j = 0; j < 4; j++) texels[t + 4 + j] = columns[at.quat + j][i];
  }
  return texels;
}

// A texel for each coefficient above degree 0; the columns hold them channel by channel.
function harmonicTexels(columns, degree, first, last) {
  const each = (degree + 1) ** 2 - 1, start = columnNumbers(degree).shRest;
  const texels = new Float32Array(4 * each * (last - first));
  for (let channel = 0; channel < 3; channel++) {
    for (let k = 0; k < each; k++) {
      const column = columns[start + channel * each + k];
      for (let i = first; i < last; i++) texels[4 * (each * (i - first) + k) + channel] = column[i];
    }
  }
  return texels;
}

// ---- files --------------------------------------------------------------------------------------

// The PLY file: the header that Python wrote into the page, then the rows with normals of zero.
function plyParts(header, columns) {
  const width = columns.length + 3, count = columns[0].length;
  const rows = new Float32Array(width * count);
  columns.forEach((column, c) => {
    const place = c < 3 ? c : c + 3;
    for (let i = 0; i < count; i++) rows[i * width + place] = column[i];
  });
  return [header, rows];
}

function saveFile(name, parts) {
  const address = URL.createObjectURL(new Blob(parts, { type: "application/octet-stream" }));
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(address), 60000);
}
