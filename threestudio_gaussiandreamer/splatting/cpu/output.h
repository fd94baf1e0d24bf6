// The last stage: background, 2x2 box and layout of the pictures; and its adjoint, the first stage of the backward pass.
#pragma once

#include "interleaved.h"
#include "tile.h"

namespace splat {

// The pictures of one view, or their upstream gradients, which may be missing; T is float or const float.
template <class T> struct Layers {
  T *image, *alpha, *depth;
  int width, height;
};

template <class T>
Layers<T> layers_of(T* image, T* alpha, T* depth, const Scene& scene, const SplatSettings& settings, int view) {
  const int width = scene.width / settings.downsample, height = scene.height / settings.downsample;
  const auto of_view = [&](T* all, int channels) { return all ? all + int64_t(width) * height * channels * view : nullptr; };
  return {of_view(image, 3), of_view(alpha, 1), of_view(depth, 1), width, height};
}

inline Vec3<float> background_of(const Scene& scene, int view) {
  const float* background = scene.background + 3 * view;
  return {background[0], background[1], background[2]};
}

// The positions of four adjacent pixels in a block-ordered plane.
SPLAT_FN int quad_at(int row, int column) {
  return ((row / BLOCK) * BLOCKS_PER_ROW + column) * BLOCK_PIXELS + row % BLOCK * BLOCK;
}

// Quad `column` of output row `row`: as rendered, or the mean of 2x2 pixels.
template <int DOWNSAMPLE> SPLAT_FN Quad fetch(const float* plane, int row, int column) {
  if constexpr (DOWNSAMPLE == 1) return load<Quad>(plane + quad_at(row, column));
  const auto pair = [&](int x) { return load<Quad>(plane + quad_at(2 * row, x)) + load<Quad>(plane + quad_at(2 * row + 1, x)); };
  const Quad left = pair(2 * column), right = pair(2 * column + 1);
  const Quad even = shuffle(left, right, [](int l) { return 2 * l; });
  const Quad odd = shuffle(left, right, [](int l) { return 2 * l + 1; });
  return 0.25f * (even + odd);
}

// The adjoint of `fetch`, onto a plane that only this function writes.
template <int DOWNSAMPLE> SPLAT_FN void spread(float* plane, int row, int column, Quad value) {
  if constexpr (DOWNSAMPLE == 1) return store(plane + quad_at(row, column), value);
  const Quad quarter = 0.25f * value;
  const Quad left = shuffle(quarter, quarter, [](int l) { return l / 2; });
  const Quad right = shuffle(quarter, quarter, [](int l) { return 2 + l / 2; });
  for (int y = 2 * row; y < 2 * row + 2; y++)
    store(plane + quad_at(y, 2 * column), left), store(plane + quad_at(y, 2 * column + 1), right);
}

struct QuadPixels {
  Vec3<Quad> color;
  Quad alpha, depth;
};

SPLAT_FN void write_quad(const Layers<float>& out, int64_t at, int pixels, const QuadPixels& q) {
  if (pixels == 4) {
    store3(out.image + 3 * at, q.color), store(out.alpha + at, q.alpha), store(out.depth + at, q.depth);
    return;
  }
  float image[12];
  store3(image, q.color);
  std::memcpy(out.image + 3 * at, image, sizeof(float) * 3 * pixels);
  std::memcpy(out.alpha + at, &q.alpha, sizeof(float) * pixels);
  std::memcpy(out.depth + at, &q.depth, sizeof(float) * pixels);
}

// `pixels` <= 4 floats of an array that may be missing, then zeros.
SPLAT_FN Quad read_clipped(const float* p, int64_t at, int pixels) {
  if (p && pixels == 4) return load<Quad>(p + at);
  Quad q = {};
  if (p) std::memcpy(&q, p + at, sizeof(float) * pixels);
  return q;
}

SPLAT_FN Vec3<Quad> read_clipped3(const float* p, int64_t at, int pixels) {
  if (p && pixels == 4) return load3<Quad>(p + 3 * at);
  float items[12] = {};
  if (p) std::memcpy(items, p + 3 * at, sizeof(float) * 3 * pixels);
  return load3<Quad>(items);
}

SPLAT_FN QuadPixels read_quad(const Layers<const float>& in, int64_t at, int pixels) {
  return {read_clipped3(in.image, at, pixels), read_clipped(in.alpha, at, pixels), read_clipped(in.depth, at, pixels)};
}

// Calls visit(row, column, at, pixels) for the quads of a tile's output: `at` is the first pixel, `pixels` <= 4 lie inside.
template <int DOWNSAMPLE, class T, class Visit>
SPLAT_FN void for_each_quad(const Layers<T>& layers, const TileFrame& frame, Visit visit) {
  const int left = frame.left / DOWNSAMPLE, top = frame.top / DOWNSAMPLE, side = TILE / DOWNSAMPLE;
  const int rows = std::min(side, layers.height - top), columns = std::min(side, layers.width - left);
  for (int row = 0; row < rows; row++)
    for (int x = 0; x < columns; x += 4)
      visit(row, x / 4, int64_t(top + row) * layers.width + left + x, std::min(4, columns - x));
}

template <int DOWNSAMPLE>
inline void write_tile_as(const Layers<float>& out, Vec3<float> background, const TileFrame& frame, const Planes& planes) {
  for_each_quad<DOWNSAMPLE>(out, frame, [&](int row, int column, int64_t at, int pixels) {
    const Quad alpha = fetch<DOWNSAMPLE>(planes.alpha, row, column), rest = 1.0f - alpha;
    const Vec3<Quad> color = {fetch<DOWNSAMPLE>(planes.red, row, column) + rest * background.x,
                              fetch<DOWNSAMPLE>(planes.green, row, column) + rest * background.y,
                              fetch<DOWNSAMPLE>(planes.blue, row, column) + rest * background.z};
    write_quad(out, at, pixels, {color, alpha, fetch<DOWNSAMPLE>(planes.depth, row, column)});
  });
}

inline void write_tile(const ForwardCall& call, int view, const TileFrame& frame, const Planes& planes) {
  const SplatPictures& p = call.out;
  const Layers<float> out = layers_of(p.image, p.alpha, p.depth, call.scene, call.settings, view);
  const Vec3<float> background = background_of(call.scene, view);
  call.settings.downsample == 2 ? write_tile_as<2>(out, background, frame, planes)
                                : write_tile_as<1>(out, background, frame, planes);
}

// d loss / d (colour, depth, alpha) per rendered pixel of a tile, block after block; zero outside of the image.
struct UpstreamPlanes {
  alignas(64) float red[TILE_PIXELS], green[TILE_PIXELS], blue[TILE_PIXELS], depth[TILE_PIXELS], alpha[TILE_PIXELS];
};

template <int DOWNSAMPLE>
inline void read_tile_as(const Layers<const float>& in, const TileFrame& frame, UpstreamPlanes& planes) {
  for_each_quad<DOWNSAMPLE>(in, frame, [&](int row, int column, int64_t at, int pixels) {
    const QuadPixels q = read_quad(in, at, pixels);
    spread<DOWNSAMPLE>(planes.red, row, column, q.color.x), spread<DOWNSAMPLE>(planes.green, row, column, q.color.y);
    spread<DOWNSAMPLE>(planes.blue, row, column, q.color.z), spread<DOWNSAMPLE>(planes.depth, row, column, q.depth);
    spread<DOWNSAMPLE>(planes.alpha, row, column, q.alpha);
  });
}

inline void read_tile(const BackwardCall& call, int view, const TileFrame& frame, UpstreamPlanes& planes) {
  const SplatUpstream& u = call.upstream;
  const Layers<const float> in = layers_of(u.image, u.alpha, u.depth, call.scene, call.settings, view);
  if (!frame.inside) std::memset(&planes, 0, sizeof planes);
  call.settings.downsample == 2 ? read_tile_as<2>(in, frame, planes) : read_tile_as<1>(in, frame, planes);
}

}  // namespace splat
